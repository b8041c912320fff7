"""Each kind of controller: the plain primitive is its rollout; with two degrees of freedom it waits and gives way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.log import Table
from armlab.motion import Dmp, TwoDofDmp
from armlab.motion.control import check_joints
from armlab.motion.dmp.primitive import DmpController
from armlab.motion.two_dof import TwoDofController

PERIOD = 0.004032
ROBOT = robots.load("yumi_right")
REACH = 0.3 * np.array([1, 1, 1, 1, -1, 1, 1])


def test_kinds(reach: Dmp) -> None:
    assert isinstance(reach.controller(ROBOT), DmpController)
    assert isinstance(TwoDofDmp(reach).controller(ROBOT), TwoDofController)


def test_a_plain_primitive_is_its_rollout(arm: Callable[..., Any], reach: Dmp) -> None:
    """It starts at rest, however the demonstration did."""
    moving = replace(reach, v0=np.full(7, 0.1))
    q, _ = arm().run(moving.controller(ROBOT, duration=3.0), 3.0)
    path = reach.rollout(PERIOD * np.arange(len(q)), duration=3.0, v0=np.zeros(7))
    np.testing.assert_allclose(q, path.y, atol=1e-9)


def test_a_held_arm_is_waited_for(arm: Callable[..., Any], reach: Dmp) -> None:
    """What the plain primitive cannot: behind a hold of two seconds it goes on where it was, not where it would be."""
    controller, yumi = TwoDofDmp(reach, e_max=0.3).controller(ROBOT, give_way=lambda _: np.zeros(7)), arm()
    yumi.run(controller, 0.8)
    where = yumi.q
    yumi.held = True
    commands = [yumi.packet(controller) for _ in range(round(2 / PERIOD))]
    assert np.abs(commands[-1].record["path"] - where).max() < 0.1
    assert (commands[-1].record["done"], controller.frozen) == (False, False)


def test_a_frozen_path_is_told_and_thaws(arm: Callable[..., Any], reach: Dmp) -> None:
    controller, yumi = TwoDofDmp(reach, e_max=0.01).controller(ROBOT), arm()
    yumi.run(controller, 0.8)
    yumi.held = True
    last = [yumi.packet(controller) for _ in range(100)][-1]
    assert (controller.frozen, last.record["frozen"]) == (True, True)


def test_it_gives_way_to_what_a_contact_adds(arm: Callable[..., Any], reach: Dmp) -> None:
    free, _ = arm().run(TwoDofDmp(reach, kc=0).controller(ROBOT), 0.5)
    pushed, _ = arm().run(TwoDofDmp(reach, kc=0).controller(ROBOT, give_way=lambda state: np.eye(7)[0]), 0.5)
    assert pushed[-1, 0] - free[-1, 0] > 0.01


def test_a_log_of_the_loop_is_a_run(arm: Callable[..., Any], reach: Dmp) -> None:
    """What the controller records, in a Table of any source, is what `plots.two_dof` draws."""
    two_dof, yumi = TwoDofDmp(reach), arm()
    controller = two_dof.controller(ROBOT)
    rows = []
    for k in range(300):
        yumi.held = 100 <= k < 200
        q, qd = yumi.q, yumi.qd
        rows.append({"q": q, "qd": qd, **yumi.packet(controller).record})
    columns = controller.columns()
    values = {name: np.array([row[name] for row in rows], dtype=float) for name in rows[0]}
    values["path"][0] = np.nan  # a packet for which the controller was not asked
    table = Table(PERIOD * np.arange(300), values, columns=columns)
    run = two_dof.recorded(table, [(0.4, 0.8)])
    np.testing.assert_array_equal(run.yc, values["path"][1:])
    np.testing.assert_array_equal(run.ya, values["q"][1:])
    assert (run.t[0], run.disturbed) == (0.0, ((0.4, 0.8),))
    assert run.tau_a.max() > 5 * reach.tau_d
    np.testing.assert_array_equal(run.free.y[0], values["q"][1])
    with pytest.raises(ShapeError, match="never asked"):
        two_dof.recorded(table.rows(slice(0, 1)))


def test_joints_are_counted_over_all_arms() -> None:
    check_joints([ROBOT, ROBOT], 14)
    with pytest.raises(ShapeError, match="14 joints for yumi_right and yumi_right, got one of 7"):
        check_joints([ROBOT, ROBOT], 7)
