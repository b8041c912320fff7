"""Joint friction: terms, maps over position or temperature, torque ripple and warm-up.

Friction of joint i::

    F_f = viscous qd + coulomb_pos max(s, 0) + coulomb_neg min(s, 0) + offset
          + stribeck s exp(-(qd / stribeck_speed)^2) + root s sqrt(|qd|)

with s the presliding state z, or s = tanh(qd / smooth_speed) where smooth_speed > 0. The load x is the torque that the
joint transmits to the links (rigid body minus J^T F); it adds the gear friction ``load |x| s``.

The presliding state z in [-1, 1] integrates the measured displacement dq (Dahl 1968). The update is exact if the
direction is constant within a step::

    z_k = s + (z_{k-1} - s) exp(-|dq_k| / delta),   s = sign(dq_k)

Unlike a sign function, the state keeps its value at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np

from armlab._display import Shown
from armlab._numbers import number, still
from armlab.errors import ShapeError
from armlab.kernels import Drive, basis_weights

SLOW = 0.02  # rad/s, m/s: below this speed, only a bound on friction is known


class FrictionTerm(NamedTuple):
    """Friction parameter of one joint, as used in fits.

    `name`: name in fits and reports. `fields`: fields of `Friction`. `unit`: unit with placeholders for the {force} and
    {length} of the joint. `column`: regressor as a function of velocity and sign; None if the torque is nonlinear in
    the parameter. `least`, `most`: bounds.
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
"""All friction terms with names, units, regressors and bounds.

The friction law itself is implemented in `native/math/contact/drive.h`.
"""


def freeze_arrays(instance: object, what: str, shapes: dict[str, tuple[int, ...]]) -> None:
    """Make fields of a frozen dataclass read-only float64 arrays; reject wrong shapes and non-finite numbers."""
    for name, shape in shapes.items():
        values = still(getattr(instance, name), f"{name} of {what}")
        if values.shape != shape or not np.isfinite(values).all():
            got = "NaN or Inf" if values.shape == shape else f"shape {values.shape}"
            raise ShapeError(f"Expected finite {name} of shape {shape} for {what}, got {got}.")
        object.__setattr__(instance, name, values)


def rows_of(part: Friction | Ripple | WarmUp) -> np.ndarray:
    """Return the fields in order, one row each, as `kernels.Drive` expects them."""
    return np.stack([getattr(part, entry.name) for entry in fields(part)])


def _zeros() -> np.ndarray:
    """Return a placeholder that represents zero for all joints."""
    return np.zeros(0)


def _freeze(instance: Friction | FrictionBound | Ripple) -> None:
    """Make every field a read-only float64 vector, all of equal length."""
    shape = None
    for entry in fields(instance):
        values = still(getattr(instance, entry.name), f"{entry.name} of {type(instance).__name__}")
        if entry.default_factory is _zeros and values.shape == (0,) and shape is not None:
            values = np.zeros(shape)
        shape = values.shape if shape is None else shape
        if values.ndim != 1 or values.shape != shape or not np.all(np.isfinite(values)):
            raise ShapeError(
                f"Expected finite {entry.name} of shape (n,) like the other fields, got shape {values.shape}. "
                "Pass one number per joint."
            )
        object.__setattr__(instance, entry.name, values)


