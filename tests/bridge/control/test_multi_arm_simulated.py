"""Two simulated arms in one loop: repeatable, in real time, and their files after a kill."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from armlab import bridge, log, robots
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def sway(now: State) -> Command:
    return Command(now.q_start + 0.05 * np.sin(3.0 * now.t))


@pytest.mark.slow  # 3 s; examples/19_teleoperation.py runs both in the default run
def test_two_arms_of_the_simulator_are_repeatable() -> None:
    tables = []
    for url in (
        "sim://yumi_left+yumi_right?lockstep=true&seed=4",
        ["sim://yumi_left?lockstep=true&seed=4", "sim://yumi_right?lockstep=true&seed=4"],
    ):
        with bridge.connect(url, [LEFT, RIGHT]) as link:
            tables.append(link.run(sway, seconds=0.3).table)
    one, two = tables
    for name in ("q", "tau", "q_sent", "robot_ns"):
        for robot in ("yumi_left", "yumi_right"):
            np.testing.assert_array_equal(one[f"{robot}.{name}"], two[f"{robot}.{name}"])
    assert np.ptp(one["yumi_right.q"], axis=0).min() > 0.01


@pytest.mark.slow  # 3 s
def test_two_arms_of_one_cell_may_have_different_seeds() -> None:
    tables = []
    for seed in (4, 5):
        urls = ["sim://yumi_left?lockstep=true&seed=4", f"sim://yumi_right?lockstep=true&seed={seed}"]
        with bridge.connect(urls, [LEFT, RIGHT]) as link:
            tables.append(link.run(sway, seconds=0.1).table)
    one, other = ({name: table[f"{name}.tau"][:5] for name in ("yumi_left", "yumi_right")} for table in tables)
    np.testing.assert_array_equal(one["yumi_left"], other["yumi_left"])
    assert (one["yumi_right"] != other["yumi_right"]).any(axis=1).all()


@pytest.mark.slow  # 2 s
def test_two_arms_in_real_time() -> None:
    with bridge.connect("sim://yumi_left+yumi_right", [LEFT, RIGHT]) as link:
        run = link.run(sway, seconds=0.5)
    for arm in run.arms:
        counted = arm.statistics
        assert counted["replies"] + counted["overtaken"] == counted["packets"]
        assert np.nanmax(arm.table["q_sent"][:, 0]) - arm.table["q"][0, 0] > 0.01


_PROGRAM = """
import sys
import numpy as np
from armlab import bridge, robots
from armlab.state import Command
pair = [robots.load("yumi_left"), robots.load("yumi_right")]
told = []
def controller(state):
    if state.t > 1.2 and not told:
        told.append(print("running", flush=True))
    return Command(state.q_start + 0.05 * np.sin(state.t))
with bridge.connect("sim://yumi_left+yumi_right", pair) as link:
    link.run(controller, record=sys.argv[1])
"""


@pytest.mark.slow  # 3 s
def test_both_files_survive_a_kill(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _PROGRAM, str(tmp_path / "run.mcap")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "running\n"
        program.kill()
    for name in ("runleft.mcap", "runright.mcap"):
        with pytest.warns(UserWarning, match="was not finished"):
            table = log.read(tmp_path / name)
        assert table.t[-1] > 0.2
        assert np.isfinite(table["q"]).all()
        np.testing.assert_array_equal(np.diff(table["tick"]), 1)
