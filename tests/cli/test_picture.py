"""What all figures have in common: the name of the file, the part of a log, numbers of joints."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import kinematics, log, robots
from armlab.cli import main
from armlab.cli.support.figure_options import (
    BESIDE,
    WHOLE,
    FigureFile,
    Joints,
    OwnRobot,
    Part,
    arm_of,
    joints_in,
    poses_in,
    torque_model,
)
from armlab.errors import ConfigError, LogError, ModelMismatchError
from armlab.lie import se3
from armlab.log import Table
from armlab.models import TorqueModel, save


def test_the_file_stands_beside_its_source(tmp_path: Path) -> None:
    assert BESIDE.path(tmp_path / "run.mcap", "wrench") == tmp_path / "run_wrench.png"
    assert BESIDE.path("ur5e", "workspace") == Path("ur5e_workspace.png")
    assert FigureFile(tmp_path / "mine.svg").path("ur5e", "robot") == tmp_path / "mine.svg"


def test_names_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run_wrench.png").touch()
    with pytest.raises(ConfigError, match="--force"):
        BESIDE.path(tmp_path / "run.mcap", "wrench")
    assert FigureFile(force=True).path(tmp_path / "run.mcap", "wrench").name == "run_wrench.png"
    with pytest.raises(ConfigError, match=r"\.png or \.svg or \.pdf"):
        FigureFile(tmp_path / "a.jpg").path("ur5e", "robot")
    with pytest.raises(ConfigError, match="folder"):
        FigureFile(tmp_path / "none" / "a.png").path("ur5e", "robot")


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_ending_tells_the_format_and_the_path_is_printed(ending: str, tmp_path: Path, capsys) -> None:
    path = tmp_path / f"a.{ending}"
    assert BESIDE.save(plt.figure(figsize=(2, 2)).add_subplot(), path) == 0
    assert capsys.readouterr().out == f"{path}\n"
    assert path.read_bytes().lstrip()[:5] in (b"\x89PNG\r", b"<?xml", b"%PDF-")
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    plt.close("all")


def test_part_of_a_log(tmp_path: Path) -> None:
    path = log.write(Table(np.arange(10.0), {"q": np.zeros((10, 2))}), tmp_path / "run.csv")
    assert len(WHOLE.read(path)) == 10
    assert Part(2.0, 5.0).read(path).t.tolist() == [2.0, 3.0, 4.0]
    assert len(Part(end=5.0).read(path)) == 5
    with pytest.raises(LogError, match=r"from 20 to inf s, got none: it ends at 9\.000 s"):
        Part(20.0).read(path)
    nothing = log.write(Table(np.zeros(0), {"q": np.zeros((0, 2))}), tmp_path / "none.csv")
    with pytest.raises(LogError, match=r"Expected rows in .*none\.csv, got a log without any"):
        WHOLE.read(nothing)


def test_one_arm_of_a_recording_of_both(tmp_path: Path) -> None:
    pieces = [
        log.write(Table(np.arange(3.0), {"q": np.full((3, 7), value)}), tmp_path / f"{name}.mcap", robots.load(name))
        for value, name in ((1.0, "yumi_left"), (2.0, "yumi_right"))
    ]
    both = log.merge(pieces, tmp_path / "both.mcap")
    assert Part(arm="yumi_right").read(both)["q"][0, 0] == 2.0
    with pytest.raises(LogError, match=r"--arm of commands.* which holds yumi_left, yumi_right"):
        WHOLE.read(both)


def test_poses_are_those_of_the_log_or_of_a_robot() -> None:
    q = np.zeros((3, 6))
    T = np.tile(se3.from_rp(np.eye(3), [1.0, 2.0, 3.0]), (3, 1, 1))
    table = Table(np.arange(3.0), {"q": q, "T_frame_tool": T})
    assert np.array_equal(poses_in(table, Path("run.mcap"), None, None), T)
    arm = robots.load("irb2400")
    assert np.array_equal(poses_in(table, Path("run.mcap"), None, "irb2400"), kinematics.forward(arm, q))
    with pytest.raises(LogError, match=r"Add --robot NAME"):
        poses_in(table.select("q"), Path("run.mcap"), None, None)


def test_joints_are_numbers_from_one() -> None:
    assert joints_in("1,3", 3) == [0, 2]
    for wrong in ("one", "0", "1,4", "1,", ""):
        with pytest.raises(ConfigError, match="from 1 to 3 with commas"):
            joints_in(wrong, 3)


def test_options_of_several_figures_are_explained_once(capsys: pytest.CaptureFixture[str]) -> None:
    for name, options in {
        "spectrum": [Joints],
        "two_dof": [Joints],
        "residual_speed": [Joints, OwnRobot],
        "autocorrelation": [Joints, OwnRobot],
        "hypotheses": [OwnRobot],
    }.items():
        assert main(["plot", name, "--help"]) == 0
        told = " ".join(capsys.readouterr().out.replace("│", " ").split())
        for option in options:
            assert get_args(option)[1].help in told


def test_a_model_knows_its_robot(model: TorqueModel, tmp_path: Path) -> None:
    read = torque_model(save(model, tmp_path / "model.toml"))
    assert arm_of(read, None).name == "yumi_left"
    with pytest.raises(ModelMismatchError, match="ur5e"):
        arm_of(read, "ur5e")


def test_joints_of_a_bag_are_those_of_the_robot(ur5e_bag: Path) -> None:
    """In the order of their driver they would be another posture."""
    np.testing.assert_array_equal(Part(end=0.5).read(ur5e_bag, "ur5e")["q"], [np.arange(6.0)])
