"""What a client wants, read whole or refused whole. What an arbiter makes of it is in `test_rights`."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.arbiter import Order, read_order
from armlab.bridge.control.command_checks import joint_name

LEFT = robots.load("yumi_left")
HOME = np.array(LEFT.q_home)


def test_an_order_becomes_a_command() -> None:
    order = Order("labcomm 127.0.0.1:7", "yumi_left", HOME.tolist(), np.ones(7))
    command, problem = read_order(order, LEFT)
    assert (order.server, problem, command.tau) == ("labcomm", "", None)
    assert command.q is not None
    np.testing.assert_array_equal(command.q, HOME)
    assert not command.q.flags.writeable
    command, problem = read_order(Order("a", "yumi_left", tau=np.ones(7)), LEFT, has_torque=True)
    assert (command.q, problem) == (None, "")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"q": HOME[:6]}, "7 numbers in q"),
        ({"qd": [[1.0], [2.0, 3.0]]}, "7 numbers in qd"),
        ({"q": HOME, "qd": np.full(7, np.nan)}, "finite numbers in qd .* joint 1"),
        ({"q": HOME, "tau": np.zeros(7)}, "no torque"),
        ({}, "a position, a velocity or a torque"),
    ],
)
def test_one_bad_number_refuses_all(fields: dict[str, Any], words: str) -> None:
    command, problem = read_order(Order("a", "yumi_left", **fields), LEFT)
    assert command.q is None
    assert re.search(words, problem)


def test_a_joint_is_called_as_its_client_knows_it() -> None:
    """ABB calls the third joint of a YuMi the seventh; in ROS they count from the base."""
    yumi = robots.load("yumi_right")
    assert joint_name(yumi, 2, None) == f"joint 3 ({yumi.joint_names[2]})"
    assert joint_name(yumi, 2, 7) == "yumi_robr_joint_3 (number 10 of the message)"
    assert joint_name(yumi, 2, by_axis=True) == "axis_7 (number 7 of the vector)"
    assert joint_name(yumi, 3, by_axis=True) == "axis_3 (number 3 of the vector)"
