"""How well a motion will tell the parameters, before the robot has moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import number
from armlab.errors import RobotError, ShapeError
from armlab.estimation import Excitation
from armlab.identify.base_parameters import base_parameters
from armlab.identify.trajectory import Trajectory
from armlab.robots import Robot

__all__ = ["Expectation", "expectation"]

RATE = 250.0  # Hz, of the log that will be
THINNED = 50.0  # Hz, at which the regressor is evaluated
GROUPS = (("first moments", "kg m"), ("inertias", "kg m^2"), ("viscous", "N m s/rad"), ("Coulomb", "N m"))
GROUPS = (*GROUPS, ("offset", "N m"))


@dataclass(frozen=True, eq=False)
class Expectation:
    """What a motion will tell.

    Attributes
    ----------
    names, units : of the d parameters: base parameters, then viscous, coulomb+, coulomb-, offset of each joint.
    groups : (d,) the group of each.
    sd : (d,) expected standard deviations for white torque noise.
    excitation : what the motion tells apart.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: tuple[str, ...]
    sd: np.ndarray
    excitation: Excitation

    def rows(self) -> list[tuple[str, ...]]:
        """Return per group: parameters, median and largest expected deviation, the worst by name; the head first."""
        rows = [("group", "unit", "parameters", "median sd", "largest sd", "of")]
        for group, unit in GROUPS:
            places = [i for i, name in enumerate(self.groups) if name == group]
            if not places:
                continue
            worst = max(places, key=lambda i: self.sd[i])
            median = float(np.median(self.sd[places]))
            rows.append(
                (group, unit, str(len(places)), f"{median:.2g}", f"{self.sd[worst]:.2g}", _leader(self.names[worst]))
            )
        return rows


def expectation(trajectory: Trajectory, robot: Robot, noise: float = 0.1) -> Expectation:
    """Return how well a motion will tell the parameters of the torque model.

    The covariance is ``s^2 (A^T A)^-1`` with the regressor A of base parameters and friction along the motion,
    logged at 250 Hz. Real residuals are coloured: expect deviations a few times larger, in the same order.

    Parameters
    ----------
    trajectory : of `excitation`. robot : its arm.
    noise : standard deviation of each torque sample [N m]; the expected deviations are in proportion to it.

    Raises
    ------
    ShapeError : noise that is not above zero, something else than a motion, or one of another number of joints.
    RobotError : something else than a robot.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    if not isinstance(trajectory, Trajectory):
        raise ShapeError(f"Expected a Trajectory, got {type(trajectory).__name__}. identify.excitation gives one.")
    n, noise = robot.n, number(noise, "the torque noise [N m]")
    if not 0 < noise < np.inf or trajectory.q_first.shape != (n,):
        raise ShapeError(
            f"Expected a torque noise above 0 N m and a motion of {n} joints, got {noise:g} and "
            f"{trajectory.q_first.shape}. Give the deviation of the torque signal at rest."
        )
    q, qd, qdd = trajectory.sample(np.arange(0.0, trajectory.seconds, 1.0 / THINNED))
    base = base_parameters(robot)
    rotor = np.zeros((len(q), n, n))
    rotor[:, range(n), range(n)] = qdd
    rigid = np.concatenate([robot.chain.rigid_regressor(q, qd, qdd, robot.gravity), rotor], axis=2)[:, :, base.kept]
    p = len(base.names)
    A = np.zeros((len(q), n, p + 4 * n))
    A[:, :, :p] = rigid
    for i in range(n):
        local = [qd[:, i], np.maximum(np.sign(qd[:, i]), 0.0), np.minimum(np.sign(qd[:, i]), 0.0), np.ones(len(q))]
        A[:, i, p + 4 * i : p + 4 * i + 4] = np.stack(local, axis=1)
    kinds = (("viscous", "N m s/rad"), ("coulomb+", "N m"), ("coulomb-", "N m"), ("offset", "N m"))
    joints = [(f"{kind} {joint}", unit) for joint in robot.joint_names for kind, unit in kinds]
    names = (*base.names, *(name for name, _ in joints))
    units = (*base.units, *(unit for _, unit in joints))
    R = np.linalg.qr(A.reshape(-1, len(names)), mode="r") * np.sqrt(RATE / THINNED) / noise
    found = Excitation.of(R, names)
    inverse = (found.vectors / np.maximum(found.singular_values, 1e-12)) / found.scale[:, None]
    sd = np.sqrt(np.sum(inverse**2, axis=1))
    return Expectation(names, units, tuple(_group(name, unit) for name, unit in zip(names, units)), sd, found)


def _group(name: str, unit: str) -> str:
    if name.startswith("coulomb"):
        return "Coulomb"
    if name.startswith(("viscous", "offset")):
        return name.split()[0]
    return "first moments" if unit == "kg m" else "inertias"


def _leader(name: str) -> str:
    """Return the leading symbol of a combination."""
    return name.split(" + ")[0].split(" - ")[0]
