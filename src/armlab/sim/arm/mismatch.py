"""`Mismatch`: differences between the simulated arm and its description; all are 0 by default.

Errors per joint, link or axis are uniformly distributed between minus and plus the parameter. Each parameter has its
own random stream, so changing one parameter does not affect the errors of the others.

    geometry   base_turn, base_shift, link_length, joint_zero: frames of the simulated arm, not of its description
    dynamics   mass, centre, payload, friction, saturation: parameters of the bodies and drives
    friction   warm_up, load_friction, ripple_jump, offset_drift: dependence on more than position and velocity
    sensors    elasticity, torque_delay, torque_constant, gear_ratio, gear_sign, quantisation: readings
    recording  jitter, lost: time stamps and samples

The fields are options of ``armlab sim``, whose help loads this file, so NumPy is imported only to draw random errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from armlab._display import Shown
from armlab.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

    from armlab.robots import Robot
    from armlab.sim.arm.truth import Truth


PAYLOAD_AT = (0.0, 0.0, 0.06)  # m, centre of the unmodelled payload, tool axes
SHARES = ("gear_ratio", "mass", "friction", "warm_up", "load_friction", "saturation", "lost", "torque_constant")
COUNTS = ("gear_sign", "torque_delay", "seed")


@dataclass(frozen=True, repr=False)
class Mismatch(Shown):
    """Differences between the simulated arm and its description; by default, the arm matches its description exactly.

    Attributes
    ----------
    base_turn : float
        Rotation error of the mount about each of its axes [rad].
    base_shift : float
        Position error of the mount along each of its axes [m].
    link_length : float
        Error of each coordinate of the translation from one joint frame to the next [m].
    joint_zero : float
        Offset of each joint's zero position [rad or m].
    mass : float
        Relative error of each link's mass and inertia.
    centre : float
        Shift of each link's centre of mass along each axis [m].
    payload : float
        Unmodelled payload, 60 mm beyond the tool point along its z axis [kg].
    friction : float
        Relative error of each joint's friction: Coulomb, static and viscous.
    saturation : float
        Relative reduction of each drive's torque range.
    warm_up : float
        Relative reduction of viscous friction in a warm drive; time constant 12 minutes, cold at the start.
    load_friction : float
        Maximum increase of a joint's Coulomb friction per unit of torque transmitted to its link.
    ripple_jump : float
        Phase jump of the torque ripple when a joint reverses [rad].
    elasticity : float
        Quasi-static deflection of each gear between encoder and link at the torque limit [rad].
    torque_delay : int
        Delay of the measured torque in samples.
    torque_constant : float
        Relative error of each joint's measured torque.
    gear_ratio : float
        Relative error of each gear ratio in the conversion from motor to joint: it scales position and velocity
        directly, and torque inversely.
    gear_sign : int
        Number of joints with the wrong sign in the conversion from motor to joint.
    quantisation : float
        Relative increase of the quantisation steps of position and torque; 1 doubles them.
    jitter : float
        Maximum time-stamp error in a recording [s].
    lost : float
        Probability that a sample is missing in a recording.
    offset_drift : float
        Amplitude of each joint's offset drift (period 100 s) as a fraction of the torque limit.
    seed : int
        Seed of all errors.

    Raises
    ------
    ConfigError : if a value is negative or not finite; a relative error, relative reduction, `load_friction` or `lost`
        is 1 or more.
    """

    base_turn: float = 0.0
    base_shift: float = 0.0
    link_length: float = 0.0
    joint_zero: float = 0.0
    mass: float = 0.0
    centre: float = 0.0
    payload: float = 0.0
    friction: float = 0.0
    saturation: float = 0.0
    warm_up: float = 0.0
    load_friction: float = 0.0
    ripple_jump: float = 0.0
    elasticity: float = 0.0
    torque_delay: int = 0
    torque_constant: float = 0.0
    gear_ratio: float = 0.0
    gear_sign: int = 0
    quantisation: float = 0.0
    jitter: float = 0.0
    lost: float = 0.0
    offset_drift: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 <= value < math.inf or (field.name in SHARES and value >= 1):
                top = "below 1" if field.name in SHARES else "finite"
                raise ConfigError(f"Expected the mismatch {field.name} to be at least 0 and {top}, got {value}.")
            if field.name in COUNTS and value != int(value):
                raise ConfigError(f"Expected an integer for the mismatch {field.name}, got {value}.")


def draw(mismatch: Mismatch, name: str, *shape: int) -> np.ndarray:
    """Return errors drawn uniformly between minus and plus the parameter; every call returns the same values."""
    return float(getattr(mismatch, name)) * _random(mismatch, name).uniform(-1.0, 1.0, shape)


def _random(mismatch: Mismatch, name: str) -> np.random.Generator:
    import numpy as np

    return np.random.default_rng([mismatch.seed, [field.name for field in fields(mismatch)].index(name)])


def built_robot(mismatch: Mismatch, robot: Robot) -> Robot:
    """Return the robot as built, with errors in base pose, link lengths and joint zeros."""
    import numpy as np

    from armlab.lie import so3

    if not (mismatch.base_turn or mismatch.base_shift or mismatch.link_length or mismatch.joint_zero):
        return robot
    n, links, mount = robot.n, robot.links.copy(), robot.T_base_mount.copy()
    mount[:3, :3] = mount[:3, :3] @ so3.exp(draw(mismatch, "base_turn", 3))
    mount[:3, 3] += draw(mismatch, "base_shift", 3)
    links[1:n, :3, 3] += draw(mismatch, "link_length", n - 1, 3)
    for i, zero in enumerate(draw(mismatch, "joint_zero", n)):
        if robot.prismatic[i]:
            links[i, :3, 3] -= zero * links[i, :3, 2]
        else:
            links[i, :3, :3] = links[i, :3, :3] @ so3.exp(np.array([0.0, 0.0, -zero]))
    return replace(robot, name=f"{robot.name} as built", links=links, T_base_mount=mount)


def built_truth(mismatch: Mismatch, truth: Truth, robot: Robot) -> Truth:
    """Return the ground truth of the arm as built, with errors in bodies, friction, torque limits and quantisation."""
    from armlab.robots import inertia

    n, changed = robot.n, {}
    if mismatch.mass or mismatch.centre:
        mass, centre, about = inertia.to_body(truth.pi)
        share = 1.0 + draw(mismatch, "mass", n)
        shifted = centre + draw(mismatch, "centre", n, 3)
        changed["pi"] = inertia.from_body(share * mass, shifted, share[:, None, None] * about)
    if mismatch.friction:
        scale = 1.0 + draw(mismatch, "friction", n)
        changed |= {name: scale * getattr(truth, name) for name in ("coulomb_pos", "coulomb_neg", "viscous")}
    if mismatch.saturation:
        changed["tau_max"] = (1.0 - mismatch.saturation) * truth.tau_max
    if mismatch.quantisation:
        changed |= {name: (1.0 + mismatch.quantisation) * getattr(truth, name) for name in ("q_step", "tau_step")}
    truth = replace(truth, **changed) if changed else truth
    if mismatch.payload:
        T_last_tool = robot.frames[-1]
        truth = truth.with_payload(mismatch.payload, T_last_tool[:3, :3] @ PAYLOAD_AT + T_last_tool[:3, 3])
    return truth


def torque_gain(mismatch: Mismatch, n: int) -> np.ndarray:
    """Return the ratio (n,) of measured to true torque of each joint, due to torque constant and gears."""
    return (1.0 + draw(mismatch, "torque_constant", n)) / position_gain(mismatch, n)


def load_share(mismatch: Mismatch, n: int) -> np.ndarray:
    """Return the increase (n,) of each joint's Coulomb friction per unit of torque transmitted to its link."""
    return abs(draw(mismatch, "load_friction", n))


def position_gain(mismatch: Mismatch, n: int) -> np.ndarray:
    """Return the ratio (n,) of reported to true position of each joint, due to gear ratio and sign."""
    gain = 1.0 + draw(mismatch, "gear_ratio", n)
    gain[_random(mismatch, "gear_sign").permutation(n)[: int(mismatch.gear_sign)]] *= -1.0
    return gain
