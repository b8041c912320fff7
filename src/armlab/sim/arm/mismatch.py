"""`Mismatch`: how the simulated arm differs from what its user believes of it; every knob is 0 until it is turned.

What is drawn per joint, per link or per axis is drawn evenly between minus and plus the knob, from a stream of its own:
turning one knob leaves the draws of the others as they are.

    built    base_turn, base_shift, link_length, joint_zero: frames of the arm that moves, not of its description
    bodies   mass, centre, payload; friction, saturation: its parameters
    drives   warm_up, load_friction, ripple_jump, offset_drift: friction that depends on more than position and velocity
    seen     elasticity, torque_delay, torque_constant, gear_ratio, gear_sign, quantisation: what the sensors report
    logged   jitter, lost: what is recorded of it

The knobs are options of ``armlab sim``, whose help loads this file: NumPy is imported where something is drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from armlab.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

    from armlab.robots import Robot
    from armlab.sim.arm.truth import Truth


PAYLOAD_AT = (0.0, 0.0, 0.06)  # m, centre of the unknown payload, tool axes
SHARES = ("gear_ratio", "mass", "friction", "warm_up", "load_friction", "saturation", "lost", "torque_constant")
COUNTS = ("gear_sign", "torque_delay", "seed")


@dataclass(frozen=True)
class Mismatch:
    """What is not as described. All zero: nothing, to the last bit.

    Attributes
    ----------
    base_turn : float
        Turn of the mount about each of its axes [rad].
    base_shift : float
        Shift of the mount along each of its axes [m].
    link_length : float
        Error of each coordinate from a joint's frame to the next [m].
    joint_zero : float
        Offset of each joint's zero [rad or m].
    mass : float
        Relative error of each link's mass, its inertia with it.
    centre : float
        Shift of each link's centre of mass along each axis [m].
    payload : float
        Unmodelled payload, 60 mm beyond the tool point along its z axis [kg].
    friction : float
        Relative error of each joint's friction: Coulomb, static and viscous.
    saturation : float
        Share of each drive's torque range that is missing.
    warm_up : float
        Share of the viscous friction that a warm drive has lost; 12 minutes time constant, cold at the start.
    load_friction : float
        Largest share of the torque that a joint passes to its link by which its Coulomb friction grows.
    ripple_jump : float
        Phase by which the torque ripple jumps when a joint reverses [rad].
    elasticity : float
        Deflection of each gear at the torque limit [rad]; the encoder sits before it. Without resonance.
    torque_delay : int
        Samples by which the measured torque lags.
    torque_constant : float
        Relative error of each joint's measured torque.
    gear_ratio : float
        Relative error of each gear in the conversion from the motor: position and velocity grow, torque shrinks.
    gear_sign : int
        Number of joints whose conversion from the motor has the wrong sign.
    quantisation : float
        Growth of the steps of position and torque; 1 doubles them.
    jitter : float
        Largest error of a time stamp in a recording [s].
    lost : float
        Probability that a sample is missing in a recording.
    offset_drift : float
        Share of the torque limit by which each joint's constant torque swings, in 100 s.
    seed : int
        Of all draws.

    Raises
    ------
    ConfigError : a knob is negative or not finite, or a share is 1 or more.
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
                raise ConfigError(f"Expected the mismatch {field.name} of at least 0 and {top}, got {value}.")
            if field.name in COUNTS and value != int(value):
                raise ConfigError(f"Expected a whole number as mismatch {field.name}, got {value}.")


def draw(mismatch: Mismatch, knob: str, *shape: int) -> np.ndarray:
    """Return errors of this shape, even between minus and plus the knob; the same at every call."""
    return float(getattr(mismatch, knob)) * _random(mismatch, knob).uniform(-1.0, 1.0, shape)


def _random(mismatch: Mismatch, knob: str) -> np.random.Generator:
    import numpy as np

    return np.random.default_rng([mismatch.seed, [field.name for field in fields(mismatch)].index(knob)])


def built_robot(mismatch: Mismatch, robot: Robot) -> Robot:
    """Return the arm as it was built: base pose, link lengths and joint zeros differ from the description `robot`."""
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
    """Return the truth of the arm as it was built: masses, centres, payload, friction, torque limits, steps."""
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
    """Return measured over true torque (n,) of each joint: torque constant and gears."""
    return (1.0 + draw(mismatch, "torque_constant", n)) / position_gain(mismatch, n)


def load_share(mismatch: Mismatch, n: int) -> np.ndarray:
    """Return the share (n,) of the torque that each joint passes to its link by which its Coulomb friction grows."""
    return abs(draw(mismatch, "load_friction", n))


def position_gain(mismatch: Mismatch, n: int) -> np.ndarray:
    """Return reported over true position (n,) of each joint: ratio and sign of the gears."""
    gain = 1.0 + draw(mismatch, "gear_ratio", n)
    gain[_random(mismatch, "gear_sign").permutation(n)[: int(mismatch.gear_sign)]] *= -1.0
    return gain
