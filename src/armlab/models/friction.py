"""Joint friction with a presliding state, and torque ripple.

Friction of joint i (specification of the torque model, per joint)::

    F_f = viscous qd + coulomb_pos max(s, 0) + coulomb_neg min(s, 0) + offset
          + stribeck s exp(-(qd / stribeck_speed)^2) + root s sqrt(|qd|)

with s the presliding state z, or s = tanh(qd / smooth_speed) where smooth_speed > 0.

The presliding state z in [-1, 1] is driven by measured displacement dq (Dahl 1968), exact for constant direction in a
step::

    z_k = s + (z_{k-1} - s) exp(-|dq_k| / delta),   s = sign(dq_k)

It keeps its value at rest, where a sign function would be 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError
from armlab.kernels import Drive

__all__ = ["Friction", "FrictionBound", "Ripple"]

SLOW = 0.02  # rad/s, m/s: below it friction is known only to lie inside a bound


def _zeros() -> np.ndarray:
    """Stand for zeros of all joints."""
    return np.zeros(0)


def _freeze(instance: Friction | FrictionBound | Ripple) -> None:
    """Make every field a read-only float64 vector of one length."""
    shape = None
    for entry in fields(instance):
        values = still(getattr(instance, entry.name), f"{entry.name} of {type(instance).__name__}")
        if entry.default_factory is _zeros and values.shape == (0,) and shape is not None:
            values = np.zeros(shape)
        shape = values.shape if shape is None else shape
        if values.ndim != 1 or values.shape != shape or not np.all(np.isfinite(values)):
            raise ShapeError(
                f"Expected finite {entry.name} of shape (n,) like the other fields, got shape {values.shape}. "
                "Give one number per joint."
            )
        object.__setattr__(instance, entry.name, values)


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of all joints; every field has shape (n,).

    Attributes
    ----------
    viscous : [N m s/rad].
    coulomb_pos, coulomb_neg : Coulomb torque for positive and negative motion, both counted positive [N m].
    offset : [N m].
    stribeck : extra torque near zero speed [N m]. stribeck_speed : its width [rad/s].
    delta : presliding distance [rad].
    resolution : displacement that the encoder can tell from noise [rad]; smaller changes leave the state alone.
    root : torque that grows with the root of speed [N m/sqrt(rad/s)]; zero when left out.
    smooth_speed : v_t [rad/s] of tanh(qd / v_t) in place of the presliding state; 0, or left out: presliding.
    """

    viscous: np.ndarray
    coulomb_pos: np.ndarray
    coulomb_neg: np.ndarray
    offset: np.ndarray
    stribeck: np.ndarray
    stribeck_speed: np.ndarray
    delta: np.ndarray
    resolution: np.ndarray
    root: np.ndarray = field(default_factory=_zeros)
    smooth_speed: np.ndarray = field(default_factory=_zeros)

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        _freeze(self)
        if np.any(self.stribeck_speed <= 0) or np.any(self.delta <= 0):
            raise ShapeError("Expected stribeck_speed > 0 and delta > 0, got a value that is not. Make it positive.")
        if np.any(self.smooth_speed < 0) or np.any(self.resolution < 0):
            raise ShapeError("Expected smooth_speed >= 0 and resolution >= 0, got a negative value. Make it positive.")

    @property
    def rows(self) -> np.ndarray:
        """All fields in their order, one row each (10, n), as `kernels.Drive` takes them."""
        return np.stack([getattr(self, entry.name) for entry in fields(self)])

    def torque(self, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the friction torque (..., n) [N m] at velocity `qd` (..., n) and presliding state `z` (..., n)."""
        qd = np.asarray(qd, dtype=float)
        return Drive(self.rows, np.zeros((3, len(self.delta)))).torque(np.zeros(qd.shape), qd, z)

    @property
    def static(self) -> np.ndarray:
        """Largest friction at rest (n,) [N m]: mean Coulomb plus Stribeck torque."""
        return 0.5 * (self.coulomb_pos + self.coulomb_neg) + np.maximum(self.stribeck, 0.0)


@dataclass(frozen=True, eq=False)
class FrictionBound:
    """How far friction may lie from the model near rest: ``|d| <= torque exp(-(qd / speed)^2) + floor``.

    Near zero speed friction is not random but unknown inside bounds, constant for as long as the joint rests
    (Linderoth, Stolt, Robertsson and Johansson, IROS 2013). Every field has shape (n,).

    Attributes
    ----------
    torque : largest friction at rest [N m]. speed : [rad/s].
    floor : what is left of the model's error in motion [N m].
    """

    torque: np.ndarray
    speed: np.ndarray
    floor: np.ndarray

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        _freeze(self)
        if np.any(self.torque < 0) or np.any(self.floor < 0) or np.any(self.speed <= 0):
            raise ShapeError(
                "Expected torque >= 0, floor >= 0 and speed > 0 of a friction bound, got others. Correct it."
            )

    @classmethod
    def of(cls, friction: Friction, floor: np.ndarray | None = None) -> FrictionBound:
        """Return the bound by the static friction of `friction`, with a floor (n,) [N m] or none."""
        n = len(friction.viscous)
        return cls(friction.static, np.full(n, SLOW), np.zeros(n) if floor is None else floor)

    def torque_at(self, qd: np.ndarray) -> np.ndarray:
        """Return the bound (..., n) [N m] at `qd` (..., n) [rad/s]."""
        return self.torque * np.exp(-((np.asarray(qd, dtype=float) / self.speed) ** 2)) + self.floor


@dataclass(frozen=True, eq=False)
class Ripple:
    """One torque ripple line per joint: ``cosine cos(cycles q) + sine sin(cycles q)``; every field has shape (n,).

    Attributes
    ----------
    cycles : angular frequency over the joint angle [rad/rad], 2 |gear| for strain-wave gears.
    cosine, sine : amplitudes [N m].
    """

    cycles: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        _freeze(self)

    def torque(self, q: np.ndarray) -> np.ndarray:
        """Return the ripple torque (..., n) [N m] at `q` (..., n)."""
        zero = np.zeros(np.shape(q))
        friction = np.zeros((10, len(self.cycles)))
        friction[5:7] = 1.0  # widths of terms that are zero
        return Drive(friction, self.rows).torque(q, zero, zero)

    @property
    def rows(self) -> np.ndarray:
        """cycles, cosine, sine, one row each (3, n), as `kernels.Drive` takes them."""
        return np.stack([self.cycles, self.cosine, self.sine])
