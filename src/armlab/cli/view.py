"""``armlab view``: a log or a running bridge, in the browser."""

from __future__ import annotations

import select
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import urlsplit

import armlab
from armlab.cli.support.output import note, result
from armlab.errors import ConfigError, LinkError

if TYPE_CHECKING:
    from armlab.models import TorqueModel

_START = 30.0  # s for a view to begin
_END = 5.0  # s for it to end


def view(
    *what: str,
    live: bool = False,
    fleet: bool = False,
    zenoh: str = "",
    robot: list[str] | None = None,
    model: list[Path] | None = None,
    cell: str = "",
    port: int | None = None,
) -> None:
    """Show logs in the browser, with --live a running bridge, with --fleet all robots at a router; until Ctrl-C.

    Prints the address to open. The page comes from this computer and is for this computer only: to look from another
    one, forward the port by ssh -L. A view of a bridge only reads: it can neither delay it nor command it, waits for
    one that has not begun, and goes on when it starts again.

    Parameters:
        what: Log files, of one arm or of several; with --live the name of the arm to show, all when left out.
        live: Show a running bridge of this user, or with --zenoh one elsewhere.
        fleet: Show all robots side by side that armlab fleet list would list; with --zenoh those of another router or
            of one lab. One that comes is added, one that goes is shown as gone.
        zenoh: Where bridge or router are, for example zenoh://192.168.1.5:7447/lab1; zenoh://127.0.0.1:7447 with
            --fleet.
        robot: Name in the library, or a robot file, for logs without an embedded robot description; one per log. Its
            mesh files are searched beside it and up to two folders above.
        model: Model file of `armlab identify` that estimates the force where neither log nor bridge holds an estimate;
            one per arm.
        cell: With --live, name of the cell; needed when several run.
        port: Port of the page; from 8080 on the first that is free when left out.
    """
    if fleet:
        if what or live or robot or model or cell:
            raise ConfigError("Expected at most --zenoh and --port with --fleet, got more. Leave it out.")
        _watch_fleet(zenoh, port)
        return
    known = [armlab.models.load(path, "torque_model") for path in model or ()]
    if not live:
        for option, value in (("--cell", cell), ("--zenoh", zenoh)):
            if value:
                raise ConfigError(f"Expected {option} {value} together with --live, got logs. Leave one of them out.")
        _play(what, robot or (), known, port)
        return
    if robot:
        raise ConfigError("Expected --robot with logs only, since a bridge tells its robots. Leave it out.")
    if cell and zenoh:
        raise ConfigError(
            f"Expected --cell of this computer or --zenoh, got {cell} and {zenoh}. Leave one of them out."
        )
    if len(what) > 1:
        raise ConfigError(f"Expected one arm with --live, got {', '.join(what)}. Leave them out to see all arms.")
    from armlab.live.live_bridge import watch

    arm = what[0] if what else None
    watch(arm, cell=cell, zenoh=zenoh, models=known, port=port, opened=_open, tell=note)


def _watch_fleet(url: str, port: int | None) -> None:
    from armlab.bridge.servers.zenoh.messages import EVERY
    from armlab.bridge.servers.zenoh.session import LabAddress
    from armlab.live.fleet_view import watch_fleet

    place = LabAddress.read(url or "zenoh://127.0.0.1")
    has_lab = urlsplit(url).path.strip("/") != ""
    watch_fleet(place if has_lab else place._replace(lab=EVERY), port=port, opened=_open, tell=note)


def _play(paths: Sequence[str], names: Sequence[str], models: Sequence[TorqueModel], port: int | None) -> None:
    if not paths:
        raise ConfigError("Expected at least one log to show, got none. Name a file, or give --live for a bridge.")
    note(f"reading {', '.join(paths)}")
    arms = armlab.live.read_arms(paths, [armlab.robots.load(name) for name in names], models)
    server = armlab.live.start(port, label=" ".join(Path(path).name for path in paths))
    try:
        player = armlab.live.Player(server, arms, meshes=_folders(names))
        _open(armlab.live.address(server))
        player.run()
    finally:
        armlab.live.stop(server)


def _folders(robots: Sequence[str]) -> list[Path]:
    """Return where meshes are looked for: beside each robot file and up to two folders above, as packages have them."""
    files = [Path(name).resolve() for name in robots if Path(name).is_file()]
    return [*(folder for file in files for folder in file.parents[:3]), Path()]


def _open(url: str) -> None:
    """Print the address at once, also for a program that reads it."""
    result(f"View: {url}")
    sys.stdout.flush()


@contextmanager
def beside(cell: str) -> Iterator[str]:
    """Show a bridge in the browser while the block runs, from a process of its own; yields the address."""
    words = [sys.executable, "-m", "armlab", "view", "--live", "--cell", cell]
    with TemporaryFile("w+") as said:
        options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": said}
        # a session of its own: Ctrl-C reaches the caller, which brings the arm to rest first
        process = subprocess.Popen(words, text=True, start_new_session=True, **options)
        try:
            yield _first_line(process, said)
        finally:
            process.terminate()
            try:
                process.communicate(timeout=_END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _first_line(process: subprocess.Popen[str], said: IO[str]) -> str:
    """Return what a view prints when it can be opened."""
    out = process.stdout
    came = out is not None and select.select([out], [], [], _START)[0]
    line = out.readline().strip() if out is not None and came else ""
    if not line:
        said.seek(0)
        why = said.read().strip().removeprefix("armlab: ")
        raise LinkError(why or f"Expected the view to begin within {_START:g} s, but it did not. Leave it out.")
    return line
