"""``armlab bridge``: its errors, and the commands for a running bridge."""

from __future__ import annotations

import io
import re
import shutil
import signal
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.servers.hub import OPERATOR, Hub
from armlab.bridge.servers.local import LocalFeed, LocalServer, socket_path
from armlab.bridge.servers.messages import Subscribe, parameter_message
from armlab.bridge.servers.row import RowSchema, RowWriter, read_row
from armlab.bridge.servers.status import Watch
from armlab.bridge.servers.zenoh.security import USERS
from armlab.cli import main
from armlab.cli.bridge import table, write_certificates
from armlab.errors import ConfigError
from armlab.log import Tick
from armlab.state import State

CELL = """
name = "small"
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
"""


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """Yield a hub whose requests another thread takes, as when no robot packets arrive."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    declared = [Parameter("gain", 2.0, unit="N/m", minimum=0.0, text="Stiffness."), Parameter("word", "a", "text")]
    exchange = Hub([robots.load("yumi_left")], [OPERATOR], Parameters(declared))
    far = exchange.open(OPERATOR)
    server = threading.Thread(target=LocalServer(far, {"path": socket_path("small")}).run, daemon=True)
    over = threading.Event()

    def poll() -> None:
        q = np.zeros(7)
        while not over.is_set():
            exchange.poll()
            state = State(0.0, 0.004, q, q, q, robot="yumi_left", motors=1, mci=3)
            exchange.row(state, None, Tick(0, 0, time.time_ns(), time.time_ns(), time.time_ns(), 0))
            time.sleep(0.01)

    poller = threading.Thread(target=poll, daemon=True)
    for thread in (server, poller):
        thread.start()
    yield exchange
    over.set()
    poller.join()
    exchange.close()
    server.join(10.0)
    far.close()


def test_set(running: Hub, command) -> None:
    shown = command(["bridge", "set", "gain=3.5", "word=hello"]).out
    assert re.search(r"gain +3.5 +N/m +Stiffness. +local \d", shown)
    assert (running.parameters.gain, running.parameters.word) == (3.5, "hello")
    assert "gain       3.5" in command(["bridge", "set"]).out
    for word in ("007", "x y", "1.2.3"):  # no TOML: texts
        command(["bridge", "set", f"word={word}"])
        assert running.parameters.word == word


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["gain"], 2, "NAME=VALUE"),
        (["gain=-1"], 1, "from 0 to inf"),  # the running bridge checks the value and refuses it
        (["gan=1"], 1, "Did you mean 'gain'"),
        (["gain=3", "word=4"], 1, "Expected text of at most"),
        (["word=99999999999999999999"], 2, "a 64-bit integer"),
    ],
)
def test_refused(running: Hub, command, words: list[str], code: int, said: str) -> None:
    assert said in command(["bridge", "set", *words], code).err
    assert running.parameters.gain == 2.0


def test_stop_release_and_resume(running: Hub, command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert command(["bridge", "stop"]).out == "Done.\n"
    assert running.arbiter.stopped.startswith("local ")
    for word in ("release", "resume"):
        assert command(["bridge", word]).out == "Done.\n"
    assert running.arbiter.stopped == ""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "none"))
    for words in ("bridge set a=1", "bridge stop", "bridge release", "bridge resume", "monitor"):
        assert "found none" in command(words.split(), 1).err


def test_others_may_set_parameters_meanwhile(running: Hub, monkeypatch: pytest.MonkeyPatch, command) -> None:
    taken = running._take

    def set_another_first(outlet: Any, data: bytes) -> None:
        if b"gain" in data:
            running.parameters.set("word", "other", "somebody")
            for change in running.parameters.apply():
                assert change.name == "word"
            outlet.send(parameter_message(running.parameters))
        taken(outlet, data)

    monkeypatch.setattr(running, "_take", set_another_first)
    assert re.search(r"gain +3.5", command(["bridge", "set", "gain=3.5"]).out)


def test_a_request_without_an_answer(running: Hub, monkeypatch: pytest.MonkeyPatch, command) -> None:
    monkeypatch.setattr(running, "answer", lambda client, text: None)
    monkeypatch.setattr("armlab.cli.bridge._PATIENCE", 0.05)
    noise = threading.Timer(0.1, lambda: running.event("Still here."))
    noise.start()
    assert "an answer from the bridge within 0.05 s, got none" in command(["bridge", "resume"], 1).err
    noise.join()


def test_the_report_comes_also_with_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("armlab.bridge.link.Loop.run", lambda loop: loop._fail(ValueError("odd")))
    path = tmp_path / "cell.toml"
    path.write_text(CELL.replace("sim://yumi_left", "egm://127.0.0.1:0"))
    shown = command(["bridge", "--config", path], 1)
    assert "Ended: the bridge failed." in shown.out
    assert "Rows to the server local: 0. Rows from this server to its clients: none." in shown.out
    assert "ValueError: odd" in shown.err


@pytest.mark.slow
def test_the_whole_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reports its addresses, ends on Ctrl-C with 130 and a report, and leaves nothing behind. Takes 4 s."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    command = [sys.executable, "-m", "armlab", "bridge", "--config", str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stderr is not None
        line = next(line for line in program.stderr if not line.startswith("armlab: note"))  # of slow kernels
        assert re.fullmatch(r"Listening: 127\.0\.0\.1:\d+ \(egm yumi_left\), .*armlab/small\.sock \(local\)\.\n", line)
        with LocalFeed("small", patience=20.0) as feed:
            feed.ask(Subscribe())
            while isinstance(feed.receive(), dict):
                pass
        program.send_signal(signal.SIGINT)
        said, _ = program.communicate(timeout=20.0)
    assert program.returncode == 130
    assert said.startswith("Ended: interrupted.\nyumi_left, RobotWare")
    assert re.search(r"Arrival to reply \[us\]: p50 (\d+|nan)", said)
    one = r"\d+( \(\d+ dropped\))?"  # rows in transit when a client left
    assert re.search(rf"Rows to the server local: \d+\. Rows from this server to its clients: ({one} )*{one}\.", said)
    assert not socket_path("small").exists()


needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")


@needs_openssl
def test_certificates_are_of_the_lab_s_authority(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "lab"
    assert main(["bridge", "certificates", str(folder), "--host", "192.168.1.5", "--host", "lab-pc"]) == 0
    shown = capsys.readouterr().out.split()
    assert sorted(shown) == sorted(str(path) for path in folder.iterdir())
    check = ["openssl", "verify", "-CAfile", str(folder / "lab.pem"), str(folder / "bridge.pem")]
    assert subprocess.run(check, capture_output=True, text=True, check=False).stdout.endswith("OK\n")
    text = ["openssl", "x509", "-in", str(folder / "bridge.pem"), "-noout", "-ext", "subjectAltName"]
    names = subprocess.run(text, capture_output=True, text=True, check=True).stdout
    assert re.search("DNS:localhost, IP Address:127.0.0.1, IP Address:192.168.1.5, DNS:lab-pc", names)
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(folder / "bridge.pem", folder / "bridge.key")
    assert {path.stat().st_mode & 0o077 for path in folder.iterdir()} == {0}
    users = (folder / "users.txt").read_text().splitlines()
    assert [line.partition(":")[0] for line in users] == ["commander", "bridge", "viewer"] == list(USERS)
    assert (folder / "commander.secret").read_text().strip() == users[0]
    assert len({line.partition(":")[2] for line in users}) == 3


@needs_openssl
def test_authority_and_users_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_certificates(tmp_path)
    kept = {name: (tmp_path / name).read_bytes() for name in ("lab.key", "lab.pem", "users.txt", "commander.secret")}
    before = (tmp_path / "bridge.key").read_bytes()
    assert [path.name for path in write_certificates(tmp_path, ["robot-pc"])] == ["bridge.key", "bridge.pem"]
    assert {name: (tmp_path / name).read_bytes() for name in kept} == kept
    assert (tmp_path / "bridge.key").read_bytes() != before
    with pytest.raises(ConfigError, match="names or addresses"):
        write_certificates(tmp_path, ["a,DNS:b"])
    with pytest.raises(ConfigError, match="Expected a writable folder"):
        write_certificates(tmp_path / "lab.pem")
    (tmp_path / "lab.key").write_text("no key")
    with pytest.raises(ConfigError, match="openssl to create a certificate"):
        write_certificates(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="Expected the program openssl"):
        write_certificates(tmp_path / "other")


LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
NOW = 10**18


def row() -> Any:
    q, schema = np.zeros(7), RowSchema.of([LEFT, RIGHT])
    state = State(0.0, 0.004, q, q, q, robot="yumi_left", motors=1, rapid=2, mci=3)
    return read_row(schema, RowWriter(schema).row(state, None, Tick(1, 1, NOW, NOW, NOW + 1000, 0), 0, "labcomm a"))


def test_the_table() -> None:
    watch, console = Watch(), Console(width=100, file=io.StringIO())
    console.print(table(watch, NOW))
    watch.take({"kind": "about", "cell": "yumi"})
    watch.take({"kind": "event", "stamp_ns": NOW, "text": "[b]The robot[/b] is ready."})
    watch.take({"kind": "status", "rows": 1, "lost": 4, "arms": {}})
    watch.take(row())
    console.print(table(watch, NOW))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    for word in (
        "No rows yet",
        "Cell yumi",
        "yumi_right",
        "p50 / p99 / max [us]",
        "[b]The robot[/b] is ready.",
        "Rows lost by this feed: 4",
    ):
        assert word in text


@pytest.mark.slow
def test_plain_lines(running: Hub, command) -> None:
    running.event("Something happened.")
    shown = command(["monitor", "--seconds", "0.5"]).out
    assert "yumi_left, state holding" in shown
    assert "Something happened." in shown
