"""``armlab view``: usage errors, normal exit on Ctrl-C, and a separate process for a view opened during a run."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log as logs
from armlab import robots
from armlab.cli import main
from armlab.cli.support.options import mesh_option, take_robot_options
from armlab.cli.view import _mesh_folders, beside
from armlab.errors import LinkError
from armlab.live import Player
from armlab.log import Table

pytest.importorskip("viser", reason="the view in the browser needs the extra `live`")


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def test_a_port_that_is_taken(alone: None, capsys: Any) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["view", "--live", "--port", str(taken.getsockname()[1])]) == 1
    assert "in use. Choose another port with --port" in capsys.readouterr().err


@pytest.fixture
def log(tmp_path: Path) -> Path:
    arm = robots.load("yumi_left")
    t = 0.1 * np.arange(20)
    table = Table(t, {"q": arm.q_home + 0.1 * np.sin(t)[:, None], "tau": np.ones((20, 7))})
    logs.write(table, tmp_path / "run.csv")
    return tmp_path / "run.csv"


def test_a_log_is_played(log: Path, monkeypatch: pytest.MonkeyPatch, command, capsys) -> None:
    shown: list[Player] = []

    def run(player: Player) -> None:
        shown.append(player)
        raise KeyboardInterrupt

    monkeypatch.setattr(Player, "run", run)
    assert "--robot FILE" in command(["view", log, "--port", "0"], 1).err
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


def test_a_view_gets_the_description_that_may_have_meshes() -> None:
    take_robot_options(["--tip", "panda_hand", "--lock", "a=0", "--lock", "b=0.1"])
    chosen = ["--tip", "panda_hand", "--lock", "a=0,b=0.1"]
    assert mesh_option("panda_description") == ["--robot", "panda_description", *chosen]
    assert take_robot_options(mesh_option("arm.urdf")) == ["--robot", "arm.urdf"]
    assert mesh_option("arm.urdf") == ["--robot", "arm.urdf", *chosen]
    assert mesh_option("panda") == mesh_option("arm.toml") == []
    take_robot_options([])


def test_a_view_that_cannot_begin_says_why(alone: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "viser.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(LinkError, match=r"^Expected the package viser.*pip install 'armlab\[live\]'"), beside("nobody"):
        pass


def test_meshes_of_a_robot_file_are_looked_for_around_it(tmp_path: Path) -> None:
    """As laid out in ROS packages: maker/urdf/arm.urdf names package://maker/meshes/link.stl."""
    file = tmp_path / "maker" / "urdf" / "arm.urdf"
    file.parent.mkdir(parents=True)
    file.write_text("")
    inside = tmp_path.resolve() / "maker"
    found = _mesh_folders(["yumi_left", str(file)], [tmp_path])
    assert [*found[:4], found[-1]] == [tmp_path, inside / "urdf", inside, inside.parent, Path()]
