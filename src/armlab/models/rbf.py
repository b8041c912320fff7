"""Friction over position and speed by normalised radial basis functions, one set for each direction.

After Bagge Carlson, Robertsson and Johansson, "Modeling and identification of position and temperature dependent
friction phenomena without temperature sensing", IROS 2015::

    F = (1 + s)/2 phi(q, |qd|)^T k_pos + (1 - s)/2 phi(q, |qd|)^T k_neg
    phi_ab = exp(-((q - p_a) / w_a)^2 - ((|qd| - v_b) / u_b)^2), divided by their sum over a and b

s is the sign that friction goes by: the presliding state, which blends both sides at rest. Outside its hull phi keeps
the value of the nearest edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError
from armlab.kernels import Drive, basis_weights

__all__ = ["FrictionMap", "RadialBasis"]


@dataclass(frozen=True, eq=False)
class RadialBasis:
    """Centres of all n joints on a grid of positions and speeds; speeds are positive and stand for both directions.

    Attributes
    ----------
    positions, position_widths : (n, P) [rad], ascending; positive.
    speeds, speed_widths : (n, S) [rad/s], ascending and above 0; positive.
    """

    positions: np.ndarray
    position_widths: np.ndarray
    speeds: np.ndarray
    speed_widths: np.ndarray

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        for name in ("positions", "position_widths", "speeds", "speed_widths"):
            values = still(getattr(self, name), f"{name} of radial bases")
            object.__setattr__(self, name, values)
        p, v = self.positions, self.speeds
        if (
            p.ndim != 2
            or v.ndim != 2
            or len(p) != len(v)
            or p.shape != self.position_widths.shape
            or v.shape != self.speed_widths.shape
        ):
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
        """Return the functions (N, 2 P S) of joint i, positive direction first; their sum is 1.

        Parameters
        ----------
        i : joint.
        q, qd, s : (N,) position [rad], velocity [rad/s] and sign in [-1, 1].
        """
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
    basis : centres and widths. coefficients : (n, 2, P, S) [N m], positive direction first; zero for joints without.
    """

    basis: RadialBasis
    coefficients: np.ndarray

    def __post_init__(self) -> None:
        """Check the shape and freeze."""
        values = still(self.coefficients, "coefficients of radial bases")
        shape = (self.basis.n, 2, self.basis.positions.shape[1], self.basis.speeds.shape[1])
        if values.shape != shape or not np.isfinite(values).all():
            raise ShapeError(f"Expected finite coefficients of shape {shape}, got shape {values.shape}.")
        object.__setattr__(self, "coefficients", values)

    def kernel_rows(self) -> tuple[np.ndarray, ...]:
        """Return the arrays as `kernels.Drive` takes them."""
        b = self.basis
        return b.positions, b.position_widths, b.speeds, b.speed_widths, self.coefficients

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the torque (..., n) [N m].

        Parameters
        ----------
        q, qd : (..., n) [rad], [rad/s]. z : (..., n) presliding state.
        """
        friction = np.zeros((10, self.basis.n))
        friction[5:7] = 1.0  # widths of terms that are zero
        return Drive(friction, np.zeros((3, self.basis.n)), map=self.kernel_rows()).torque(q, qd, z)
