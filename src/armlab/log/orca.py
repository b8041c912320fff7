"""`from_orca`: the joints of an arm in a log of orca or ExtCtrl, on the joint side and from base to tool.

Such logs have one column per signal of a motor, ``irb2ext.robot[0].joint[2].posRawAbs``: motor angles in ABB's order of
axes. `read_csv` reads them as lc2csv writes them, `read_labcomm` the stream itself; old names with ``_`` for ``. [ ]``
are the same.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import LogError, RobotError, ShapeError
from armlab.log.column import Column
from armlab.log.labels import alias
from armlab.log.table import Table

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["from_orca"]

SIGNALS = {"q": ("posRawAbs",), "qd": ("velFlt", "velRaw"), "tau": ("trqRaw",)}
UNITS = {"q": "rad", "qd": "rad/s", "tau": "N m"}


def from_orca(table: Table, robot: Robot, arm: int) -> Table:
    """Return q, qd and tau of one arm: ``q = G q_motor``, ``qd = G qd_motor``, ``tau = G⁻ᵀ tau_motor``.

    The order of axes comes first, then the gears G, whose torque keeps the power. Velocity is velFlt, velRaw where
    there is none.

    Parameters
    ----------
    table : of `read_csv` or `read_labcomm`. robot : its order of axes and its gears.
    arm : number of the arm in the file, from 0: robot[0], robot[1].

    Returns
    -------
    Table : what there is of q (N, n) [rad], qd [rad/s] and tau [N m], on the same clock.

    Raises
    ------
    LogError : no positions of this arm (lists the arms there are), a joint that is missing, or a unit that is not that
        of a motor. ShapeError, RobotError : something else than a table, than a robot.

    Reference: Robotlib.jl, src/read_log.jl and README, whose ``q GR⁻ᵀ`` for torques is ``G⁻¹``: the same for gears
    without coupling only.
    """
    from armlab.robots import Robot
    from armlab.robots.couplings import abb_to_logical, motor_to_joint, motor_torque_to_joint

    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    values = {}
    for name, signals in SIGNALS.items():
        blocks = [_motors(table, robot, arm, signal, UNITS[name]) for signal in signals]
        found = [block for block in blocks if block is not None]
        if found:
            motors = abb_to_logical(robot, found[0])
            values[name] = motor_torque_to_joint(robot, motors) if name == "tau" else motor_to_joint(robot, motors)
    if "q" not in values:
        arms = sorted({match[1] for name in table.names if (match := re.search(r"robot_(\d+)__joint_", alias(name)))})
        have = f"arms {', '.join(arms)}" if arms else f"columns {', '.join(table.names[:5])}, ..."
        raise LogError(f"Expected columns robot[{arm}].joint[0].posRawAbs and so on, got {have}. Name another arm.")
    return Table(
        table.t,
        values,
        {name: Column(labels=robot.joint_names) for name in values},
        t0_ns=table.t0_ns,
        clock=table.clock,
        notes=table.notes,
        source=(*table.source, f"from_orca({robot.name}, arm {arm})"),
    )


def _motors(table: Table, robot: Robot, arm: int, signal: str, unit: str) -> np.ndarray | None:
    """Return the signal (N, n) of all motors in ABB's order, None where there is none; axes beyond n are external."""
    pattern = re.compile(rf"(?:^|_)robot_{re.escape(str(arm))}__joint_(\d{{1,3}})__{signal}$")
    found: dict[int, str] = {}
    for name in table.names:
        match = pattern.search(alias(name))
        if match and int(match[1]) < robot.n:
            if int(match[1]) in found:
                raise LogError(
                    f"Expected one {signal} per joint, got {found[int(match[1])]} and {name}. Drop one of them."
                )
            found[int(match[1])] = name
    if not found:
        return None
    missing = [joint for joint in range(robot.n) if joint not in found]
    if missing:
        raise LogError(
            f"Expected {signal} of {robot.n} joints of robot[{arm}] for {robot.name!r}, got none of joint {missing}. "
            "Name the robot that was logged."
        )
    for name in found.values():
        if table.units[name] not in ("1", unit):
            raise LogError(f"Expected {name} in {unit} of the motor, got {table.units[name]}. Convert it.")
    return np.stack([table[found[joint]] for joint in range(robot.n)], axis=1)
