"""What happens to an arm while a movement primitive runs: `Hold`, `Push`, `Displace`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers
from armlab.errors import ShapeError

__all__ = ["Displace", "Hold", "Push"]

Dofs = Sequence[int] | None


@dataclass(frozen=True)
class Push:
    """Something moves coordinates with a constant velocity, against their will: ``ya' = velocity``.

    Attributes
    ----------
    t0, t1 : from and to which time [s].
    velocity : one number, or one for each of the coordinates pushed, in the unit of y per second.
    dofs : numbers of the coordinates from 0; all of them when None.

    Raises
    ------
    ShapeError : times that are not finite or do not increase, or velocities that are not finite.
    """

    t0: float
    t1: float
    velocity: float | Sequence[float] | np.ndarray
    dofs: Dofs = None

    def __post_init__(self) -> None:
        """Check times and velocities."""
        start, end = number(self.t0, "t0 [s]"), number(self.t1, "t1 [s]")
        if not -np.inf < start < end < np.inf:
            raise ShapeError(f"Expected an event from t0 to a later t1, got {start:g} to {end:g} s.")
        if not np.isfinite(numbers(self.velocity, "velocity", ShapeError)).all():
            raise ShapeError(f"Expected a finite velocity, got {self.velocity}.")

    def drive(self, n: int) -> np.ndarray:
        """Return the velocity (n,) that it forces, NaN where it leaves a coordinate alone.

        Parameters
        ----------
        n : number of coordinates.

        Raises
        ------
        ShapeError : a coordinate that does not exist, or another number of velocities.
        """
        which = np.arange(n) if self.dofs is None else np.asarray(self.dofs)
        whole = which.ndim == 1 and which.dtype.kind in "iu" and bool(((which >= 0) & (which < n)).all())
        if not whole or not which.size or len(set(which.tolist())) < len(which):
            raise ShapeError(f"Expected dofs as different numbers from 0 to {n - 1}, got {self.dofs}.")
        velocity = numbers(self.velocity, "velocity", ShapeError)
        if velocity.shape not in ((), which.shape):
            raise ShapeError(f"Expected one velocity, or {which.size} for as many dofs, got shape {velocity.shape}.")
        driven = np.full(n, np.nan)
        driven[which] = velocity
        return driven


class Hold(Push):
    """A hand holds coordinates where they are: ``ya' = 0``, and ya stays.

    Parameters
    ----------
    t0, t1 : from and to which time [s].
    dofs : numbers of the coordinates from 0; all of them when None.

    Raises
    ------
    ShapeError : times that are not finite or do not increase.
    """

    def __init__(self, t0: float, t1: float, dofs: Dofs = None) -> None:
        super().__init__(t0, t1, 0.0, dofs)


@dataclass(frozen=True, eq=False)
class Displace:
    """A blow moves the arm at once: ``ya`` jumps by dy at time t.

    Attributes
    ----------
    t : when [s]. dy : (n,) or one number for all, in the unit of y.

    Raises
    ------
    ShapeError : a time or displacement that is not finite.
    """

    t: float
    dy: ArrayLike

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not np.isfinite(number(self.t, "t [s]")) or not np.isfinite(numbers(self.dy, "dy", ShapeError)).all():
            raise ShapeError(f"Expected a finite time and displacement, got {self.t} and {self.dy}.")
