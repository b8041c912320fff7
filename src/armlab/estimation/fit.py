"""The result of every `fit_*`: a value that never comes without its covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from armlab import models
from armlab.errors import ConfigError, ShapeError
from armlab.estimation.excitation import Excitation

__all__ = ["Fit"]

Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Fit(Generic[Value]):
    """A fitted value with its covariance, residuals and excitation.

    Attributes
    ----------
    value : what was fitted; what a robot loads.
    names, units : of the d parameters.
    parameters : (d,) their values. cov : (d, d) their covariance.
    sigma : noise found per class of measurement, in its unit.
    residuals : (N, ...) in SI, unwhitened.
    n : number of samples used.
    excitation : what the data could tell.
    summary : makes the text of `report`.
    """

    value: Value
    names: tuple[str, ...]
    units: tuple[str, ...]
    parameters: np.ndarray
    cov: np.ndarray
    sigma: np.ndarray
    residuals: np.ndarray
    n: int
    excitation: Excitation
    summary: Callable[[Fit[Value]], str] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check shapes and freeze the arrays."""
        d = len(self.names)
        if len(self.units) != d or np.shape(self.parameters) != (d,) or np.shape(self.cov) != (d, d):
            raise ShapeError(
                f"Expected {d} units, parameters of shape ({d},) and cov of shape ({d}, {d}) for {d} names, got "
                f"{len(self.units)}, {np.shape(self.parameters)} and {np.shape(self.cov)}. This is a fault of the fit."
            )
        for name in ("parameters", "cov", "sigma", "residuals"):
            values = np.array(getattr(self, name), dtype=float)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each parameter (d,)."""
        return np.sqrt(np.diag(self.cov))

    def report(self) -> str:
        """Return the fit in words and tables."""
        if self.summary is not None:
            return self.summary(self)
        columns = zip(self.names, self.parameters, self.sd, self.units)
        rows = [f"{name:32s} {value: .6g} +- {sd:.2g} {unit}" for name, value, sd, unit in columns]
        return "\n".join([*rows, f"{self.n} samples", self.excitation.text()])

    def save(self, path: str | Path) -> Path:
        """Write the value to a model file and return its path; see `armlab.models.save`."""
        if not isinstance(self.value, models.TorqueModel):
            raise ConfigError(
                f"Expected a fit whose value has a file format, got {type(self.value).__name__}. "
                "Save its numbers yourself."
            )
        return models.save(self.value, path)
