"""armlab run: a controller from a file, against the simulated robot."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots
from armlab.cli.run import load_controller
from armlab.errors import ConfigError

SINE = """
import numpy as np
from armlab import Command
from armlab.log import Column
from beside import AMPLITUDE

extra = {"wish": Column((), "rad")}

def sine(state):
    wish = AMPLITUDE * np.sin(2.0 * state.t)
    q = state.q_start.copy()
    q[0] += wish
    return Command(q, record={"wish": wish})

number = 3
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "sine.py").write_text(SINE, encoding="utf-8")
    (tmp_path / "code" / "beside.py").write_text("AMPLITUDE = 0.1\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "beside", raising=False)
    return tmp_path


def test_a_controller_of_a_file_moves_the_arm_and_is_recorded(folder: Path, command) -> None:
    words = ["--link", "sim://yumi_left?lockstep=true", "--log", "sway", "--seconds", "2"]
    (folder / "code" / "sine.py").rename(folder / "code" / "sine.v2.py")
    said = command(["run", "yumi_left", "code/sine.v2.py:sine", *words])
    assert "Ended: the time is up." in said.out
    assert "The robot is ready and holds its position." in said.err
    (path,) = folder.glob("sway-*Z.mcap")
    assert f"log: {path.name}" in said.err
    table = log.read(path)
    assert np.ptp(table["q"][:, 0]) > 0.1
    assert np.nanmax(table["wish"]) == pytest.approx(0.1, abs=1e-3)
    held = log.inspect(path).attachments
    assert held["sine.v2.py"] == SINE.encode()
    assert robots.from_toml(held["robot.toml"].decode(), "it").name == "yumi_left"


def test_a_log_of_the_same_name_is_kept_and_the_new_name_is_told(
    folder: Path, command, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict = {}
    monkeypatch.setattr("code.interact", lambda *_, local, **__: seen.update(local))
    monkeypatch.setattr("armlab.cli.run.time.strftime", lambda *_: "now")
    (folder / "sway-now.mcap").write_bytes(b"mine")
    words = ["run", "yumi_left", "--link", "sim://yumi_left?lockstep=true", "--log", "sway", "--seconds", "0.1", "-i"]
    assert "log: sway-now-2.mcap; show it with armlab log show sway-now-2.mcap" in command(words).err
    assert (folder / "sway-now.mcap").read_bytes() == b"mine"
    assert (seen["log"]["q"].shape[1], seen["robot"].name, seen["run"].reason) == (7, "yumi_left", "the time is up")


@pytest.mark.slow
def test_a_log_that_is_not_whole_is_a_failure(folder: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("armlab.log.recording.file.RecordingFile.write", full)
    words = ["--link", "sim://yumi_left?lockstep=true", "--seconds", "0.5"]
    said = command(["run", "yumi_left", *words], 1)
    assert "Ended: the time is up." in said.out
    assert "warning: The recording stopped" in said.err


@pytest.mark.slow
def test_both_arms_without_a_file_hold(folder: Path, command) -> None:
    words = ["--link", "sim://yumi_left+yumi_right?lockstep=true", "--no-log", "--seconds", "0.2"]
    assert command(["run", "yumi_left+yumi_right", *words]).out.count("Ended: the time is up.") == 2
    assert not list(folder.glob("*.mcap"))


def test_a_controller_that_raises_is_one_sentence(folder: Path, command) -> None:
    (folder / "bad.py").write_text("def controller(state):\n    return 1 / 0\n", encoding="utf-8")
    said = command(["run", "yumi_left", "bad.py", "--link", "sim://yumi_left?lockstep=true", "--log", "bad"], 1).err
    assert "The controller raised ZeroDivisionError" in said
    assert "bad.py, line 2: return 1 / 0\n" in said
    assert "loop.py" not in said
    assert len(list(folder.glob("bad-*.mcap"))) == 1


def test_an_interrupted_run_is_reported_too(folder: Path, command) -> None:
    (folder / "long.py").write_text(
        "import signal\ndef controller(state):\n    state.t > 0.3 and signal.raise_signal(signal.SIGINT)\n",
        encoding="utf-8",
    )
    said = command(["run", "yumi_left", "long.py", "--link", "sim://yumi_left?lockstep=true", "--log", "long"], 130)
    assert "Ended: interrupted." in said.out
    assert "Packets " in said.out
    assert "log: long-" in said.err


def test_a_log_in_a_folder_has_the_name_of_the_robot(folder: Path, command) -> None:
    (folder / "logs").mkdir()
    words = ["run", "yumi_left", "--link", "sim://yumi_left?lockstep=true", "--seconds", "0"]
    assert command([*words, "--log", "logs"]).out.count("Ended: the time is up.") == 1
    assert len(list((folder / "logs").glob("yumi_left-*.mcap"))) == 1


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("no.py:sine", "no file no.py"),
        ("code/sine", r"Expected a controller as FILE.py:NAME, got 'code/sine'\. Use a file name that ends in \.py"),
        ("motion.csv", r"got 'motion\.csv'\. Use a file name that ends in \.py"),
        ("code/sine.py", "Expected a function 'controller' .*sine.py, but the name does not exist.* sine"),
        ("none.py:f", "Expected a function 'f' in none.py, got None"),
        ("exits.py:f", r"exits\.py to load, but it raised SystemExit: 3\."),
        ("code/sine.py:number", "got 3"),
        ("broken.py:f", "broken.py to load, but it raised ZeroDivisionError"),
        ("wrong.py:f", "SyntaxError"),
    ],
)
def test_files_that_are_no_controllers(folder: Path, place: str, words: str) -> None:
    (folder / "motion.csv").write_text("t,q1\n", encoding="utf-8")
    (folder / "none.py").write_text("f = None\n", encoding="utf-8")
    (folder / "exits.py").write_text("import sys\nsys.exit(3)\n", encoding="utf-8")
    (folder / "broken.py").write_text("1 / 0\n", encoding="utf-8")
    (folder / "wrong.py").write_text("def f(\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        load_controller(place)


@pytest.mark.parametrize(("name", "code"), [("late", 1), ("once", 0)])
def test_a_run_whose_last_command_was_refused_says_so_and_fails(folder: Path, command, name: str, code: int) -> None:
    when = {"late": "state.t > 0.1", "once": "state.t < 0.1"}[name]
    text = f"def {name}(state):\n    return Command(state.q * 0 + 45.0) if {when} else None\n"
    (folder / f"{name}.py").write_text(f"from armlab import Command\n{text}", encoding="utf-8")
    link = ["--link", "sim://yumi_left?lockstep=true", "--no-log", "--seconds", "0.2"]
    said = command(["run", "yumi_left", f"{name}.py:{name}", *link], code).out
    assert "Ended: the time is up." in said
    refused = "The last command to yumi_left was refused. Expected the first position within"
    assert (refused in said) == bool(code)


CONTROLLER = """
import numpy as np
from armlab.state import Command
def fast(state):
    return Command(qd=3.0 * np.cos(3.0 * state.t) * np.ones(7))
"""


@pytest.fixture
def busy() -> Iterator[None]:
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    yield
    for one in spinning:
        one.kill()
        one.wait()


@pytest.mark.slow
@pytest.mark.usefixtures("busy")
def test_no_run_on_a_busy_computer_is_faster_than_allowed(tmp_path: Path) -> None:
    robot, file = robots.load("yumi_right"), tmp_path / "fast.py"
    file.write_text(CONTROLLER)
    for k in range(3):
        folder = tmp_path / str(k)
        folder.mkdir()
        command = f"run yumi_right {file}:fast --seconds 1.5 --speed 0.5 --log {folder}/"
        subprocess.run([sys.executable, "-m", "armlab", *command.split()], check=True, capture_output=True, timeout=120)
        (path,) = folder.glob("*.mcap")
        table = log.read(path)
        went = np.isfinite(table["q_sent"]).all(axis=1)
        q, qd, dt = table["q_sent"][went], table["qd_sent"][went], 1e-9 * np.diff(table["robot_ns"][went])
        moving = qd[1:].any(axis=1)
        assert moving.sum() > 50
        speed = np.abs(np.diff(q, axis=0) / dt[:, None])[moving]
        assert (speed <= 0.5 * robot.qd_max * (1.0 + 1e-9)).all()
