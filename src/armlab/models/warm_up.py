"""Friction that changes as a drive warms up by its own friction, without a temperature sensor.

    dx/dt = (|F_f qd| / power - x) / time
    coulomb: times (1 + of_coulomb x),   viscous: times (1 + of_viscous x)

x >= 0 is 1 where a drive has rubbed with the power `power` for long. The idea is that of Bagge Carlson, Robertsson and
Johansson, IROS 2015.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError

__all__ = ["WarmUp"]


@dataclass(frozen=True, eq=False)
class WarmUp:
    """How warmth changes friction; every field has shape (n,).

    Attributes
    ----------
    of_coulomb, of_viscous : relative change of Coulomb and viscous friction at warmth 1.
    time : time constant [s]; 0 for a drive that does not change.
    power : friction power at which warmth settles at 1 [W]; above 0.
    start : warmth at the beginning of a record; 0 is cold.
    """

    of_coulomb: np.ndarray
    of_viscous: np.ndarray
    time: np.ndarray
    power: np.ndarray
    start: np.ndarray

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        for entry in fields(self):
            values = still(getattr(self, entry.name), f"{entry.name} of the warm-up")
            if values.ndim != 1 or values.shape != np.shape(self.of_coulomb) or not np.isfinite(values).all():
                raise ShapeError(f"Expected finite {entry.name} of one number per joint, got shape {values.shape}.")
            object.__setattr__(self, entry.name, values)
        if np.any(self.time < 0) or np.any(self.power <= 0) or np.any(self.start < 0):
            raise ShapeError("Expected time >= 0, power > 0 and start >= 0 of the warm-up, got others.")

    def kernel_rows(self) -> np.ndarray:
        """Return the rows (5, n) as `kernels.Drive` takes them."""
        return np.stack([getattr(self, entry.name) for entry in fields(self)])

    def warmth(self, power: np.ndarray, dt: np.ndarray) -> np.ndarray:
        """Return the warmth (N, n) before each row, for friction power (N, n) [W] held over steps dt (N,) [s].

        Parameters
        ----------
        power : (N, n) |F_f qd|. dt : (N,).
        """
        x = np.empty(np.shape(power))
        now = self.start
        heats = self.time > 0
        for k, (heat, step) in enumerate(zip(np.asarray(power) / self.power, dt)):
            x[k] = now
            now = np.where(heats, heat + (now - heat) * np.exp(-step / np.where(heats, self.time, 1.0)), now)
        return x
