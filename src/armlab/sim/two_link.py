"""Two-link arm in a vertical plane with closed-form dynamics and kinematics, for testing controllers.

The arm has point masses at the ends of two massless links, and viscous and Coulomb friction in both joints. q_1 is zero
when the arm hangs down and increases counter-clockwise; q_2 is relative to the first link. x points right and y up.
Functions broadcast over leading axes. Arrays of the wrong shape raise ShapeError.

The equation of motion is ``M(q) qdd + h(q, qd) + G(q) + viscous qd + coulomb tanh(100 qd) = tau`` with::

    M_11 = (m1 + m2) l1^2 + m2 l2^2 + 2 m2 l1 l2 cos q2,   M_12 = m2 l2^2 + m2 l1 l2 cos q2,   M_22 = m2 l2^2
    h = m2 l1 l2 sin q2 (-2 qd1 qd2 - qd2^2, qd1^2)
    G = g ((m1 + m2) l1 sin q1 + m2 l2 sin(q1 + q2), m2 l2 sin(q1 + q2))

The model and its default parameters are those of TwoLink in DynamicMovementPrimitives.jl, apart from M_11, the gravity
of 9.82 m/s^2 and the zero torque at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ConfigError, ShapeError, UnknownName

__all__ = [
    "ARM",
    "TwoLink",
    "energy",
    "forward",
    "forward_dynamics",
    "inverse",
    "inverse_dynamics",
    "jacobian",
    "mass_matrix",
    "rhs",
]

_SHARPNESS = 100.0  # s/rad: Coulomb friction is fully developed above a few hundredths of a rad/s
_AT_REACH = 1e-12  # relative rounding tolerance at full extension


@dataclass(frozen=True)
class TwoLink:
    """Parameters of the arm.

    Attributes
    ----------
    m1, m2 : masses at the ends of the links [kg].
    l1, l2 : lengths of the links [m].
    viscous : viscous friction [N m s/rad].
    coulomb : Coulomb friction [N m].
    gravity : gravitational acceleration, downward [m/s^2].

    Raises
    ------
    ConfigError : if a mass or length is not above 0, a friction coefficient is below 0, or a number is not finite.
    """

    m1: float = 0.2
    m2: float = 0.2
    l1: float = 1.0
    l2: float = 1.0
    viscous: float = 2.0
    coulomb: float = 0.1
    gravity: float = 9.82

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("m1", "m2", "l1", "l2"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ConfigError(f"Expected {name} of the two-link arm above 0, got {getattr(self, name)}.")
        for name in ("viscous", "coulomb"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"Expected {name} of the two-link arm to be at least 0, got {getattr(self, name)}.")
        if not np.isfinite(self.gravity):
            raise ConfigError(f"Expected a finite gravity of the two-link arm, got {self.gravity}.")


ARM = TwoLink()
"""Arm with the default parameters."""


def mass_matrix(q: ArrayLike, arm: TwoLink = ARM) -> np.ndarray:
    """Return M(q) (..., 2, 2) [kg m^2].

    Parameters
    ----------
    q : (..., 2) joint positions [rad].
    """
    c2 = np.cos(_pair(q, "q")[..., 1])
    last, coupling = arm.m2 * arm.l2**2, arm.m2 * arm.l1 * arm.l2 * c2
    M = np.empty((*c2.shape, 2, 2))
    M[..., 0, 0] = (arm.m1 + arm.m2) * arm.l1**2 + last + 2.0 * coupling
    M[..., 0, 1] = M[..., 1, 0] = last + coupling
    M[..., 1, 1] = last
    return M


def inverse_dynamics(q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, arm: TwoLink = ARM) -> np.ndarray:
    """Return the joint torques (..., 2) [N m] for a motion: ``M qdd + h + G + friction``.

    Parameters
    ----------
    q, qd, qdd : (..., 2) joint motion [rad, rad/s, rad/s^2].
    """
    return np.einsum("...ij,...j", mass_matrix(q, arm), _pair(qdd, "qdd")) + _known(q, qd, arm)


def forward_dynamics(q: ArrayLike, qd: ArrayLike, tau: ArrayLike, arm: TwoLink = ARM) -> np.ndarray:
    """Return the acceleration (..., 2) [rad/s^2] for joint torques: ``M^-1 (tau - h - G - friction)``.

    Parameters
    ----------
    q, qd, tau : (..., 2) joint state and torque [rad, rad/s, N m].
    """
    free = _pair(tau, "tau") - _known(q, qd, arm)
    M = mass_matrix(q, arm)
    determinant = M[..., 0, 0] * M[..., 1, 1] - M[..., 0, 1] ** 2
    first = M[..., 1, 1] * free[..., 0] - M[..., 0, 1] * free[..., 1]
    second = M[..., 0, 0] * free[..., 1] - M[..., 0, 1] * free[..., 0]
    return np.stack([first, second], axis=-1) / determinant[..., None]


def rhs(x: ArrayLike, tau: ArrayLike, arm: TwoLink = ARM) -> np.ndarray:
    """Return the time derivative (..., 4) of the state ``[q, qd]``: ``[qd, qdd]``.

    Parameters
    ----------
    x : (..., 4) position and velocity [rad, rad/s].
    tau : (..., 2) torque [N m].
    """
    state = numbers(x, "x", ShapeError)
    if state.shape[-1:] != (4,):
        raise ShapeError(f"Expected x of shape (..., 4) with positions and velocities, got {state.shape}.")
    q, qd = state[..., :2], state[..., 2:]
    qdd = forward_dynamics(q, qd, tau, arm)
    return np.concatenate([np.broadcast_to(qd, qdd.shape), qdd], axis=-1)


def energy(q: ArrayLike, qd: ArrayLike, arm: TwoLink = ARM) -> np.ndarray:
    """Return the total energy (...) [J]; 0 when the arm hangs straight down at rest.

    Parameters
    ----------
    q, qd : (..., 2) joint position and velocity [rad, rad/s].
    """
    angles, speeds = _pair(q, "q"), _pair(qd, "qd")
    kinetic = 0.5 * np.einsum("...i,...ij,...j", speeds, mass_matrix(angles, arm), speeds)
    first, second = arm.l1 * (1.0 - np.cos(angles[..., 0])), arm.l2 * (1.0 - np.cos(angles.sum(axis=-1)))
    return kinetic + arm.gravity * ((arm.m1 + arm.m2) * first + arm.m2 * second)


def forward(q: ArrayLike, arm: TwoLink = ARM) -> np.ndarray:
    """Return the tip (..., 2) [m]: ``(l1 sin q1 + l2 sin(q1 + q2), -l1 cos q1 - l2 cos(q1 + q2))``.

    Parameters
    ----------
    q : (..., 2) joint positions [rad].
    """
    angles = _pair(q, "q")
    q1, q12 = angles[..., 0], angles.sum(axis=-1)
    return np.stack([arm.l1 * np.sin(q1) + arm.l2 * np.sin(q12), -arm.l1 * np.cos(q1) - arm.l2 * np.cos(q12)], axis=-1)


def jacobian(q: ArrayLike, arm: TwoLink = ARM) -> np.ndarray:
    """Return the Jacobian (..., 2, 2) [m/rad]: tip velocity per joint velocity.

    Parameters
    ----------
    q : (..., 2) joint positions [rad].
    """
    angles = _pair(q, "q")
    q1, q12 = angles[..., 0], angles.sum(axis=-1)
    outer = np.stack([arm.l2 * np.cos(q12), arm.l2 * np.sin(q12)], axis=-1)
    inner = np.stack([arm.l1 * np.cos(q1), arm.l1 * np.sin(q1)], axis=-1)
    return np.stack([inner + outer, outer], axis=-1)


def inverse(p: ArrayLike, elbow: Literal["down", "up"] = "down", arm: TwoLink = ARM) -> np.ndarray:
    """Return joint positions (..., 2) [rad] that place the tip at p.

    With r the distance of p from the shoulder: ``cos q2 = (r^2 - l1^2 - l2^2) / (2 l1 l2)`` and ``q1 = atan2(x, -y) -
    atan2(l2 sin q2, l1 + l2 cos q2)``.

    Parameters
    ----------
    p : (..., 2) points [m].
    elbow : "down" for q2 >= 0, "up" for q2 <= 0: side of the line from shoulder to tip, seen with the tip to the right.

    Raises
    ------
    ShapeError : if the shape is wrong or a point is out of reach; the message contains the distance of the point.
    UnknownName : if `elbow` is neither "down" nor "up".
    """
    if elbow not in ("down", "up"):
        raise UnknownName.among("elbow", elbow, ("down", "up"))
    points = _pair(p, "p")
    r = np.linalg.norm(points, axis=-1)
    near, far = abs(arm.l1 - arm.l2), arm.l1 + arm.l2
    out = ~((r >= near - _AT_REACH * far) & (r <= far * (1.0 + _AT_REACH)))
    if out.any():
        raise ShapeError(
            f"Expected points between {near:g} m and {far:g} m from the shoulder, got a point at {r[out][0]:.6g} m. "
            "Move the point within reach."
        )
    cosine = np.clip((r**2 - arm.l1**2 - arm.l2**2) / (2.0 * arm.l1 * arm.l2), -1.0, 1.0)
    q2 = np.arccos(cosine) * (1.0 if elbow == "down" else -1.0)
    lean = np.arctan2(arm.l2 * np.sin(q2), arm.l1 + arm.l2 * cosine)
    return np.stack([np.arctan2(points[..., 0], -points[..., 1]) - lean, q2], axis=-1)


def _pair(value: ArrayLike, name: str) -> np.ndarray:
    array = numbers(value, name, ShapeError)
    if array.shape[-1:] != (2,):
        raise ShapeError(f"Expected {name} of shape (..., 2), one number per joint or axis, got {array.shape}.")
    return array


def _known(q: ArrayLike, qd: ArrayLike, arm: TwoLink) -> np.ndarray:
    """Return h + G + friction, the torques that do not depend on acceleration."""
    angles, speeds = np.broadcast_arrays(_pair(q, "q"), _pair(qd, "qd"))
    qd1, qd2 = speeds[..., 0], speeds[..., 1]
    coupling = arm.m2 * arm.l1 * arm.l2 * np.sin(angles[..., 1])
    inner = arm.gravity * (arm.m1 + arm.m2) * arm.l1 * np.sin(angles[..., 0])
    outer = arm.gravity * arm.m2 * arm.l2 * np.sin(angles.sum(axis=-1))
    bias = np.stack([inner + outer - coupling * (2.0 * qd1 + qd2) * qd2, outer + coupling * qd1**2], axis=-1)
    return bias + arm.viscous * speeds + arm.coulomb * np.tanh(_SHARPNESS * speeds)
