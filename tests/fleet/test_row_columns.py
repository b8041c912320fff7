"""`RowColumns`: what a row of the bridge says is what stands in the recording."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.errors import LinkError
from armlab.fleet.row_columns import RowColumns, stamp_of, tick_of
from armlab.log import Tick
from armlab.log.recording.rows import RowLayout
from armlab.robots import Robot
from armlab.state import Command, State

NOT_SENT = {"wake_ns", "qd_source", "tau_source"}  # which rows of the bridge do not have


def made_up(robot: Robot, rng: np.random.Generator) -> tuple[State, Command, Tick]:
    """Every number is random, so that a column in the wrong place shows; the flags change."""
    n = robot.n
    q, qd, tau, planned, sent = rng.normal(size=(5, n))
    state = State(
        t=1.5, dt=0.004, q=q, qd=qd, tau=tau, q_start=q, robot=robot.name, seq=11, session=2, missed=1,
        q_planned=planned, robot_ns=77, motors=2, mci=3, rapid=1, converged=bool(rng.integers(2)),
        T_frame_tool=rng.normal(size=(4, 4)), wrench_raw=rng.normal(size=6), wrench=rng.normal(size=6),
        q_ext=rng.normal(size=2), utilization=4.5,
    )  # fmt: skip
    command = Command(q=q + 1.0, record={"wrench_hat": rng.normal(size=6)})
    clamped = rng.integers(0, 16, n).astype("u1")
    return state, command, Tick(8, 9, 10**18, 10**18 + 1, -1, 55, True, 4, q_sent=sent, clamped=clamped)


def test_a_recording_of_rows_is_that_of_the_bridge() -> None:
    rng = np.random.default_rng(3)
    arms = [robots.load("yumi_left"), robots.load("ur5e")]
    schema = RowSchema.of(arms)
    writer = RowWriter(schema)
    for robot in arms * 6:
        layout = RowLayout(robot)
        state, command, tick = made_up(robot, rng)
        there = layout.unpack([layout.pack(state, command, tick)])
        packed = RowColumns(schema, robot.name, layout).packed(writer.row(state, command, tick, 5))
        here = layout.unpack([packed])
        for name in here.keys() - NOT_SENT:
            np.testing.assert_array_equal(here[name], there[name], err_msg=name)
        assert all(np.isnan(here[name]).all() for name in NOT_SENT)
        assert (stamp_of(packed), tick_of(packed)) == (10**18, 8)


def test_rows_of_others_are_refused() -> None:
    left, right = robots.load("yumi_left"), robots.load("yumi_right")
    schema = RowSchema.of([left])
    with pytest.raises(LinkError, match="rows with the ticks of yumi_right, got those of yumi_left"):
        RowColumns(schema, right.name, RowLayout(right))
    with pytest.raises(LinkError, match=r"yumi_left.q of shape \(6,\) in the rows, got \(7,\)"):
        RowColumns(schema, left.name, RowLayout(robots.load("ur5e")))
    columns = RowColumns(schema, left.name, RowLayout(left))
    row = RowWriter(schema).row(*made_up(left, np.random.default_rng(0)), 5)
    for wrong in (b"", row[:-1], b"X" + row[1:], row[:8] + bytes(8) + row[16:]):
        with pytest.raises(LinkError, match="Expected a row of"):
            columns.packed(wrong)
