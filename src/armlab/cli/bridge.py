"""``armlab bridge`` and ``armlab monitor``: run, control and monitor a cell, and create its certificates."""

from __future__ import annotations

import ipaddress
import math
import os
import re
import secrets
import ssl
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from armlab._files import TomlError, parsed
from armlab.cli import FAILED
from armlab.cli.support.options import Cell, Seconds, require_seconds
from armlab.cli.support.output import aligned, note, result
from armlab.errors import CommandRefused, ConfigError, LinkError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from armlab.bridge.servers.messages import Request
    from armlab.bridge.servers.status import Watch

_WHOLE = re.compile(r"[-+]?[1-9][0-9]*(_[0-9]+)*")
_PATIENCE = 10.0  # s, timeout for a reply

bridge: App = App(
    name="bridge",
    help="Run a cell: robots, parameters, and servers for LabComm and other protocols.",
    help_epilogue="Example: armlab bridge --config cell.toml",
)


@bridge.default
def start(*, config: Path | None = None, listen: list[str] | None = None, seconds: float | None = None) -> int:
    """Run the bridge of a cell until Ctrl-C. Prints the server addresses at the start, and a report at the end.

    Parameters:
        config: TOML file that describes the cell (robots, sources, parameters and servers); default: from the settings.
        listen: SERVER=ADDRESS or SERVER=INTERFACE: let other computers read from this server, which then accepts no
            commands.
        seconds: Stop after this much time under guidance, measured by the robot's clock [s].
    """
    from armlab.bridge.cell import parse_cell, run_cell
    from armlab.cli.support.settings import load_settings, read_text

    known = load_settings().settings.cell if config is None else config
    if known is None:
        raise ConfigError("Expected a cell file, got none. Add --config cell.toml, or set `cell` in armlab.toml.")
    cell = parse_cell(read_text(Path(known), "a cell"), str(known))
    run = run_cell(cell, listen or (), seconds, ready=note, ended=lambda run: result(run.report()))
    return FAILED if run.statistics["problems"] else 0


@bridge.command(name="set", help_epilogue="Example: armlab bridge set gain=2.5 force=[0,0,5]")
def set_parameters(*setting: str, cell: Cell = "") -> None:
    """Set parameters of a running bridge, and show the resulting values. If any value is rejected, no parameter is
    changed.

    Parameters:
        setting: NAME=VALUE, for example gain=2.5, force=[0,0,5], gentle=true. Without settings, show all parameters.
    """
    from armlab.bridge.servers.local import LocalFeed
    from armlab.bridge.servers.messages import SetRequest, Subscribe

    values = dict(_setting(word) for word in setting)
    with LocalFeed(cell) as feed:
        feed.ask(Subscribe(rate=0.0))
        found = _await(feed, "parameters")["parameters"]
        if values:
            before = max((one["sequence"] for one in found), default=0)
            feed.ask(SetRequest(values=values))
            # other clients may set parameters at the same time
            while not set(values) <= {one["name"] for one in found if one["sequence"] > before}:
                found = _await(feed, "parameters")["parameters"]
    shown = [one for one in found if one["name"] in values or not values]
    rows = [[one["name"], str(one["value"]), one["unit"], one["text"], one["who"]] for one in shown]
    result(aligned([["parameter", "value", "unit", "", "set by"], *rows]) if rows else "This cell has no parameters.")


@bridge.command(help_epilogue="Example: armlab bridge stop")
def stop(*, cell: Cell = "") -> None:
    """Stop all arms and hold them until `resume`. This is not an emergency stop."""
    from armlab.bridge.servers.messages import Stop

    _operate(Stop(), cell)


@bridge.command(help_epilogue="Example: armlab bridge release")
def release(*, cell: Cell = "") -> None:
    """Release control of all arms; they hold position."""
    from armlab.bridge.servers.messages import Release

    _operate(Release(), cell)


@bridge.command(help_epilogue="Example: armlab bridge resume")
def resume(*, cell: Cell = "") -> None:
    """End a stop, so that the arms accept commands again."""
    from armlab.bridge.servers.messages import Resume

    _operate(Resume(), cell)


