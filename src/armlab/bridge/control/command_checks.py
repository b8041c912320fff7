"""What a controller returned: `wanted` gives the references, checked, `refusal` the sentence for a refused one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from armlab.bridge.control.limits import axes_of
from armlab.errors import CommandRefused
from armlab.robots import Robot
from armlab.state import Command
from armlab.wire.egm.axes import Linkage

__all__ = ["entry_refusal", "joint_name", "jump_refusal", "kept", "numbers", "refusal", "wanted"]

JointName = Callable[[int], str]
"""Name of a joint by its index, from 0."""

_DOUBLE = np.dtype(np.float64)
_REAL = "f", "i", "u"  # kinds of numbers; of others a conversion would make some
_NUMBERS = "q", "qd", "tau", "q_ext", "rapid_data"


def wanted(command: Command, robot: Robot) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Return the position, velocity and torque (n,) that a command asks for, None for what it does not."""
    if not isinstance(command, Command):
        raise CommandRefused(
            f"Expected the controller to return a Command or None, got {type(command).__name__}. "
            "Write Command(q) for positions, Command(qd=...) for velocities."
        )
    q, qd, tau = command.q, command.qd, command.tau
    return (
        None if q is None else _vector("q", q, robot),
        None if qd is None else _vector("qd", qd, robot),
        None if tau is None else _vector("tau", tau, robot),
    )


def _vector(name: str, values: Any, robot: Robot) -> np.ndarray:
    if type(values) is np.ndarray and values.dtype == _DOUBLE and values.shape == (robot.n,):
        return np.ascontiguousarray(values)
    try:
        array = numbers(values)
    except Exception as error:  # what a controller returned may be anything
        raise CommandRefused(
            f"Expected {robot.n} numbers in Command.{name} for {robot.name}, got {values!r} ({error})."
        ) from error
    if array.shape != (robot.n,):
        raise CommandRefused(
            f"Expected Command.{name} of shape ({robot.n},) for {robot.name}, got {array.shape}. "
            f"Give one value per joint: {', '.join(robot.joint_names)}."
        )
    return np.ascontiguousarray(array, dtype=np.float64)


def numbers(values: Any) -> np.ndarray:
    """Return what a controller gave as an array of real numbers."""
    array = np.asarray(values)
    if array.dtype.kind not in _REAL:
        raise TypeError(f"of type {array.dtype}")
    return array


def kept(command: Command | None) -> Command | None:
    """Return a command with arrays of its own: while it serves, the controller may write the next one into its own."""
    if not isinstance(command, Command):
        return command
    return replace(command, **{name: _copied(getattr(command, name)) for name in _NUMBERS})


def _copied(values: Any) -> Any:
    try:
        return None if values is None else np.array(values)
    except Exception:  # what a controller returned may be anything
        return values


def refusal(refused: int, q: np.ndarray | None, qd: np.ndarray | None, sent: np.ndarray, robot: Robot) -> str:
    """Return the sentence for a reference that the limits refused."""
    i = abs(refused) - 1
    joint, axes = joint_name(robot, i), axes_of(robot)
    if refused > 0 or q is None:  # only a position can jump
        got = ", ".join(f"{name} = {values[i]}" for name, values in (("q", q), ("qd", qd)) if values is not None)
        return f"Expected finite numbers in the Command, got {got} for {joint}. NaN never goes to a robot."
    return _jumped(axes(q), axes(sent), i, robot, joint)


def jump_refusal(q: np.ndarray, sent: np.ndarray, jump: np.ndarray, robot: Robot, name: JointName) -> str:
    """Return the sentence for a position (n,) further than `jump` (n,) from the last one sent, "" when it is near."""
    axes = axes_of(robot)
    q, sent = axes(q), axes(sent)
    excess = np.abs(q - sent) - jump
    i = int(np.argmax(excess))
    return "" if excess[i] <= 0.0 else _jumped(q, sent, i, robot, name(i))  # NaN is not near


def _jumped(q: np.ndarray, sent: np.ndarray, i: int, robot: Robot, joint: str) -> str:
    return (
        f"Expected a position near the last one sent, {sent[i]:.4f}, for {joint} of {robot.name}, got {q[i]:.4f}: a "
        f"jump of {abs(q[i] - sent[i]):.4f}. Move there gradually. {causes(robot)}"
    )


def entry_refusal(
    q: np.ndarray,
    held: np.ndarray,
    entry: np.ndarray,
    robot: Robot,
    name: JointName | None = None,
    where: str = "holds",
) -> str:
    """Return the sentence for a first position too far from where the arm holds (or is), "" when it is near enough."""
    axes = axes_of(robot)
    q, held = axes(q), axes(held)
    distance = np.abs(q - held)
    far = ~(distance <= entry) & ~np.isnan(q)  # from NaN all is far; NaN in the command is refused as such, and counts
    if not far.any():
        return ""
    i = int(np.argmax(np.where(far, distance / entry, 0.0)))
    joint = joint_name(robot, i) if name is None else name(i)
    return (
        f"Expected the first position within {entry[i]:g} of where the arm {where}, got {q[i]:.4f} for {joint} of "
        f"{robot.name}, which {where} at {held[i]:.4f}. Begin there. {causes(robot)}"
    )


def joint_name(robot: Robot, i: int, first: int | None = None, by_axis: bool = False) -> str:
    """Return what a client calls joint i (from 0), with its place in what was sent."""
    if first is not None:
        return f"{robot.ros_joint_names[i]} (number {first + i + 1} of the message)"
    if by_axis:
        return f"{robot.joint_names[i]} (number {robot.abb_axes[i]} of the vector)"
    return f"joint {i + 1} ({robot.joint_names[i]})"


def causes(robot: Robot) -> str:
    """Return the usual causes of a distant position, and the quantity of the numbers in the refusal."""
    usual = "Usual causes are degrees instead of radians and another joint order."
    are_joints = Linkage.of(robot) is None
    return usual if are_joints else f"{usual} The numbers are those of ABB's axes, of which one may be several joints."
