"""Friction of joints: its terms, maps over position or temperature, torque ripple and warm-up.

Friction of joint i (specification of the torque model, per joint)::

    F_f = viscous qd + coulomb_pos max(s, 0) + coulomb_neg min(s, 0) + offset
          + stribeck s exp(-(qd / stribeck_speed)^2) + root s sqrt(|qd|)

with s the presliding state z, or s = tanh(qd / smooth_speed) where smooth_speed > 0. With the load x, the torque that
the joint passes to the links (rigid body less J^T F), comes friction ``load |x| s`` of the gears.

The presliding state z in [-1, 1] is driven by measured displacement dq (Dahl 1968), exact for constant direction in a
step::

    z_k = s + (z_{k-1} - s) exp(-|dq_k| / delta),   s = sign(dq_k)

It keeps its value at rest, where a sign function would be 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np

from armlab._numbers import number, still
from armlab.errors import ShapeError
from armlab.kernels import Drive, basis_weights

SLOW = 0.02  # rad/s, m/s: below it friction is known only to lie inside a bound


class FrictionTerm(NamedTuple):
    """A parameter of the friction of one joint, as fits have it.

    `name`: in fits and reports. `fields`: of `Friction`. `unit`: with the {force} and {length} of the joint. `column`:
    its regressor over velocity and sign; None where the torque is not linear in it. `least`, `most`: bounds.
    """

    name: str
    fields: tuple[str, ...]
    unit: str
    column: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    least: float = -np.inf
    most: float = np.inf

    def units(self, prismatic: bool) -> str:
        """Return the unit for a revolute or a prismatic joint."""
        force, length = ("N", "m") if prismatic else ("N m", "rad")
        return self.unit.format(force=force, length=length)


FRICTION_TERMS = {
    term.name: term
    for term in (
        FrictionTerm("viscous", ("viscous",), "{force} s/{length}", lambda qd, s: qd, 0.0),
        FrictionTerm("coulomb", ("coulomb_pos", "coulomb_neg"), "{force}", lambda qd, s: s, 0.0),
        FrictionTerm("coulomb+", ("coulomb_pos",), "{force}", lambda qd, s: np.maximum(s, 0.0), 0.0),
        FrictionTerm("coulomb-", ("coulomb_neg",), "{force}", lambda qd, s: np.minimum(s, 0.0), 0.0),
        FrictionTerm("offset", ("offset",), "{force}", lambda qd, s: np.ones_like(s)),
        FrictionTerm("stribeck", ("stribeck",), "{force}", lambda qd, s: s),  # times exp(-(qd / stribeck-speed)^2)
        FrictionTerm("root", ("root",), "{force} sqrt(s/{length})", lambda qd, s: s * np.sqrt(np.abs(qd))),
        FrictionTerm("load", ("load",), "1", lambda qd, s: s, 0.0, 0.5),  # times the load |x|
        FrictionTerm("delta", ("delta",), "{length}"),
        FrictionTerm("tanh-speed", ("smooth_speed",), "{length}/s"),
        FrictionTerm("stribeck-speed", ("stribeck_speed",), "{length}/s"),
    )
}
"""Every term of friction: names, units, regressors and bounds. The law itself is in `native/math/contact/drive.h`."""


def freeze_arrays(instance: object, what: str, shapes: dict[str, tuple[int, ...]]) -> None:
    """Make fields of a frozen dataclass read-only float64 arrays; refuse other shapes, and numbers not finite."""
    for name, shape in shapes.items():
        values = still(getattr(instance, name), f"{name} of {what}")
        if values.shape != shape or not np.isfinite(values).all():
            got = "NaN or Inf" if values.shape == shape else f"shape {values.shape}"
            raise ShapeError(f"Expected finite {name} of shape {shape} of {what}, got {got}.")
        object.__setattr__(instance, name, values)


def rows_of(part: Friction | Ripple | WarmUp) -> np.ndarray:
    """Return the fields in their order, one row each, as `kernels.Drive` takes them."""
    return np.stack([getattr(part, entry.name) for entry in fields(part)])


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
    """Friction of all joints.

    Attributes
    ----------
    viscous : array, shape (n,), N m s/rad
        Viscous friction.
    coulomb_pos : array, shape (n,), N m
        Coulomb torque for positive motion.
    coulomb_neg : array, shape (n,), N m
        Coulomb torque for negative motion, counted positive.
    offset : array, shape (n,), N m
        Constant torque.
    stribeck : array, shape (n,), N m
        Additional torque near zero speed.
    stribeck_speed : array, shape (n,), rad/s
        Width of the Stribeck peak, above 0.
    delta : array, shape (n,), rad
        Presliding distance, above 0.
    resolution : array, shape (n,), rad
        Smallest displacement that the encoder separates from noise; smaller changes leave the presliding state alone.
    root : array, shape (n,), N m/sqrt(rad/s)
        Torque proportional to the square root of speed. Default: 0.
    smooth_speed : array, shape (n,), rad/s
        v_t of tanh(qd / v_t), which replaces the presliding state where it is above 0. Default: 0.
    load : array, shape (n,)
        Friction as a share of the torque that the joint passes to the links, at least 0 and below 1. Default: 0.
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
    load: np.ndarray = field(default_factory=_zeros)

    def __post_init__(self) -> None:
        _freeze(self)
        if np.any(self.stribeck_speed <= 0) or np.any(self.delta <= 0):
            raise ShapeError("Expected stribeck_speed > 0 and delta > 0, got a value that is not. Make it positive.")
        if np.any(self.smooth_speed < 0) or np.any(self.resolution < 0):
            raise ShapeError("Expected smooth_speed >= 0 and resolution >= 0, got a negative value. Make it positive.")
        if np.any(self.load < 0) or np.any(self.load >= 1):
            raise ShapeError(f"Expected load friction from 0 to below 1, got {self.load.tolist()}. Give it as a share.")

    @classmethod
    def none(cls, n: int) -> Friction:
        """Return n joints without friction; widths of terms that are zero are 1."""
        if not (isinstance(n, int | np.integer) and 0 < n <= 32):
            raise ShapeError(f"Expected a number of joints from 1 to 32, got {n!r}.")
        widths = ("stribeck_speed", "delta")
        return cls(**{entry.name: np.full(n, float(entry.name in widths)) for entry in fields(cls)})

    @property
    def rows(self) -> np.ndarray:
        """Fields in their order, one row each, as `kernels.Drive` takes them."""
        return rows_of(self)

    def torque(self, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the friction torque (..., n) [N m] without load at velocity `qd` and presliding state `z` (..., n)."""
        qd = np.asarray(qd, dtype=float)
        return Drive(self.rows, Ripple.none(len(self.delta)).rows).torque(np.zeros(qd.shape), qd, z)

    @property
    def static(self) -> np.ndarray:
        """Largest friction at rest (n,) [N m]: mean Coulomb plus Stribeck torque."""
        return 0.5 * (self.coulomb_pos + self.coulomb_neg) + np.maximum(self.stribeck, 0.0)


@dataclass(frozen=True, eq=False)
class FrictionBound:
    """Bounds of the friction error near rest: ``|d| <= torque exp(-(qd / speed)^2) + floor``.

    Near zero speed friction is not random but unknown inside bounds, constant for as long as the joint rests
    (Linderoth, Stolt, Robertsson and Johansson, IROS 2013).

    Attributes
    ----------
    torque : array, shape (n,), N m
        Largest friction at rest.
    speed : array, shape (n,), rad/s
        Width of the bound in speed, above 0.
    floor : array, shape (n,), N m
        Bound of the model error in motion.
    """

    torque: np.ndarray
    speed: np.ndarray
    floor: np.ndarray

    def __post_init__(self) -> None:
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

    `cycles`: angular frequency over the joint angle [rad/rad], 2 |gear| for strain-wave gears. `cosine`, `sine`:
    amplitudes [N m].
    """

    cycles: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray

    def __post_init__(self) -> None:
        _freeze(self)

    @classmethod
    def none(cls, n: int) -> Ripple:
        """Return n joints without ripple."""
        return cls(*np.zeros((len(fields(cls)), n)))

    def torque(self, q: np.ndarray) -> np.ndarray:
        """Return the ripple torque (..., n) [N m] at `q` (..., n)."""
        zero = np.zeros(np.shape(q))
        return Drive(Friction.none(len(self.cycles)).rows, self.rows).torque(q, zero, zero)

    @property
    def rows(self) -> np.ndarray:
        """Fields in their order, one row each, as `kernels.Drive` takes them."""
        return rows_of(self)


# Friction over position and speed by normalised radial basis functions, one set for each direction::
#
#     F = (1 + s)/2 phi(q, |qd|)^T k_pos + (1 - s)/2 phi(q, |qd|)^T k_neg
#
# s is the presliding state. Outside its hull phi keeps the value of the nearest edge. Theory: docs/theory/friction.md.


@dataclass(frozen=True, eq=False)
class RadialBasis:
    """Centres of all n joints on a grid of positions and speeds; speeds are positive and stand for both directions.

    `positions`, `position_widths`: (n, P) [rad], ascending; positive. `speeds`, `speed_widths`: (n, S) [rad/s],
    ascending and above 0; positive.
    """

    positions: np.ndarray
    position_widths: np.ndarray
    speeds: np.ndarray
    speed_widths: np.ndarray

    def __post_init__(self) -> None:
        for entry in fields(self):
            object.__setattr__(self, entry.name, still(getattr(self, entry.name), f"{entry.name} of radial bases"))
        p, v = self.positions, self.speeds
        alike = p.shape == self.position_widths.shape and v.shape == self.speed_widths.shape
        if p.ndim != 2 or v.ndim != 2 or len(p) != len(v) or not alike:
            raise ShapeError(f"Expected centres and widths of shape (n, P) and (n, S), got {p.shape} and {v.shape}.")
        steps = *np.diff(p, axis=1).ravel(), *np.diff(v, axis=1).ravel()
        positive = *steps, *v.ravel(), *self.position_widths.ravel(), *self.speed_widths.ravel()
        if not np.isfinite(p).all() or not np.isfinite(positive).all() or min(positive) <= 0:
            raise ShapeError("Expected ascending centres, speeds above 0 and positive widths, got others.")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.positions)

    @property
    def size(self) -> int:
        """Functions of a joint, 2 P S."""
        return 2 * self.positions.shape[1] * self.speeds.shape[1]

    def functions(self, i: int, q: np.ndarray, qd: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the functions (N, 2 P S) of joint i, positive direction first; their sum is 1."""
        at = basis_weights(q, self.positions[i], self.position_widths[i])
        along = basis_weights(np.abs(qd), self.speeds[i], self.speed_widths[i])
        phi = (at[:, :, None] * along[:, None, :]).reshape(len(at), -1)
        s = np.asarray(s, dtype=float)[:, None]
        return np.concatenate([0.5 * (1.0 + s) * phi, 0.5 * (1.0 - s) * phi], axis=1)

    def outside(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return True (..., n) where position or speed is beyond the centres, so that an edge stands for it."""
        q, speed = np.asarray(q, dtype=float), np.abs(qd)
        return (q < self.positions[:, 0]) | (q > self.positions[:, -1]) | (speed > self.speeds[:, -1])


@dataclass(frozen=True, eq=False)
class FrictionMap:
    """Friction over position and speed, in addition to `Friction`.

    Attributes
    ----------
    basis : RadialBasis
        Centres and widths of the radial basis functions.
    coefficients : array, shape (n, 2, P, S), N m
        Coefficients of the basis functions, positive direction first; zero for joints without a map.
    """

    basis: RadialBasis
    coefficients: np.ndarray

    def __post_init__(self) -> None:
        shape = (self.basis.n, 2, self.basis.positions.shape[1], self.basis.speeds.shape[1])
        freeze_arrays(self, "radial bases", {"coefficients": shape})

    def kernel_rows(self) -> tuple[np.ndarray, ...]:
        """Return the arrays as `kernels.Drive` takes them."""
        b = self.basis
        return b.positions, b.position_widths, b.speeds, b.speed_widths, self.coefficients

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the torque (..., n) [N m].

        `q`, `qd`: (..., n) [rad], [rad/s]. `z`: (..., n) presliding state.
        """
        n = self.basis.n
        return Drive(Friction.none(n).rows, Ripple.none(n).rows, map=self.kernel_rows()).torque(q, qd, z)


# Torque ripple as lines over position whose amplitude and phase depend on speed.
#
#     tau_i = sum_c psi(qd)^T (a_c cos(c q) + b_c sin(c q))
#
# c counts cycles per revolution, equal to rad/rad; psi are normalised Gaussians in speed. With two directions each line
# has amplitudes of its own for positive and negative motion.


SPEEDS = 8
LARGEST = 1e15  # of the numbers of ripple lines, joint numbers among them


def speed_basis(slowest: float, fastest: float, count: int = SPEEDS) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and widths (count,) [rad/s] of Gaussians spread evenly from one speed to another."""
    slowest, fastest = number(slowest, "the slowest speed [rad/s]"), number(fastest, "the fastest speed [rad/s]")
    if count < 2 or not fastest > slowest:
        raise ShapeError(f"Expected at least 2 Gaussians from one speed to a faster one, got {count} from {slowest:g} "
                         f"to {fastest:g} rad/s.")  # fmt: skip
    centres = np.linspace(slowest, fastest, count)
    return centres, np.full(count, centres[1] - centres[0])


@dataclass(frozen=True, eq=False)
class RippleLines:
    """Torque ripple of n joints as L lines over position.

    Attributes
    ----------
    joint : int array, shape (L,)
        Joint of each line, counted from 0, in ascending order.
    cycles : array, shape (L,), cycles per revolution
        Frequency of each line over the joint angle, equal to rad/rad.
    speeds : array, shape (n, S), rad/s
        Centres of the Gaussians in speed, ascending.
    widths : array, shape (n, S), rad/s
        Widths of the Gaussians, above 0.
    coefficients : array, shape (L, D, S, 2), N m
        Amplitudes of cosine and sine for D = 1 or 2 directions, positive first.
    """

    joint: np.ndarray
    cycles: np.ndarray
    speeds: np.ndarray
    widths: np.ndarray
    coefficients: np.ndarray

    def __post_init__(self) -> None:
        for name in ("joint", "cycles", "speeds", "widths", "coefficients"):
            values = still(getattr(self, name), f"{name} of the ripple lines")
            if not np.all(np.abs(values) < LARGEST):
                raise ShapeError(f"Expected finite {name} of the ripple lines, got NaN or Inf.")
            object.__setattr__(self, name, values.astype(int) if name == "joint" else values)
        self.joint.flags.writeable = False
        if np.any(self.widths <= 0) or self.speeds.ndim != 2 or np.any(np.diff(self.speeds, axis=-1) <= 0):
            raise ShapeError("Expected ascending speeds and positive widths of the ripple lines, got others.")
        self._drive()  # refuses shapes that do not fit

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.speeds)

    def kernel_rows(self) -> tuple[np.ndarray, ...]:
        """Return the arrays as `kernels.Drive` takes them."""
        return self.joint.astype(float), self.cycles, self.speeds, self.widths, self.coefficients

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the ripple torque (..., n) [N m].

        `q`, `qd`: (..., n) [rad], [rad/s]. `z`: (..., n) presliding state.
        """
        return self._drive().torque(q, qd, z)

    def _drive(self) -> Drive:
        return Drive(Friction.none(self.n).rows, Ripple.none(self.n).rows, lines=self.kernel_rows())


# Friction that changes as a drive warms up by its own friction, without a temperature sensor.
#
#     dx/dt = (|F_f qd| / power - x) / time
#     coulomb: times (1 + of_coulomb x),   viscous: times (1 + of_viscous x)
#
# x >= 0 is 1 where a drive has rubbed with the power `power` for long. The idea is that of Bagge Carlson, Robertsson
# and Johansson, IROS 2015.


@dataclass(frozen=True, eq=False)
class WarmUp:
    """Change of friction with the thermal state of a drive.

    Attributes
    ----------
    of_coulomb : array, shape (n,)
        Relative change of Coulomb friction at thermal state 1.
    of_viscous : array, shape (n,)
        Relative change of viscous friction at thermal state 1.
    time : array, shape (n,), s
        Time constant; 0 for a drive whose friction does not change.
    power : array, shape (n,), W
        Friction power at which the thermal state settles at 1, above 0.
    start : array, shape (n,)
        Thermal state at the beginning of a record; 0 is cold.
    """

    of_coulomb: np.ndarray
    of_viscous: np.ndarray
    time: np.ndarray
    power: np.ndarray
    start: np.ndarray

    def __post_init__(self) -> None:
        for entry in fields(self):
            values = still(getattr(self, entry.name), f"{entry.name} of the warm-up")
            if values.ndim != 1 or values.shape != np.shape(self.of_coulomb) or not np.isfinite(values).all():
                raise ShapeError(f"Expected finite {entry.name} of one number per joint, got shape {values.shape}.")
            object.__setattr__(self, entry.name, values)
        if np.any(self.time < 0) or np.any(self.power <= 0) or np.any(self.start < 0):
            raise ShapeError("Expected time >= 0, power > 0 and start >= 0 of the warm-up, got others.")

    def kernel_rows(self) -> np.ndarray:
        """Return the arrays as `kernels.Drive` takes them."""
        return rows_of(self)

    def thermal_state(self, power: np.ndarray, dt: np.ndarray) -> np.ndarray:
        """Return the thermal state (N, n) before each row, for friction power (N, n) [W] held over steps dt (N,) [s].

        `power`: (N, n) |F_f qd|. `dt`: (N,).
        """
        x = np.empty(np.shape(power))
        now = self.start
        heats = self.time > 0
        for k, (heat, step) in enumerate(zip(np.asarray(power) / self.power, dt)):
            x[k] = now
            now = np.where(heats, heat + (now - heat) * np.exp(-step / np.where(heats, self.time, 1.0)), now)
        return x
