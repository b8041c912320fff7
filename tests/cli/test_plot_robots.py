"""armlab plot robot, workspace, manipulability: the arm at home, or through a log."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import log, robots
from armlab.cli import main
from armlab.cli.plot.robots import manipulability, robot, workspace
from armlab.log import Table
from armlab.plots.arm import stick


def test_an_arm_at_home_and_through_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    found = {}
    monkeypatch.setattr("armlab.cli.support.output.save_figure", lambda figure, path: found.update({path.name: figure}))
    monkeypatch.chdir(tmp_path)
    arm = robots.load("irb2400")
    q = np.linspace(np.zeros(6), np.ones(6), 20)
    q[-1, 2] = np.nan  # the last one that is whole counts
    run = log.write(Table(np.arange(20.0), {"q": q}), tmp_path / "run.csv")
    assert main(["plot", "robot", "irb2400"]) == 0
    assert main(["plot", "robot", "irb2400", str(run), "--tool-path"]) == 0
    assert main(["plot", "workspace", "irb2400"]) == 0
    assert main(["plot", "manipulability", "irb2400", str(run), "--of", "rotation"]) == 0
    for name, at in (("irb2400_robot.png", arm.q_home), ("run_robot.png", q[-2])):
        (line,) = [line for line in found[name].lines if line.get_gid() == "arm"]
        assert np.array_equal(np.stack(line.get_data_3d(), axis=1), stick(arm, at))
    assert any(line.get_gid() == "path" for line in found["run_robot.png"].lines)
    assert found["irb2400_workspace.png"].axes[0].get_title(loc="left").startswith("irb2400")
    assert "rad/s" in found["run_manipulability.png"].get_title()
    capsys.readouterr()
    assert main(["plot", "robot", "irb9999"]) == 2
    assert "irb9999" in capsys.readouterr().err
    assert all(command.__doc__ for command in (robot, workspace, manipulability))
    plt.close("all")
