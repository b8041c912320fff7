"""Synthetic truth of the simulated arms: masses, friction, ripple, noise. Assumptions, not measurements.

No manufacturer publishes these numbers. They are invented in believable proportions so that identification and force
estimation can be judged against something known. They live here only: never in the robot library, and the wire carries
no more of them than the drives' own torque command and gravity feed-forward, which no part of armlab reads.
The rule of the set is in docs/theory/simulated_arm.md.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from armlab.errors import ConfigError, RobotError, ShapeError, UnknownName
from armlab.robots import Robot, inertia


@dataclass(frozen=True, eq=False)
class Truth:
    """Synthetic parameters of one simulated arm; arrays are (n,), joint side, unless said otherwise.

    Attributes
    ----------
    pi : (n, 10) inertial parameters per link, link frames, about their origins:
        ``m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz``.
    rotor : inertia of the rotors [kg m^2].
    tau_max : torque at which the drives saturate [N m].
    coulomb_pos, coulomb_neg : Coulomb friction for positive and negative motion, both counted positive [N m].
    static_ratio : break-away over Coulomb friction.
    stribeck_speed : width of the Stribeck curve [rad/s].
    viscous : [N m s/rad].
    offset : [N m].
    delta : presliding distance [rad].
    ripple : amplitude [N m].
    ripple_cycles : [rad/rad], so cycles per turn.
    ripple_phase : [rad].
    tau_noise : standard deviation of the torque measurement [N m].
    tau_step : its quantisation [N m].
    q_step : quantisation of the position measurement [rad].
    qd_noise : standard deviation of the velocity [rad/s].
    feedforward : the part of its own gravity and Coriolis torques that the drive knows in advance.
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
        """Check shapes and freeze the arrays."""
        n = len(self.pi)
        for field in fields(self):
            value = np.array(getattr(self, field.name), dtype=np.float64)
            shape = (n, 10) if field.name == "pi" else (n,)
            if value.shape != shape or not np.isfinite(value).all():
                raise ShapeError(f"Expected finite {field.name} of shape {shape} for {n} joints, got {value.shape}.")
            value.flags.writeable = False
            object.__setattr__(self, field.name, value)

    def without(self, *effects: str) -> Truth:
        """Return the truth with whole effects switched off: "friction", "ripple", "noise" or "offset".

        Parameters
        ----------
        *effects : what to switch off. "noise" includes the quantisation of what is measured.

        Raises
        ------
        UnknownName : when there is no such effect.
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
        """Return the truth with a point mass fixed to the last link.

        Parameters
        ----------
        mass : [kg].
        centre : (3,) position in the last link's frame [m].

        Raises
        ------
        ConfigError : when the mass is negative.
        """
        if mass < 0:
            raise ConfigError(f"Expected a payload of at least 0 kg, got {mass} kg.")
        pi = self.pi.copy()
        pi[-1] += inertia.from_body(mass, centre, np.zeros((3, 3)))
        return replace(self, pi=pi)


@dataclass(frozen=True)
class _Sizes:
    """What differs between robots: link masses [kg], cylinder sizes [m], torque limits [N m], rotors [kg m^2]."""

    mass: tuple[float, ...]
    tau_max: tuple[float, ...]
    rotor: tuple[float, ...]
    radius: float
    shortest: float
    gear: float | None = None  # assumed where the robot's file has no gears


_YUMI = _Sizes(
    mass=(1.7, 1.6, 1.4, 1.1, 0.9, 0.5, 0.2),
    tau_max=(40, 40, 25, 25, 10, 10, 5),
    rotor=(0.1,) * 7,  # 1e-5 kg m^2 times a gear of 100 squared
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


def truth_names() -> tuple[str, ...]:
    """Return the names of the robots that have a synthetic truth, so that they can be simulated."""
    return tuple(sorted(_SIZES))


def synthetic_truth(robot: Robot) -> Truth:
    """Return the synthetic truth of a library robot (assumptions, see the module).

    Parameters
    ----------
    robot : a robot whose name is in `truth_names`.

    Raises
    ------
    UnknownName : when nothing was assumed for this robot. RobotError : no robot.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    if robot.name not in _SIZES:
        raise UnknownName.among("robot with synthetic masses", robot.name, _SIZES)
    sizes = _SIZES[robot.name]
    n, tau_max = robot.n, np.array(sizes.tau_max, dtype=float)
    if len(tau_max) != n:
        raise ShapeError(f"Expected {len(tau_max)} joints in robot {robot.name!r}, got {n}.")
    coulomb = 0.05 * tau_max
    gear = np.abs(np.diag(np.linalg.inv(robot.coupling))) if sizes.gear is None else np.full(n, sizes.gear)
    return Truth(
        pi=np.array([cylinder(m, p, sizes.radius, sizes.shortest) for m, p in zip(sizes.mass, robot.links[1:, :3, 3])]),
        rotor=np.array(sizes.rotor, dtype=float),
        tau_max=tau_max,
        coulomb_pos=1.05 * coulomb,
        coulomb_neg=0.95 * coulomb,
        static_ratio=np.full(n, 1.3),
        stribeck_speed=np.full(n, 0.05),
        viscous=coulomb / robot.qd_max,
        offset=0.01 * tau_max * (-1.0) ** np.arange(n),
        delta=np.full(n, 1e-4),
        ripple=0.01 * tau_max,
        ripple_cycles=2 * gear,
        ripple_phase=np.arange(n, dtype=float),
        tau_noise=0.005 * tau_max,
        tau_step=0.001 * tau_max,
        q_step=np.full(n, 1e-5),
        qd_noise=np.full(n, 1e-3),
        feedforward=np.full(n, 0.9),
    )


def cylinder(mass: float, p: np.ndarray, radius: float, shortest: float) -> np.ndarray:
    """Return the inertial parameters (10,) of a solid cylinder from a link frame's origin to the next one at p [m].

    ``centre = p / 2``, axis along p (z where p = 0), length ``max(|p|, shortest)``;
    ``I_axial = m r^2 / 2``, ``I_across = m (3 r^2 + L^2) / 12``, moved to the origin by Steiner's rule.
    """
    length = float(np.linalg.norm(p))
    axis = p / length if length > 0 else np.array([0.0, 0.0, 1.0])
    length = max(length, shortest)
    across, axial = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    return inertia.from_body(mass, p / 2, across * np.eye(3) + (axial - across) * np.outer(axis, axis))