@bridge.command(help_epilogue="Example: armlab bridge certificates lab/ --host 192.168.1.5")
def certificates(folder: Path, *, host: list[str] | None = None) -> None:
    """Create certificates, users and passwords for commanding a bridge from other computers over Zenoh.

    Parameters:
        folder: Output folder. Secret files are readable only by you.
        host: Host names and addresses at which clients reach the bridge; localhost is always included.
    """
    result("\n".join(str(path) for path in write_certificates(folder, host or ())))


def _operate(request: Request, cell: str) -> None:
    from armlab.bridge.servers.local import LocalFeed

    with LocalFeed(cell) as feed:
        feed.ask(request)
        result(_await(feed, "answer")["text"])


def _await(feed: Any, kind: str) -> dict[str, Any]:
    """Return the next message of the given kind; raise an error if the bridge rejects the request."""
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        message = feed.receive()
        if isinstance(message, dict):
            if message["kind"] == kind:
                return message
            if message["kind"] == "answer":
                raise CommandRefused(message["text"])
    raise LinkError(f"Expected an answer from the bridge within {_PATIENCE:g} s, got none. Try again.")


def _setting(word: str) -> tuple[str, Any]:
    name, sign, value = word.partition("=")
    if not sign or not name:
        raise ConfigError(f"Expected NAME=VALUE, got {word!r}. For example, write gain=2.5.")
    try:
        return name, parsed(f"x = {value}")["x"]
    except TomlError:
        if _WHOLE.fullmatch(value):
            raise ConfigError(
                f"Expected a 64-bit integer, got {word[:80]!r}. Write larger numbers as floats, such as 1e20."
            ) from None
        return name, value  # unquoted text


_DAYS = "3650"
_CURVE = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]


def write_certificates(folder: Path, hosts: Sequence[str] = ()) -> list[Path]:
    """Write a lab's certificate authority, a bridge's certificate and key, and the users' passwords.

    ``lab.pem`` is public. ``bridge.pem``, ``bridge.key`` and ``users.txt`` belong on the bridge's computer (and on that
    of the lab's router). ``USER.secret`` is for that user only. ``lab.key`` signs certificates for additional bridges;
    keep it private. Only the owner can read the keys and passwords. An existing certificate authority and existing
    users are kept.
    """
    names = ["localhost", "127.0.0.1", *hosts]
    for name in names:
        if not name or any(not (letter.isalnum() or letter in ".-:") for letter in name):
            raise ConfigError(f"Expected names or addresses of the bridge's computer, got {name!r}.")
    before = os.umask(0o077)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = []
        if not (folder / "lab.key").exists():
            written = [key, certificate] = [folder / "lab.key", folder / "lab.pem"]
            _certify(key, certificate, "-subj", "/CN=armlab lab", "-addext", "basicConstraints=critical,CA:TRUE")
        return written + _bridge(folder, names) + _users(folder)
    except OSError as error:
        raise ConfigError(f"Expected a writable folder for the certificates, but {error}.") from None
    finally:
        os.umask(before)


def _certify(key: Path, certificate: Path, *subject: str) -> None:
    """Write a key and a self-signed certificate."""
    _openssl("req", "-x509", *_CURVE, "-days", _DAYS, *subject, "-keyout", str(key), "-out", str(certificate))


