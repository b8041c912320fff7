"""Synthetic true parameters of the simulated arms: masses, friction, ripple and noise, assumed rather than measured.

Masses and inertias are taken from the robot's description, or assumed for a few library robots without masses.
Manufacturers do not publish drive parameters. As ground truth for identification and force estimation, plausible drive
parameters are generated in proportion to the torque limits. Packets contain only the drives' torque command and gravity
feedforward, which no part of armlab reads. docs/theory/simulated_arm.md describes the rules.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from armlab._display import Shown
from armlab.errors import ConfigError, RobotError, ShapeError, UnknownName
from armlab.robots import Robot, inertia


@dataclass(frozen=True, eq=False, repr=False)
class Truth(Shown):
    """Synthetic parameters of one simulated arm, as arrays (n,) on the joint side unless stated otherwise.

    Attributes
    ----------
    pi : (n, 10) inertial parameters per link, link frames, about their origins:
        ``m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz``.
    rotor : rotor inertia [kg m^2].
    tau_max : torque at which the drives saturate [N m].
    coulomb_pos, coulomb_neg : Coulomb friction for positive and negative motion, both at least 0 [N m].
    static_ratio : ratio of break-away to Coulomb friction.
    stribeck_speed : width of the Stribeck curve [rad/s].
    viscous : viscous friction [N m s/rad].
    offset : constant torque [N m].
    delta : presliding distance [rad].
    ripple : amplitude of the torque ripple [N m].
    ripple_cycles : ripple phase per joint angle [rad/rad], equal to the number of cycles per revolution.
    ripple_phase : phase of the ripple [rad].
    tau_noise : standard deviation of the torque measurement [N m].
    tau_step : quantisation of the torque measurement [N m].
    q_step : quantisation of the position measurement [rad].
    qd_noise : standard deviation of the velocity measurement [rad/s].
    feedforward : fraction of gravity and Coriolis torques that the drives feed forward.
    """

    pi: np.ndarray
    rotor: np.ndarray
    tau_max: np.ndarray
    coulomb_pos: np.ndarray
    coulomb_neg: np.ndarray
    static_ratio: np.ndarray
    stribeck_speed: np.ndarray
    viscous: np.ndarray
    offset: np.ndarray
    delta: np.ndarray
    ripple: np.ndarray
    ripple_cycles: np.ndarray
    ripple_phase: np.ndarray
    tau_noise: np.ndarray
    tau_step: np.ndarray
    q_step: np.ndarray
    qd_noise: np.ndarray
    feedforward: np.ndarray

    def __post_init__(self) -> None:
        """Validate shapes and freeze the arrays."""
        n = len(self.pi)
        for field in fields(self):
            value = np.array(getattr(self, field.name), dtype=np.float64)
            shape = (n, 10) if field.name == "pi" else (n,)
            if value.shape != shape or not np.isfinite(value).all():
                raise ShapeError(f"Expected finite {field.name} of shape {shape} for {n} joints, got {value.shape}.")
            value.flags.writeable = False
            object.__setattr__(self, field.name, value)

    def without(self, *effects: str) -> Truth:
        """Return the true parameters without the given effects.

        Parameters
        ----------
        *effects : effects to remove: "friction", "ripple", "offset", or "noise", which includes the quantisation.

        Raises
        ------
        UnknownName : if an effect is unknown.
        """
        none = np.zeros(len(self.pi))
        columns = {
            "friction": ("coulomb_pos", "coulomb_neg", "viscous"),
            "ripple": ("ripple",),
            "noise": ("tau_noise", "tau_step", "q_step", "qd_noise"),
            "offset": ("offset",),
        }
        for effect in effects:
            if effect not in columns:
                raise UnknownName.among("effect of the simulated arm", effect, columns)
        return replace(self, **{name: none for effect in effects for name in columns[effect]})

    def with_payload(self, mass: float, centre: np.ndarray) -> Truth:
        """Return the ground truth with a point mass added to the last link.

        Parameters
        ----------
        mass : mass [kg].
        centre : (3,) position in the last link's frame [m].

        Raises
        ------
        ConfigError : if the mass is negative.
        """
        if mass < 0:
            raise ConfigError(f"Expected a payload of at least 0 kg, got {mass} kg.")
        pi = self.pi.copy()
        pi[-1] += inertia.from_body(mass, centre, np.zeros((3, 3)))
        return replace(self, pi=pi)


@dataclass(frozen=True)
class _Sizes:
    """Parameters of one robot: link masses [kg], torque limits [N m], rotor inertias [kg m^2], cylinder sizes [m]."""

    mass: tuple[float, ...]
    tau_max: tuple[float, ...]
    rotor: tuple[float, ...]
    radius: float
    shortest: float
    gear: float | None = None  # assumed if the robot file has no gears


_YUMI = _Sizes(
    mass=(1.7, 1.6, 1.4, 1.1, 0.9, 0.5, 0.2),
    tau_max=(40, 40, 25, 25, 10, 10, 5),
    rotor=(0.1,) * 7,  # 1e-5 kg m^2 times the square of the gear ratio 100
    radius=0.045,
    shortest=0.06,
)
_SIZES = {
    "yumi_left": _YUMI,
    "yumi_right": _YUMI,
    "irb2400": _Sizes(
        mass=(95, 60, 45, 20, 8, 2),
        tau_max=(1500, 1800, 1000, 150, 120, 80),
        rotor=(30, 30, 20, 2, 1.5, 1),
        radius=0.10,
        shortest=0.12,
        gear=100.0,
    ),
    "irb7600": _Sizes(
        mass=(700, 450, 350, 120, 60, 20),
        tau_max=(18000, 22000, 14000, 2500, 2200, 1200),
        rotor=(800, 800, 500, 50, 40, 20),
        radius=0.22,
        shortest=0.25,
        gear=100.0,
    ),
}


def _invented(robot: Robot) -> _Sizes | None:
    """Return the assumed parameters of a library robot without masses in its description, otherwise None."""
    sizes = _SIZES.get(robot.name)
    return sizes if sizes and robot.inertias is None and len(sizes.mass) == robot.n else None


def no_masses(robot: Robot) -> str:
    """Return the reason why an arm can be simulated only kinematically, or "" if the arm has masses."""
    if _invented(robot) or (robot.inertias is not None and robot.inertias[:, 0].any()):
        return ""
    return (
        f"the description of {robot.name} has no masses (<inertial> in a URDF, inertias in a TOML file), so it is "
        "simulated kinematically, without torques"
    )


def synthetic_truth(robot: Robot) -> Truth:
    """Return synthetic true parameters: masses from the description, and drive parameters proportional to its torque
    limits.

    A few library robots without inertias have assumed masses. The torque limit of a joint without an effort limit is
    three times the torque required to hold the outstretched arm. Values in `Robot.drives` take precedence.

    Parameters
    ----------
    robot : Robot
        Robot with inertias, or a library robot with assumed masses.

    Returns
    -------
    Truth
        Assumed masses and drive parameters.

    Raises
    ------
    RobotError : if `robot` is not a `Robot`, or has no masses.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    if why := no_masses(robot):
        raise RobotError(f"Expected a robot with masses to simulate its dynamics, got {robot.name}: {why}.")
    gear = np.abs(np.diag(np.linalg.inv(robot.coupling)))
    if robot.inertias is not None:
        tau_max = _torque_limits(robot)
        pi, rotor = robot.inertias, tau_max / ROTOR_ACCELERATION
        gear = np.where(gear > 1, gear, np.where(robot.prismatic, SPINDLE, GEAR))
    else:
        sizes = _SIZES[robot.name]
        tau_max, rotor = np.array(sizes.tau_max, dtype=float), np.array(sizes.rotor, dtype=float)
        links = zip(sizes.mass, robot.links[1:, :3, 3])
        pi = np.array([cylinder(m, p, sizes.radius, sizes.shortest) for m, p in links])
        gear = gear if sizes.gear is None else np.full(robot.n, sizes.gear)
    given = {name: np.array(values) for name, values in robot.drives}

    def drives(name: str, default: np.ndarray) -> np.ndarray:
        values = given.get(name, np.zeros(robot.n))
        return np.where(values > 0, values, default)

    n, slides = robot.n, robot.prismatic
    coulomb = drives("friction", 0.05 * tau_max)
    return Truth(
        pi=pi,
        rotor=drives("rotor", rotor),
        tau_max=tau_max,
        coulomb_pos=1.05 * coulomb,
        coulomb_neg=0.95 * coulomb,
        static_ratio=np.full(n, 1.3),
        stribeck_speed=np.where(slides, 0.01, 0.05),
        viscous=drives("damping", coulomb / robot.qd_max),
        offset=0.01 * tau_max * (-1.0) ** np.arange(n),
        delta=np.where(slides, 2e-5, 1e-4),
        ripple=drives("ripple", 0.01 * tau_max),
        ripple_cycles=2 * gear,
        ripple_phase=np.arange(n, dtype=float),
        tau_noise=drives("noise", 0.005 * tau_max),
        tau_step=0.001 * tau_max,
        q_step=np.where(slides, 2e-6, 1e-5),
        qd_noise=np.where(slides, 2e-4, 1e-3),
        feedforward=np.full(n, 0.9),
    )


