"""``armlab view``: wrong use gets a sentence, Ctrl-C is an end, and a view beside a run is a process of its own."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log as logs
from armlab import models, robots
from armlab.cli import main
from armlab.cli.view import _folders, beside
from armlab.errors import LinkError
from armlab.live import Player
from armlab.log import Table

pytest.importorskip("viser", reason="the view in the browser needs the extra `live`")


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No bridge of this user runs."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--live", "yumi_left", "yumi_right"], "Expected one arm with --live, got yumi_left, yumi_right"),
        (["--live", "--model", "none.toml"], "Expected a model file at none.toml"),
        (["--live", "--robot", "yumi_left"], "a bridge tells its robots"),
        ([], "Expected at least one log to show, got none"),
        (["--cell", "yumi", "run.mcap"], "Expected --cell yumi together with --live"),
        (["--zenoh", "zenoh://host/lab1", "run.mcap"], "Expected --zenoh zenoh://host/lab1 together with --live"),
        (["--live", "--zenoh", "http://host"], "Expected a place like zenoh://"),
        (["--live", "--zenoh", "zenoh://host", "--cell", "a"], "Expected --cell of this computer or --zenoh"),
        (["--fleet", "run.mcap"], "Expected at most --zenoh and --port with --fleet"),
        (["--fleet", "--zenoh", "host:7447"], "Expected a place like zenoh://"),
        (["--live", "--port", "99999"], "Expected a port from 0 to 65535"),
    ],
)
def test_wrong_use_gets_a_sentence(alone: None, capsys: Any, words: list[str], sentence: str) -> None:
    assert main(["view", *words]) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "sentence"),
    [(None, "Expected a log at"), ("[project]\n", "Expected names that come once in the header of")],
)
def test_a_file_that_is_no_log(tmp_path: Path, capsys: Any, text: str | None, sentence: str) -> None:
    path = tmp_path / "run.mcap"
    if text is not None:
        path.write_text(text)
    assert main(["view", str(path)]) == 1
    assert sentence in capsys.readouterr().err


def test_a_file_of_another_kind_is_no_model(alone: None, tmp_path: Path, capsys: Any) -> None:
    models.save(robots.load("yumi_left"), tmp_path / "arm.toml")
    assert main(["view", "--live", "--model", str(tmp_path / "arm.toml")]) == 2
    assert "Expected a file of kind 'torque_model'" in capsys.readouterr().err


def test_a_port_that_is_taken(alone: None, capsys: Any) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["view", "--live", "--port", str(taken.getsockname()[1])]) == 1
    assert "is taken. Choose another: --port" in capsys.readouterr().err


def test_without_the_extra(alone: None, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "--live"]) == 1
    assert "pip install 'armlab[live]'" in capsys.readouterr().err


def test_ctrl_c_ends_it_without_a_traceback(alone: None) -> None:
    words = [sys.executable, "-m", "armlab", "view", "--live", "--port", "0"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        line = process.stdout.readline()
        assert re.fullmatch(r"View: http://127\.0\.0\.1:\d+\n", line)
        page = urllib.request.urlopen(line.split()[1], timeout=20.0).read()
        assert b"<html" in page
        assert process.stderr.readline().startswith("Waiting for a bridge of this user")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=20.0)
    assert process.returncode == 130
    assert "Traceback" not in said


@pytest.fixture
def log(tmp_path: Path) -> Path:
    arm = robots.load("yumi_left")
    t = 0.1 * np.arange(20)
    table = Table(t, {"q": arm.q_home + 0.1 * np.sin(t)[:, None], "tau": np.ones((20, 7))})
    logs.write(table, tmp_path / "run.csv")
    return tmp_path / "run.csv"


def test_a_log_is_played(log: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """A log that tells no robot is given one; the page has its name."""
    shown: list[Player] = []

    def run(player: Player) -> None:
        shown.append(player)
        raise KeyboardInterrupt

    monkeypatch.setattr(Player, "run", run)
    assert main(["view", str(log), "--port", "0"]) == 1
    assert "--robot FILE" in capsys.readouterr().err
    assert main(["view", str(log), "--robot", "yumi_left", "--port", "0"]) == 130
    assert list(shown[0].scene.robots) == ["yumi_left"]
    said = capsys.readouterr()
    assert said.out.startswith("View: http://127.0.0.1:")
    assert "Traceback" not in said.err


def test_a_view_beside_a_run_ends_with_it(alone: None) -> None:
    with beside("nobody") as line:
        port = int(line.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port)):
            pass
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


def test_a_view_that_cannot_begin_says_why(alone: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "viser.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(LinkError, match=r"^Expected viser.*pip install 'armlab\[live\]'"), beside("nobody"):
        pass


def test_meshes_of_a_robot_file_are_looked_for_around_it(tmp_path: Path) -> None:
    """As packages of ROS have them: maker/urdf/arm.urdf names package://maker/meshes/link.stl."""
    file = tmp_path / "maker" / "urdf" / "arm.urdf"
    file.parent.mkdir(parents=True)
    file.write_text("")
    inside = tmp_path.resolve() / "maker"
    assert _folders(["yumi_left", str(file)]) == [inside / "urdf", inside, inside.parent, Path()]