def self_signed(folder: Path) -> ssl.SSLContext:
    """Return the TLS context of a server on this computer with a new self-signed certificate."""
    key, certificate = folder / "self.key", folder / "self.pem"
    _certify(key, certificate, "-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    return context


def _bridge(folder: Path, names: Sequence[str]) -> list[Path]:
    key, certificate, request = (folder / f"bridge.{end}" for end in ("key", "pem", "csr"))
    extensions = folder / "bridge.ext"
    subjects = ",".join(f"{'IP' if _is_address(name) else 'DNS'}:{name}" for name in names)
    extensions.write_text(
        f"subjectAltName={subjects}\nbasicConstraints=critical,CA:FALSE\nextendedKeyUsage=serverAuth,clientAuth\n",
        encoding="utf-8",
    )
    try:
        _openssl("req", *_CURVE, "-subj", f"/CN={names[-1]}", "-keyout", str(key), "-out", str(request))
        signing = ["-CA", str(folder / "lab.pem"), "-CAkey", str(folder / "lab.key"), "-CAcreateserial"]
        where = ["-extfile", str(extensions), "-days", _DAYS, "-out", str(certificate)]
        _openssl("x509", "-req", "-in", str(request), *signing, *where)
    finally:
        for one in (extensions, request, folder / "lab.srl"):
            one.unlink(missing_ok=True)
    return [key, certificate]


def _users(folder: Path) -> list[Path]:
    from armlab.bridge.servers.zenoh.security import USERS

    path = folder / "users.txt"
    if path.exists():
        return []
    lines = {user: f"{user}:{secrets.token_urlsafe(24)}\n" for user in USERS}
    path.write_text("".join(lines.values()), encoding="utf-8")
    for user, line in lines.items():
        (folder / f"{user}.secret").write_text(line, encoding="utf-8")
    return [path, *(folder / f"{user}.secret" for user in USERS)]


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _openssl(*words: str) -> None:
    try:
        run = subprocess.run(["openssl", *words], capture_output=True, text=True, check=False, timeout=60.0)
    except FileNotFoundError:
        raise ConfigError(
            "Expected the program openssl on the PATH to create certificates, but it is not installed. Install it."
        ) from None
    if run.returncode:
        raise ConfigError(
            f"Expected openssl to create a certificate, but it reported: {' '.join(run.stderr.split())[:300]}."
        )


_RATE = 10.0  # Hz, refresh rate of the display
_LINES = 1.0  # s between lines if the output is not a terminal


def monitor(robot: str | None = None, *, cell: Cell = "", zenoh: str = "", seconds: Seconds = None) -> None:
    """Monitor one of your running bridges until Ctrl-C or until the bridge ends.

    Parameters:
        robot: Show only this arm.
        zenoh: Address of a bridge on another computer, such as zenoh://192.168.1.5:7447/lab1.
    """
    from rich.console import Console

    from armlab.bridge.servers.local import LocalFeed
    from armlab.bridge.servers.messages import Subscribe
    from armlab.bridge.servers.status import Watch
    from armlab.bridge.servers.zenoh.feed import ZenohFeed

    require_seconds(seconds)
    console = Console()
    watch = Watch(robot)
    end = math.inf if seconds is None else time.monotonic() + seconds
    with ZenohFeed(zenoh, robot or "") if zenoh else LocalFeed(cell) as feed:
        feed.ask(Subscribe(rate=_RATE))
        try:
            (_live if console.is_terminal else _lines)(console, feed, watch, end)
        except LinkError as error:
            note(str(error))


def _live(console: Any, feed: Any, watch: Watch, end: float) -> None:
    from rich.live import Live

    with Live(console=console, auto_refresh=False) as live:
        while time.monotonic() < end:
            _hear(feed, watch, 1.0 / _RATE)
            live.update(table(watch, time.time_ns()), refresh=True)


def _lines(_: Any, feed: Any, watch: Watch, end: float) -> None:
    told = 0
    while time.monotonic() < end:
        _hear(feed, watch, _LINES)
        events = list(watch.events)[len(watch.events) - min(watch.told - told, len(watch.events)) :]
        for line in (*watch.lines(time.time_ns()), *(f"  {text}" for text in events)):
            result(line)
        told = watch.told


def _hear(feed: Any, watch: Watch, seconds: float) -> None:
    due = time.monotonic() + seconds
    while feed.wait(due - time.monotonic()):
        watch.take(feed.receive())
        if time.monotonic() >= due:
            return


def table(watch: Watch, now_ns: int) -> RenderableType:
    """Return a table with one column per arm, followed by the recording state and the events."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    arms = watch.arms(now_ns)
    if not arms:
        return Text("No rows yet: waiting for robot packets.")
    shown = Table(title=f"Cell {watch.cell}")
    for k, arm in enumerate([{"arm": ""}, *arms]):
        shown.add_column(arm["arm"], no_wrap=k == 0)
    for key in list(arms[0])[1:]:
        shown.add_row(Text(key), *[Text(arm[key]) for arm in arms])  # Text: rich treats brackets in str as markup
    return Group(shown, Text("\n".join(watch.notes())))
