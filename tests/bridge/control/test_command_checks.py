"""What a controller returns, checked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.control.command_checks import entry_refusal, kept, numbers, refusal, wanted
from armlab.errors import CommandRefused
from armlab.robots import Robot
from armlab.state import Command


def test_references_pass(robot: Robot) -> None:
    q, qd, tau = wanted(Command([0.0] * 7, np.ones(7, dtype=np.float32), [1] * 7), robot)  # type: ignore[arg-type]
    assert q is not None
    assert qd is not None
    assert tau is not None
    assert (tau.dtype, tau.sum()) == (np.float64, 7.0)
    assert (q.dtype, qd.dtype) == (np.float64, np.float64)
    assert wanted(Command(), robot) == (None, None, None)
    [halves, whole, _] = wanted(Command(np.full(14, 0.5)[::2], np.ones(7, dtype=np.uint8)), robot)
    assert halves is not None
    assert whole is not None
    assert (halves.sum(), halves.flags.c_contiguous, whole.sum(), whole.dtype) == (3.5, True, 7.0, np.float64)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([0.0] * 7, "got list"),
        (Command(np.zeros(6)), r"shape \(7,\).*got \(6,\)"),
        (Command(qd=np.zeros((1, 7))), r"Command.qd.*got \(1, 7\)"),
        (Command(0.5), r"got \(\)"),  # type: ignore[arg-type]
        (Command(["a"] * 7), "7 numbers in Command.q"),  # type: ignore[arg-type]
        (Command({}), "7 numbers"),  # type: ignore[arg-type]
        (Command(["0.1"] * 7), "7 numbers in Command.q.*of type <U3"),  # type: ignore[arg-type]
        (Command(np.zeros(7, dtype=complex)), "7 numbers in Command.q.*of type complex128"),
        (Command(qd=np.zeros(7) > 0), "7 numbers in Command.qd.*of type bool"),
        (Command(tau=np.array(["0.1"] * 7, dtype=object)), "7 numbers in Command.tau.*of type object"),
        (Command([10**400] * 7), "7 numbers"),  # type: ignore[arg-type]
        (Command(tau=np.zeros(6)), r"Command.tau.*got \(6,\)"),
    ],
)
def test_what_is_no_reference_is_refused(robot: Robot, command: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        wanted(command, robot)


@pytest.mark.parametrize("name", ["q", "qd", "tau", "q_ext", "rapid_data"])
def test_what_is_kept_does_not_change(name: str) -> None:
    for values in (np.zeros(7), [0.0] * 7):
        given: dict[str, Any] = {name: values, "rapid_digital": True, "record": {"x": 1.0}, "ends": True}
        command = kept(Command(**given))
        values[2] = 1.0
        assert command is not None
        np.testing.assert_array_equal(getattr(command, name), np.zeros(7))
        assert (command.rapid_digital, command.record, command.ends) == (True, {"x": 1.0}, True)
        assert sum(getattr(command, one) is not None for one in ("q", "qd", "tau", "q_ext", "rapid_data")) == 1


def test_what_is_no_command_is_kept_to_be_refused(robot: Robot) -> None:
    assert kept(None) is None
    for odd in (3, Command([[1.0], [2.0, 3.0]])):  # type: ignore[list-item]
        with pytest.raises(CommandRefused):
            wanted(kept(odd), robot)  # type: ignore[arg-type]


def test_real_numbers() -> None:
    assert [numbers(values).dtype for values in ([1], [0.5], np.ones(1, "u1"))] == [np.int64, np.float64, np.uint8]
    for odd in (1j, "1", True, None, np.datetime64(1, "s")):
        with pytest.raises(TypeError, match="of type "):
            numbers([odd])


def test_the_sentence_names_joint_and_values(robot: Robot) -> None:
    q = np.zeros(7)
    q[2] = np.nan
    assert f"q = nan for joint 3 ({robot.joint_names[2]})" in refusal(3, q, None, np.zeros(7), robot)
    assert f"got q = nan, qd = 0.0 for joint 3 ({robot.joint_names[2]})" in refusal(3, q, np.zeros(7), q, robot)
    q[2] = 57.3
    sentence = refusal(-3, q, None, np.full(7, 0.3), robot)
    assert f"sent, 0.3000, for joint 3 ({robot.joint_names[2]}), got 57.3000: a jump of 57.0000" in sentence
    assert "degrees" in sentence


def test_entry(robot: Robot) -> None:
    held, entry = np.zeros(7), np.full(7, 0.05)
    assert entry_refusal(held + 0.05, held, entry, robot) == ""
    far = held.copy()
    far[[1, 4]] = [0.06, -0.5]
    assert f"-0.5000 for joint 5 ({robot.joint_names[4]})" in entry_refusal(far, held, entry, robot)
    wide = np.where(np.arange(7) == 4, 0.4, 0.05)
    far[1] = 0.1
    assert "joint 2" in entry_refusal(far, held, wide, robot), "twice what is allowed is more than 1.25 times"


def test_far_is_what_the_axes_are_where_they_are_not_the_joints(robot: Robot) -> None:
    """Of an IRB 2400 axis 3 is the sum of joints 2 and 3: both by 0.04 is far, one against the other is not."""
    linked, entry = robots.load("irb2400"), np.full(6, 0.05)
    q = np.array([0.0, 0.04, 0.04, 0.0, 0.0, 0.0])
    held = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
    assert "got 0.0800 for joint 3 (axis_3), which holds at 0.0100" in entry_refusal(q, held, entry, linked)
    assert entry_refusal(q * [1, 1, -1, 1, 1, 1], held, entry, linked) == ""
    assert "sent, 0.0100, for joint 3 (axis_3), got 0.0800: a jump of 0.0700" in refusal(-3, q, None, held, linked)
    for sentence in (entry_refusal(q, held, entry, linked), refusal(-3, q, None, held, linked)):
        assert "degrees instead of radians" in sentence
        assert "ABB's axes" in sentence
