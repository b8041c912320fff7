"""What of a row is in which message: every form by its message, and what is absent."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.ros.mapping import FORMS, Arm, Columns, Form, Kind
from armlab.bridge.servers.row import RowSchema, RowWriter, places
from armlab.log import Tick
from armlab.state import Command, State

ROBOT = robots.load("irb120")
SCHEMA = RowSchema.of([ROBOT])
NOTHING = np.full(6, np.nan)


def arm(q: np.ndarray, command: Command | None = None) -> Arm:
    state = State(1.0, 0.004, q, NOTHING, NOTHING, robot=ROBOT.name)
    data = RowWriter(SCHEMA).row(state, command, Tick(7, 7, 3, 1_000, 2_000, 3), 2)
    return Arm(ROBOT, places(SCHEMA, ROBOT.name), data, 3)


@pytest.mark.parametrize("name", FORMS)
def test_nothing_else_of_a_row_is_in_a_message(name: str) -> None:
    form: Form = FORMS[name]
    record = {"wrench_hat": np.arange(6.0), "wrench_hat_cov": np.eye(6)}
    full = Command(np.arange(6.0), np.arange(6.0), record=record)
    columns: Columns | None = form.columns(arm(np.linspace(0.1, 0.6, 6), full))
    if name in ("wrench", "joint_states_sent"):
        assert columns is None  # this row has none
        return
    assert columns is not None
    message = form.message(ROBOT, 1_000_000_002, columns)
    assert message.__msgtype__ == form.type
    if hasattr(message, "header"):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 2)
    assert all(field in places(SCHEMA, ROBOT.name) for field in form.fields)
    assert (form.kind is Kind.OTHER) == (form.other is not None)


def test_what_is_absent_has_no_numbers() -> None:
    q, command = np.linspace(0.1, 0.6, 6), Command(qd=np.arange(6.0))
    assert FORMS["joint_states"].columns(arm(q)) == (tuple(q), (), ())
    assert FORMS["joint_states_ref"].columns(arm(q, command)) == ((), tuple(np.arange(6.0)), ())
    for name in ("joint_states", "tcp_pose", "joint_states_ref", "wrench_hat", "wrench_hat_covariance"):
        assert FORMS[name].columns(arm(NOTHING)) is None