ROTOR_ACCELERATION = 100.0  # rad/s^2 or m/s^2: acceleration of the drive alone at its torque limit
GEAR, SPINDLE = 100.0, 600.0  # default transmission ratios: gear, and spindle with 10 mm lead [rad/m]
HOLDING = 3.0  # ratio of the torque limit to the torque required to hold the outstretched arm
SHORTEST_LEVER = 0.02  # m
WEAKEST = 0.05  # assumed minimum holding torque, relative to the largest


def _torque_limits(robot: Robot) -> np.ndarray:
    """Return the torque or force limits (n,); default: three times the torque required to hold the outstretched arm."""
    if np.isfinite(robot.tau_max).all() or robot.inertias is None:
        return robot.tau_max
    mass, g = robot.inertias[:, 0], max(float(np.linalg.norm(robot.gravity)), 9.8)
    centre = np.linalg.norm(inertia.to_body(robot.inertias).centre, axis=1)
    strokes = np.where(robot.prismatic, np.nan_to_num(np.maximum(-robot.q_min, robot.q_max), posinf=0.0), 0.0)
    along = np.cumsum(np.linalg.norm(robot.links[:-1, :3, 3], axis=1) + strokes)
    reach = np.maximum(along + centre - along[:, None], SHORTEST_LEVER)  # (joint, mass): link lengths between them
    beyond = np.triu(np.ones((robot.n, robot.n)))
    hold = g * np.where(robot.prismatic, beyond @ mass, (beyond * reach) @ mass)
    least = WEAKEST * hold.max() / np.where(robot.prismatic, max(float(along[-1]), 0.1), 1.0)
    return np.where(np.isfinite(robot.tau_max), robot.tau_max, HOLDING * np.maximum(hold, least))


def cylinder(mass: float, p: np.ndarray, radius: float, shortest: float) -> np.ndarray:
    """Return the inertial parameters (10,) of a solid cylinder from the link frame's origin to the next origin p [m].

    Centre ``p / 2``, axis along p (z if p = 0), length ``L = max(|p|, shortest)``, ``I_axial = m r^2 / 2`` and
    ``I_across = m (3 r^2 + L^2) / 12``, moved to the origin by the parallel-axis theorem.
    """
    length = float(np.linalg.norm(p))
    axis = p / length if length > 0 else np.array([0.0, 0.0, 1.0])
    length = max(length, shortest)
    across, axial = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    return inertia.from_body(mass, p / 2, across * np.eye(3) + (axial - across) * np.outer(axis, axis))
