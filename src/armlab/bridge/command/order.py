"""`Order`: what a client wants an arm to do, and `read_order`, which tells whether it can be a command at all."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from armlab.robots import Robot
from armlab.state import Command

__all__ = ["Order", "called", "read_order"]


def called(robot: Robot, i: int, first: int | None = None, by_axis: bool = False) -> str:
    """Return what a joint is called by the client that commands it, with its place in what was sent.

    robot : the arm. i : index of the joint, from 0.
    first : place of the arm's first number in a ROS message, from 0; None for a command that was none.
    by_axis : the numbers of a command that was none stood in ABB's order, axes 1 to n.
    """
    if first is not None:
        return f"{robot.ros_joint_names[i]} (number {first + i + 1} of the message)"
    if by_axis:
        return f"{robot.joint_names[i]} (number {robot.abb_axes[i]} of the vector)"
    return f"joint {i + 1} ({robot.joint_names[i]})"


class Order(NamedTuple):
    """What a client wants an arm to do next.

    Attributes
    ----------
    client : identity of the connection, first its server: "labcomm 127.0.0.1:40312". arm : name of the robot.
    q, qd, tau : (n,) references, None for not commanded. seq : number in the client's order, None without one.
    first : place of the first number in the ROS message, which may be for several arms; None when it came otherwise.
    by_axis : the client's own vectors are in ABB's order of axes, for sentences to it; q, qd and tau never are.
    """

    client: str
    arm: str
    q: Any = None
    qd: Any = None
    tau: Any = None
    seq: int | None = None
    first: int | None = None
    by_axis: bool = False

    @property
    def server(self) -> str:
        """Name of the server it came through."""
        return self.client.partition(" ")[0]


def read_order(order: Order, robot: Robot, has_torque: bool = False) -> tuple[Command, str]:
    """Return the command of an order, and what is wrong with it, "" when nothing is; one bad number refuses it."""
    values: dict[str, np.ndarray | None] = {}
    for name in ("q", "qd", "tau"):
        values[name], problem = _vector(order, name, robot)
        if problem:
            return Command(), problem
    if values["tau"] is not None and not has_torque:
        problem = f"Expected no torque: {robot.name} takes none here. A cell allows it by `torque` of the robot."
        return Command(), problem
    if all(value is None for value in values.values()):
        return Command(), f"Expected a position, a velocity or a torque for {robot.name}, got none."
    return Command(values["q"], values["qd"], values["tau"]), ""


def _vector(order: Order, name: str, robot: Robot) -> tuple[np.ndarray | None, str]:
    """Return the (n,) numbers of a command, and what is wrong with them."""
    values = getattr(order, name)
    if values is None:
        return None, ""
    try:
        array = np.array(values, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != (robot.n,):
        return None, f"Expected {robot.n} numbers in {name} for {robot.name}, got {np.shape(array)}."
    if not np.isfinite(array).all():
        joint = called(robot, int(np.argmin(np.isfinite(array))), order.first, order.by_axis)
        return None, f"Expected finite numbers in {name} for {robot.name}, but that of {joint} is not."
    array.flags.writeable = False
    return array, ""