@dataclass(frozen=True, eq=False, repr=False)
class Friction(Shown):
    """Friction of all joints.

    Attributes
    ----------
    viscous : array, shape (n,), N m s/rad
        Viscous friction.
    coulomb_pos : array, shape (n,), N m
        Coulomb torque for positive motion.
    coulomb_neg : array, shape (n,), N m
        Coulomb torque for negative motion, as a positive number.
    offset : array, shape (n,), N m
        Constant torque.
    stribeck : array, shape (n,), N m
        Additional torque near zero speed.
    stribeck_speed : array, shape (n,), rad/s
        Width of the Stribeck peak, above 0.
    delta : array, shape (n,), rad
        Presliding distance, above 0.
    resolution : array, shape (n,), rad
        Smallest displacement that the encoder can distinguish from noise; the presliding state ignores smaller changes.
    root : array, shape (n,), N m/sqrt(rad/s)
        Torque proportional to the square root of speed. Default: 0.
    smooth_speed : array, shape (n,), rad/s
        v_t of tanh(qd / v_t), which replaces the presliding state if v_t is above 0. Default: 0.
    load : array, shape (n,)
        Friction as a fraction of the torque that the joint transmits to the links; at least 0 and below 1. Default: 0.
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
            raise ShapeError("Expected stribeck_speed > 0 and delta > 0, got a value <= 0. Pass positive values.")
        if np.any(self.smooth_speed < 0) or np.any(self.resolution < 0):
            raise ShapeError("Expected smooth_speed >= 0 and resolution >= 0, got a negative value. Pass values >= 0.")
        if np.any(self.load < 0) or np.any(self.load >= 1):
            raise ShapeError(f"Expected load friction in [0, 1), got {self.load.tolist()}. Pass fractions.")

    @classmethod
    def none(cls, n: int) -> Friction:
        """Return zero friction for n joints; the widths of zero terms are 1."""
        if not (isinstance(n, int | np.integer) and 0 < n <= 32):
            raise ShapeError(f"Expected a number of joints from 1 to 32, got {n!r}.")
        widths = ("stribeck_speed", "delta")
        return cls(**{entry.name: np.full(n, float(entry.name in widths)) for entry in fields(cls)})

    @property
    def rows(self) -> np.ndarray:
        """Fields in order, one row each, as `kernels.Drive` expects them."""
        return rows_of(self)

    def torque(self, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the friction torque (..., n) [N m] without load at velocity `qd` and presliding state `z` (..., n)."""
        qd = np.asarray(qd, dtype=float)
        return Drive(self.rows, Ripple.none(len(self.delta)).rows).torque(np.zeros(qd.shape), qd, z)

    @property
    def static(self) -> np.ndarray:
        """Largest friction at rest (n,) [N m]: mean Coulomb plus Stribeck torque."""
        return 0.5 * (self.coulomb_pos + self.coulomb_neg) + np.maximum(self.stribeck, 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class FrictionBound(Shown):
    """Bound on the friction error near rest: ``|d| <= torque exp(-(qd / speed)^2) + floor``.

    Near zero speed, friction is bounded rather than random, and it is constant while the joint is at rest (Linderoth,
    Stolt, Robertsson and Johansson, IROS 2013).

    Attributes
    ----------
    torque : array, shape (n,), N m
        Largest friction at rest.
    speed : array, shape (n,), rad/s
        Width of the bound in speed; above 0.
    floor : array, shape (n,), N m
        Bound on the model error in motion.
    """

    torque: np.ndarray
    speed: np.ndarray
    floor: np.ndarray

    def __post_init__(self) -> None:
        _freeze(self)
        if np.any(self.torque < 0) or np.any(self.floor < 0) or np.any(self.speed <= 0):
            raise ShapeError(
                "Expected torque >= 0, floor >= 0 and speed > 0 in a friction bound, got other values. Correct them."
            )

    @classmethod
    def of(cls, friction: Friction, floor: np.ndarray | None = None) -> FrictionBound:
        """Return the bound for the static friction of `friction`, optionally with a floor (n,) [N m]."""
        n = len(friction.viscous)
        return cls(friction.static, np.full(n, SLOW), np.zeros(n) if floor is None else floor)

    def torque_at(self, qd: np.ndarray) -> np.ndarray:
        """Return the friction bound (..., n) [N m] at `qd` (..., n) [rad/s]."""
        return self.torque * np.exp(-((np.asarray(qd, dtype=float) / self.speed) ** 2)) + self.floor


@dataclass(frozen=True, eq=False)
class Ripple:
    """One torque ripple line per joint: ``cosine cos(cycles q) + sine sin(cycles q)``; every field has shape (n,).

    `cycles`: angular frequency with respect to the joint angle [rad/rad]; 2 |gear| for strain-wave gears. `cosine`,
    `sine`: amplitudes [N m].
    """

    cycles: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray

    def __post_init__(self) -> None:
        _freeze(self)

    @classmethod
    def none(cls, n: int) -> Ripple:
        """Return zero ripple for n joints."""
        return cls(*np.zeros((len(fields(cls)), n)))

    def torque(self, q: np.ndarray) -> np.ndarray:
        """Return the ripple torque (..., n) [N m] at `q` (..., n)."""
        zero = np.zeros(np.shape(q))
        return Drive(Friction.none(len(self.cycles)).rows, self.rows).torque(q, zero, zero)

    @property
    def rows(self) -> np.ndarray:
        """Fields in order, one row each, as `kernels.Drive` expects them."""
        return rows_of(self)


# Friction over position and speed: normalised radial basis functions, one set per direction::
#
#     F = (1 + s)/2 phi(q, |qd|)^T k_pos + (1 - s)/2 phi(q, |qd|)^T k_neg
#
# s is the presliding state. Outside the grid, phi has its value at the nearest edge. Theory: docs/theory/friction.md.


@dataclass(frozen=True, eq=False)
class RadialBasis:
    """Grid of centres over position and speed for all n joints; both directions of motion share the speeds.

    `positions`, `position_widths`: (n, P) [rad]; positions are ascending, and widths are positive. `speeds`,
    `speed_widths`: (n, S) [rad/s]; speeds are positive and ascending, and widths are positive.
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
            raise ShapeError("Expected ascending centres, speeds above 0 and positive widths, got other values.")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.positions)

    @property
    def size(self) -> int:
        """Number of basis functions per joint, 2 P S."""
        return 2 * self.positions.shape[1] * self.speeds.shape[1]

    def functions(self, i: int, q: np.ndarray, qd: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the basis functions (N, 2 P S) of joint i, positive direction first; their sum is 1."""
        at = basis_weights(q, self.positions[i], self.position_widths[i])
        along = basis_weights(np.abs(qd), self.speeds[i], self.speed_widths[i])
        phi = (at[:, :, None] * along[:, None, :]).reshape(len(at), -1)
        s = np.asarray(s, dtype=float)[:, None]
        return np.concatenate([0.5 * (1.0 + s) * phi, 0.5 * (1.0 - s) * phi], axis=1)

    def outside(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return the mask (..., n) of positions or speeds outside the grid, where the edge value applies."""
        q, speed = np.asarray(q, dtype=float), np.abs(qd)
        return (q < self.positions[:, 0]) | (q > self.positions[:, -1]) | (speed > self.speeds[:, -1])


@dataclass(frozen=True, eq=False, repr=False)
class FrictionMap(Shown):
    """Friction as a function of position and speed, added to `Friction`.

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
        """Return the arrays as `kernels.Drive` expects them."""
        b = self.basis
        return b.positions, b.position_widths, b.speeds, b.speed_widths, self.coefficients

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the torque (..., n) [N m].

        `q`, `qd`: (..., n) [rad], [rad/s]. `z`: (..., n) presliding state.
        """
        n = self.basis.n
        return Drive(Friction.none(n).rows, Ripple.none(n).rows, map=self.kernel_rows()).torque(q, qd, z)


# Torque ripple: lines over position with speed-dependent amplitude and phase.
#
#     tau_i = sum_c psi(qd)^T (a_c cos(c q) + b_c sin(c q))
#
# c counts cycles per revolution, equal to rad/rad; psi are normalised Gaussians in speed. With two directions, each
# line has separate amplitudes for positive and negative motion.


SPEEDS = 8
LARGEST = 1e15  # largest number in ripple lines, including joint numbers


def speed_basis(slowest: float, fastest: float, count: int = SPEEDS) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres and widths (count,) [rad/s] of Gaussians that are evenly spaced between two speeds."""
    slowest, fastest = number(slowest, "the slowest speed [rad/s]"), number(fastest, "the fastest speed [rad/s]")
    if count < 2 or not fastest > slowest:
        raise ShapeError(
            f"Expected at least 2 Gaussians over an increasing speed range, got {count} from {slowest:g} to "
            f"{fastest:g} rad/s."
        )
    centres = np.linspace(slowest, fastest, count)
    return centres, np.full(count, centres[1] - centres[0])


@dataclass(frozen=True, eq=False, repr=False)
class RippleLines(Shown):
    """Torque ripple of n joints as a sum of L sinusoids in position.

    Attributes
    ----------
    joint : int array, shape (L,)
        Joint of each line, counted from 0, in ascending order.
    cycles : array, shape (L,), cycles per revolution
        Frequency of each line with respect to the joint angle (in cycles per revolution, which equals rad/rad).
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
            raise ShapeError("Expected ascending speeds and positive widths for the ripple lines, got other values.")
        self._drive()  # rejects inconsistent shapes

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.speeds)

    def kernel_rows(self) -> tuple[np.ndarray, ...]:
        """Return the arrays as `kernels.Drive` expects them."""
        return self.joint.astype(float), self.cycles, self.speeds, self.widths, self.coefficients

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the ripple torque (..., n) [N m].

        `q`, `qd`: (..., n) [rad], [rad/s]. `z`: (..., n) presliding state.
        """
        return self._drive().torque(q, qd, z)

    def _drive(self) -> Drive:
        return Drive(Friction.none(self.n).rows, Ripple.none(self.n).rows, lines=self.kernel_rows())


# Warm-up of a drive through its own friction, without a temperature sensor.
#
#     dx/dt = (|F_f qd| / power - x) / time
#     coulomb: times (1 + of_coulomb x),   viscous: times (1 + of_viscous x)
#
# x >= 0 approaches 1 at a constant friction power of `power`. After Bagge Carlson, Robertsson and Johansson, IROS 2015.


@dataclass(frozen=True, eq=False, repr=False)
class WarmUp(Shown):
    """Change of friction with the thermal state of a drive.

    Attributes
    ----------
    of_coulomb : array, shape (n,)
        Relative change of Coulomb friction at thermal state 1.
    of_viscous : array, shape (n,)
        Relative change of viscous friction at thermal state 1.
    time : array, shape (n,), s
        Time constant; 0 for a drive with constant friction.
    power : array, shape (n,), W
        Friction power at which the thermal state settles at 1; above 0.
    start : array, shape (n,)
        Thermal state at the start of a record; 0 is cold.
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
                raise ShapeError(f"Expected finite {entry.name} with one number per joint, got shape {values.shape}.")
            object.__setattr__(self, entry.name, values)
        if np.any(self.time < 0) or np.any(self.power <= 0) or np.any(self.start < 0):
            raise ShapeError("Expected time >= 0, power > 0 and start >= 0 for the warm-up, got other values.")

    def kernel_rows(self) -> np.ndarray:
        """Return the arrays as `kernels.Drive` expects them."""
        return rows_of(self)

    def thermal_state(self, power: np.ndarray, dt: np.ndarray) -> np.ndarray:
        """Return the thermal state (N, n) before each row, for friction power that is constant over each step.

        `power`: (N, n) |F_f qd| [W]. `dt`: (N,) steps [s].
        """
        x = np.empty(np.shape(power))
        now = self.start
        heats = self.time > 0
        for k, (heat, step) in enumerate(zip(np.asarray(power) / self.power, dt)):
            x[k] = now
            now = np.where(heats, heat + (now - heat) * np.exp(-step / np.where(heats, self.time, 1.0)), now)
        return x
