"""Torque ripple as lines over position whose amplitude and phase depend on speed.

    tau_i = sum_c psi(qd)^T (a_c cos(c q) + b_c sin(c q))

c counts cycles per revolution, equal to rad/rad; psi are normalised Gaussians in speed. With two directions each line
has amplitudes of its own for positive and negative motion, so that amplitude and phase may jump at reversal::

    psi = [(1 + s)/2 psi(|qd|), (1 - s)/2 psi(|qd|)],   s: the sign that friction goes by, the presliding state

It is evaluated from q itself: no filter delays it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import number, still
from armlab.errors import ShapeError
from armlab.kernels import Drive

__all__ = ["RippleLines", "speed_basis"]

SPEEDS = 8
LARGEST = 1e15  # of the numbers of ripple lines, joint numbers among them


def speed_basis(slowest: float, fastest: float, count: int = SPEEDS) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and widths (count,) [rad/s] of Gaussians spread evenly from one speed to another.

    Parameters
    ----------
    slowest, fastest : ends of the range; 0 and the peak speed for lines with two directions, minus and plus the peak
        speed for others.
    count : of Gaussians, at least 2.
    """
    slowest, fastest = number(slowest, "the slowest speed [rad/s]"), number(fastest, "the fastest speed [rad/s]")
    if count < 2 or not fastest > slowest:
        raise ShapeError(f"Expected at least 2 Gaussians from one speed to a faster one, got {count} from {slowest:g} "
                         f"to {fastest:g} rad/s.")  # fmt: skip
    centres = np.linspace(slowest, fastest, count)
    return centres, np.full(count, centres[1] - centres[0])


@dataclass(frozen=True, eq=False)
class RippleLines:
    """Lines of torque ripple of n joints, L in all.

    Attributes
    ----------
    joint : (L,) number of the joint from 0, in ascending order. cycles : (L,) cycles per revolution.
    speeds, widths : (n, S) centres and widths of the Gaussians [rad/s].
    coefficients : (L, D, S, 2) amplitudes of cosine and sine [N m] for D = 1 or 2 directions, positive first.
    """

    joint: np.ndarray
    cycles: np.ndarray
    speeds: np.ndarray
    widths: np.ndarray
    coefficients: np.ndarray

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        for name in ("joint", "cycles", "speeds", "widths", "coefficients"):
            values = still(getattr(self, name), f"{name} of the ripple lines")
            if not np.all(np.abs(values) < LARGEST):
                raise ShapeError(f"Expected finite {name} of the ripple lines, got NaN or Inf.")
            object.__setattr__(self, name, values.astype(int) if name == "joint" else values)
        self.joint.flags.writeable = False
        if np.any(self.widths <= 0) or self.speeds.ndim != 2 or np.any(np.diff(self.speeds, axis=-1) <= 0):
            raise ShapeError("Expected ascending speeds and positive widths of the ripple lines, got others.")
        Drive(np.ones((10, len(self.speeds))), np.zeros((3, len(self.speeds))), lines=self.kernel_rows())

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.speeds)

    def kernel_rows(self) -> tuple[np.ndarray, ...]:
        """Return the arrays as `kernels.Drive` takes them."""
        return self.joint.astype(float), self.cycles, self.speeds, self.widths, self.coefficients

    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the ripple torque (..., n) [N m].

        Parameters
        ----------
        q, qd : (..., n) [rad], [rad/s]. z : (..., n) presliding state.
        """
        friction = np.zeros((10, self.n))
        friction[5:7] = 1.0  # widths of terms that are zero
        return Drive(friction, np.zeros((3, self.n)), lines=self.kernel_rows()).torque(q, qd, z)
