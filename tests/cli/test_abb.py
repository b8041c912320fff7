"""armlab abb: from "nothing loaded, motors off" to EGM, a named error for each fault, and no password anywhere."""

from __future__ import annotations

import base64
import contextlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from armlab.bridge.rws import PASSWORD, USER
from armlab.cli import main
from armlab.sim.controller.rws import FAULTS

from ..processes import RWS_PASSWORD, RWS_USER, free_port, rws_controller, until

pytest.importorskip("abb_robot_client", reason="needs abb_robot_client of the extra abb")
FLAVOURS = ["6.10", "7"]
YUMI = ("yumi_left", "yumi_right")


@pytest.fixture(autouse=True)
def credentials(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(USER, RWS_USER)
    monkeypatch.setenv(PASSWORD, RWS_PASSWORD)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("robotware", FLAVOURS)
def test_one_command_from_nothing_loaded_to_egm(tmp_path: Path, robotware: str, command: Callable[..., Any]) -> None:
    with rws_controller(tmp_path, robotware, robots=YUMI) as served:
        box, where = served.box, [served.host, *(["--ca", served.ca] if served.ca else [])]
        before = repr(vars(box))
        rehearsed = command(["abb", "setup", *where, "--dry-run"]).out.splitlines()
        assert repr(vars(box)) == before
        done = command(["abb", "setup", *where]).out.splitlines()
        assert [line.removeprefix("would ") for line in rehearsed] == [line.removeprefix("done: ") for line in done]
        assert [task.egm and task.runs for task in box.tasks] == [True, True]
        assert (box.state, sorted(box.files)) == ("motoron", ["$HOME/ArmlabYumiL.mod", "$HOME/ArmlabYumiR.mod"])
        found = json.loads(command(["abb", "status", *where, "--json"]).out)
        assert {one["verdict"] for one in found} == {"ok"}
        assert "busy" in command(["abb", "setup", *where], 1).err
        assert "busy" in command(["abb", "start", *where], 1).err
        assert command(["abb", "stop", *where, "--dry-run"]).out == "would stop RAPID\n"
        assert command(["abb", "stop", *where]).out == "done: stop RAPID\n"
        assert "already stopped" in command(["abb", "stop", *where]).err
        assert box.state == "motoron"
        command(["abb", "start", *where, "--task", "T_ROB_R"])
        assert [(task.runs, task.is_active) for task in box.tasks] == [(False, False), (True, True)]


NAMED = {
    "version": "RobotWare 6.05.00. Update to RobotWare 6.07 or newer",
    "password": "to accept the user and password",
    "option": "EGM option: missing",
    "manual": "operating mode: MANR",
    "emergency-stop": "motors: emergency stop. Release",
    "guard-stop": "motors: guard stop. Close the safety gate",
    "motors": "switch the motors on, but it failed",
    "mastership": "mastership: held by RobotStudio",
    "busy": "main is in MainModule",
    "main": "main is in MainModule. A task must have exactly one main routine",
    "module": "ArmlabYumiL is loaded with different content",
    "file": "ArmlabYumiL.mod has different content",
    "semantic": "load the module into T_ROB_L, but it failed",
    "device": "no 'armlab_l' among none. Add a device",
    "address": "armlab_l sends to 192.0.2.7:6511. Set the Remote Address of the device",
    "interface": "no 'armlab' among none. Add External Motion Interface Data",
}
REPLACED = ["main", "module", "file"]


@pytest.mark.parametrize("robotware", FLAVOURS)
@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named(tmp_path: Path, fault: str, robotware: str, command: Callable[..., Any]) -> None:
    with rws_controller(tmp_path, robotware, [fault]) as served:
        where = [served.host, *(["--ca", served.ca] if served.ca else [])]
        before = dict(served.box.files)
        told = command(["abb", "setup", *where], 1)
        assert NAMED[fault] in told.err
        assert "Traceback" not in told.err
        assert told.err.count("\n") == 1
        if fault not in ("motors", "semantic"):  # detected before anything is changed
            assert told.out == ""
            assert served.box.files == before
        if fault in REPLACED:
            command(["abb", "setup", *where, "--replace"])
            (task,) = served.box.tasks
            assert task.egm
            assert "EGMRunJoint" in task.modules["ArmlabYumiL"]
            saved = served.box.files.get("$HOME/MainModule_before_armlab.mod", b"")
            assert (b"PROC main()" in saved) == (fault == "main")
        if fault == "busy":
            command(["abb", "stop", *where])
            assert not served.box.is_running


def test_status_and_doctor_name_causes(tmp_path: Path, command: Callable[..., Any], monkeypatch: Any) -> None:
    monkeypatch.setattr("armlab.bridge.doctor.report.examine", lambda *_: [])
    with rws_controller(tmp_path, faults=["guard-stop", "device"]) as served:
        for words in (["abb", "status", served.host], ["doctor", "--rws", served.host]):
            lines = command(words, 1).out.splitlines()
            assert any(line.startswith("failure  motors") and "guard stop" in line for line in lines)
            assert any(line.startswith("failure  T_ROB_L, UDP device") for line in lines)
        assert "6519, sender" in command(["doctor", "--port", "6519", "--rws", served.host], 1).out
        with monkeypatch.context() as wrong:
            wrong.setenv(PASSWORD, "other")
            assert "but the controller refused them" in command(["doctor", "--rws", served.host], 1).out
    with rws_controller(tmp_path) as served:
        assert "motors off" in command(["abb", "status", served.host], 3).out


def test_modules_of_the_user(tmp_path: Path, command: Callable[..., Any]) -> None:
    own = 'MODULE ArmlabYumiL\n  PROC main()\n    EGMSetupUC ROB_L, g, "armlab", "armlab_l";\n  ENDPROC\nENDMODULE\n'
    (tmp_path / "ArmlabYumiL.mod").write_text(own)
    with rws_controller(tmp_path) as served:
        command(["abb", "setup", served.host, "--modules", tmp_path])
        assert served.box.files["$HOME/ArmlabYumiL.mod"] == own.encode()
        command(["abb", "stop", served.host])
        command(["abb", "setup", served.host, "--modules", tmp_path])  # the same content again


REFUSED = """
abb status me:secret@192.0.2.1 | without user and password
abb status host/path | HOST:PORT
abb setup HOST --task T_ROB7 | motion task of this controller
abb start HOST | armlab abb setup
sim yumi_left --to 127.0.0.1:9 --rws-fault manual | together with
sim yumi_left --to 127.0.0.1:9 --rws 0 --rws-fault manul | Did you mean 'manual'
sim yumi_left --to 127.0.0.1:9 --rws 70000 | from 0 to 65535
sim yumi_left --to 127.0.0.1:9 --rws 0 --lockstep | without --lockstep
"""


@pytest.mark.parametrize("line", REFUSED.strip().splitlines())
def test_wrong_use(tmp_path: Path, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, _, expected = line.partition(" | ")
    with rws_controller(tmp_path) as served:
        assert main([word.replace("HOST", served.host) for word in words.split()]) in (1, 2)
    assert expected in (told := capsys.readouterr().err)
    assert "secret" not in told


def test_no_password_without_a_terminal(tmp_path: Path, command: Callable[..., Any], monkeypatch: Any) -> None:
    monkeypatch.delenv(PASSWORD)
    with rws_controller(tmp_path) as served:
        assert PASSWORD in command(["abb", "status", served.host], 2).err
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        monkeypatch.setattr("getpass.getpass", lambda text: RWS_PASSWORD)
        assert "motors off" in command(["abb", "status", served.host], 3).out


@pytest.fixture
def simulator(tmp_path: Path, robotware: str) -> Iterator[tuple[int, str]]:
    """Run `armlab sim --rws`; yield the EGM port and the address of its services."""
    port, errors = free_port(), tmp_path / "sim.txt"
    words = ["sim", "yumi_left", "--to", f"127.0.0.1:{port}", "--robotware", robotware, "--rws", "0"]
    with errors.open("w") as file, subprocess.Popen([sys.executable, "-m", "armlab", *words], stderr=file) as process:
        try:
            until(lambda: "Web Services" in errors.read_text(), 120.0)
            yield port, errors.read_text().partition("//")[2].split()[0]
        finally:
            process.terminate()


@pytest.mark.slow
@pytest.mark.parametrize("robotware", FLAVOURS)
def test_a_run_starts_and_stops_rapid_and_no_password_is_anywhere(
    tmp_path: Path, simulator: tuple[int, str], capfd: pytest.CaptureFixture[str]
) -> None:
    port, host = simulator
    seen: set[str] = set()
    arguments = [sys.executable, "-m", "armlab"]
    steps = [["abb", "setup", host, "--insecure"], ["abb", "stop", host, "--insecure"]]
    steps += [["run", "yumi_left", "--link", f"egm://127.0.0.1:{port}?rws={host}&insecure=true", "--seconds", "1"]]
    for words in steps:
        with subprocess.Popen([*arguments, *words, "--debug"], stdout=None, stderr=None) as process:
            while process.poll() is None:
                seen |= command_lines()
            assert process.returncode == 0, words
    told = "".join(capfd.readouterr())
    assert "start RAPID in T_ROB_L" in told
    assert "stop RAPID" in told
    (log,) = tmp_path.glob("*.mcap")
    assert any("rws=" in line for line in seen)
    texts = [told, (tmp_path / "sim.txt").read_text(), *seen, everything_in(log)]
    for secret in (RWS_PASSWORD, base64.b64encode(f"{RWS_USER}:{RWS_PASSWORD}".encode()).decode()):
        assert not [text[:200] for text in texts if secret in text]


def everything_in(log: Path) -> str:
    reader = pytest.importorskip("mcap.reader", reason="needs mcap of the extra dev")
    with log.open("rb") as file:
        made = reader.make_reader(file)
        parts = [message.data for _, _, message in made.iter_messages()]
        parts += [one.data for one in made.iter_attachments()]
        parts += [repr(one.metadata).encode() for one in made.iter_metadata()]
    assert len(parts) > 100
    return b"".join(parts).decode("latin-1")


def command_lines() -> set[str]:
    """Return the command lines of all processes, as readable by every user of this computer."""
    found = set()
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # the process has just ended
            found.add(line.read_bytes().decode(errors="replace"))
    return found
