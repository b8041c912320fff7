"""What the controller of two arms sees, and which part of its command is whose."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.control.multi_arm import fuse, shares
from armlab.errors import CommandRefused
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def state(robot: str, k: float) -> State:
    return State(
        k, 0.004, np.full(7, k), np.full(7, 2 * k), np.full(7, 3 * k), robot=robot, t_receive=int(k), seq=int(k)
    )


def test_fuse() -> None:
    both = fuse([state("a", 1.0), state("b", 2.0)], [0.003, 0.0], 1, 5.0)
    assert (both.t, both.dt, both.seq, both.robot, both.t_receive) == (5.0, 0.004, 2, "a+b", 2)
    np.testing.assert_array_equal(both.q, [1.0] * 7 + [2.0] * 7)
    np.testing.assert_array_equal(both.tau, [3.0] * 7 + [6.0] * 7)
    assert [arm.age for arm in both.arms] == [0.003, 0.0]
    np.testing.assert_array_equal(both.arms[0].q, np.ones(7))
    assert not both.q.flags.writeable
    assert not both.clamped.flags.writeable
    assert np.isnan(both.T_frame_tool).all()


def test_an_arm_heard_after_the_one_that_paces_has_no_age() -> None:
    both = state("a", 1.0), state("b", 2.0)
    found = fuse(both, [-0.001, 0.0], 1, 5.0)
    assert found.arms[0] is both[0]
    assert found.arms[1] is both[1]


def test_shares_of_a_common_command() -> None:
    q = np.arange(14.0)
    left, right = shares(Command(q, record={"x": 1.0}), [LEFT, RIGHT])
    assert left is not None
    assert right is not None
    np.testing.assert_array_equal(left.q, q[:7])
    np.testing.assert_array_equal(right.q, q[7:])
    assert (left.qd, right.qd) == (None, None)
    assert (left.record, right.record) == ({"x": 1.0}, {})
    assert [one.record for one in shares(Command(q, record={"x": 1.0}), [LEFT, RIGHT], 1) if one] == [{}, {"x": 1.0}]
    assert all(one is not None and one.ends for one in shares(Command.stop(), [LEFT, RIGHT]))


def test_shares_of_three() -> None:
    parts = shares(Command(np.arange(21.0)), [LEFT, RIGHT, LEFT])
    np.testing.assert_array_equal([one.q for one in parts if one is not None], np.arange(21.0).reshape(3, 7))


@pytest.mark.parametrize("name", ["q_ext", "rapid_data", "rapid_digital"])
def test_what_is_for_one_arm_is_not_shared(name: str) -> None:
    with pytest.raises(CommandRefused, match=f"no {name} in a Command of all joints"):
        shares(Command(np.arange(14.0), **{name: np.zeros(1)}), [LEFT, RIGHT])  # type: ignore[arg-type]


def test_shares_of_each() -> None:
    one = Command(np.zeros(7))
    assert shares((one, None), [LEFT, RIGHT]) == (one, None)
    assert shares(None, [LEFT, RIGHT]) == (None, None)
    assert shares(one, [LEFT]) == (one,)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (Command(np.zeros(7)), r"Command.q of shape \(14,\), 7 of yumi_left and 7 of yumi_right, got \(7,\)"),
        (Command(qd=np.zeros((2, 7))), r"Command.qd of shape \(14,\)"),
        ((Command(),) * 3, r"got tuple of 3\. Write"),
        (np.zeros(14), r"got ndarray\. Write"),
    ],
)
def test_wrong_shares(asked: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        shares(asked, [LEFT, RIGHT])
