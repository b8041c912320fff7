"""Result of every `fit_*`: a value together with its covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import numpy as np

from armlab import models
from armlab._display import Shown, brief, html_table
from armlab._numbers import rows_text
from armlab.errors import ConfigError, ShapeError
from armlab.estimation.linear_problem import Excitation
from armlab.models.files import load_statistics

Value = TypeVar("Value")

READ_ONLY = ("parameters", "sigma", "residuals", "outliers", "formal_cov")
SAVED = ("doubts", "names", "units", "parameters", "cov", "classes", "sigma", "outliers", "n", "rank")
EXCITATION = ("expected", "singular_values", "weakest", "held", "null_names")


def _frozen(values: Any, kind: type = float) -> np.ndarray:
    """Return a read-only array, without a copy if it is already read-only and owns its data."""
    if type(values) is np.ndarray and values.dtype == kind and values.flags.owndata and not values.flags.writeable:
        return values
    values = np.array(values, dtype=kind)
    values.flags.writeable = False
    return values


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Shown, Generic[Value]):
    """A fitted value with its covariance, residuals and excitation.

    Attributes
    ----------
    value : Value
        The fitted value.
    names, units : tuple of str
        Names and units of the d parameters.
    parameters : ndarray, shape (d,)
        Parameter values.
    cov : ndarray, shape (d, d)
        Covariance of the parameters with rank `rank`; zero along unidentified directions.
    sigma : ndarray
        Estimated noise standard deviation of each measurement class, in the unit of the class.
    residuals : ndarray, shape (N, ...)
        Residuals in SI units, not whitened; empty if the fit was read from a file.
    n : int
        Number of samples used.
    excitation : Excitation
        Identified directions, and how well the data excite them.
    summary : callable, optional
        Function that returns the text of `report`.
    outliers : ndarray of bool, shape (N,)
        True for excluded samples; empty for fits without outlier detection.
    classes : tuple of str
        Names and units of the measurement classes, such as "position [m]".
    formal_cov : ndarray, shape (d, d), optional
        Covariance for white residuals; far too small if the residuals are correlated in time. None if `cov` itself
        assumes white residuals, or if the fit was read from a file.
    doubts : tuple of str
        Reasons why the fit may be unreliable, such as failed residual tests or suspicious units, one sentence each.
        Empty for a good fit.
    notes : tuple of str
        Report lines on repaired data and on directions held by a prior; empty if the fit was read from a file.
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
    outliers: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    classes: tuple[str, ...] = ()
    formal_cov: np.ndarray | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        d = len(self.names)
        if len(self.units) != d or np.shape(self.parameters) != (d,):
            raise ShapeError(
                f"Expected {d} units and parameters of shape ({d},) for {d} names, got {len(self.units)} and "
                f"{np.shape(self.parameters)}. This is a bug in the fit."
            )
        cov = _frozen(self.cov)
        if cov.shape != (d, d):
            raise ShapeError(
                f"Expected cov of shape ({d}, {d}) for {d} names, got {cov.shape}. This is a bug in the fit."
            )
        if not np.isfinite(cov).all() or (d and cov.diagonal().min() < 0):
            raise ShapeError(
                "Expected a finite covariance with a non-negative diagonal, got a negative, NaN or infinite entry. "
                "This is a bug in the fit."
            )
        object.__setattr__(self, "cov", cov)
        for name in ("names", "units", "doubts"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in READ_ONLY:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _frozen(getattr(self, name), bool if name == "outliers" else float))

    def __reduce__(self) -> tuple[Any, ...]:
        """Support copying and pickling by storing the report as text."""
        kept = {f.name: getattr(self, f.name) for f in fields(self)}
        if self.summary is not None:
            kept["summary"] = partial(_said, self.report())
        return type(self), tuple(kept.values())

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each parameter (d,)."""
        return np.sqrt(np.diag(self.cov))

    @property
    def good(self) -> bool:
        """Whether the fit is reliable; if not, `doubts` lists the reasons."""
        return not self.doubts

    @property
    def rank(self) -> int:
        """Number of identified directions: the rank of the covariance scaled to a unit diagonal."""
        sd = np.where(self.sd > 0, self.sd, 1.0)
        return int(np.linalg.matrix_rank(self.cov / np.outer(sd, sd), tol=1e-9, hermitian=True)) if len(sd) else 0

    def _repr_html_(self) -> str:
        columns = zip(self.names, self.parameters, self.sd, self.units)
        rows = [(name, f"{value:.6g}", f"{sd:.2g}", unit) for name, value, sd, unit in columns]
        after = [f"{self.n} samples", self.excitation.text(), *(f"not good: {doubt}" for doubt in self.doubts)]
        return html_table(f"Fit of {brief(self.value)}", ("parameter", "value", "sd", "unit"), rows, after)

    def report(self) -> str:
        """Return the report of the fit as text with tables."""
        return self.table() if self.summary is None else self.summary(self)

    def table(self, shown: np.ndarray | None = None) -> str:
        """Return one line per parameter with standard deviation and unit, then the noise, outliers and doubts.

        Parameters
        ----------
        shown : ndarray of bool, shape (d,), optional
            Parameters to list; default: all.
        """
        rows = zip(self.names, self.parameters, self.sd, self.units)
        listed = [row for k, row in enumerate(rows) if shown is None or shown[k]]
        lines = [f"{name:32s} {value: .6g} +- {sd:.2g} {unit}" for name, value, sd, unit in listed]
        labels = self.classes or [f"class {i + 1}" for i in range(self.sigma.size)]
        lines += [f"noise of {label}: {sigma:.3g}" for label, sigma in zip(labels, self.sigma.ravel())]
        left_out = np.flatnonzero(self.outliers)
        if len(left_out):
            lines.append(f"{len(left_out)} outliers excluded: {rows_text(left_out)}")
        excitation = self.excitation.text() if self.good else self.excitation.text().replace(" good:", " sufficient:")
        return "\n".join([*lines, f"{self.n} samples", excitation, *(f"not good: {doubt}" for doubt in self.doubts)])

    def save(self, path: str | Path, sources: Sequence[str] = ()) -> Path:
        """Write the value, covariance, noise and flags to a model file, and return its path; see `armlab.models.save`.

        Parameters
        ----------
        path : path of the file, ending in ``.toml``.
        sources : files that contain the samples; their names are stored with SHA-256 checksums.
        """
        statistics = {name: getattr(self, name) for name in SAVED}
        statistics |= {f"excitation_{name}": getattr(self.excitation, name) for name in EXCITATION}
        return models.save(self.value, path, {**statistics, "excitation_rank": self.excitation.rank}, sources)

    @classmethod
    def load(cls, path: str | Path, kind: str | None = None) -> Fit[Any]:
        """Read a fit written by `save`; the residuals are not stored.

        Parameters
        ----------
        path : path of a model file.
        kind : required kind of the file; default: any.

        Raises
        ------
        ConfigError : the file is damaged, or contains a value without a fit.
        ModelMismatchError : the file is of a different kind.
        """
        value, known = models.load(path, kind), load_statistics(path)
        try:
            excitation = Excitation(
                known["excitation_rank"], **{name: known[f"excitation_{name}"] for name in EXCITATION}
            )
            parts = {name: known[name] for name in SAVED if name != "rank"}
        except KeyError as error:
            raise ConfigError(
                f"Expected a value with its fit in {path}, but {error} is missing. The value was saved without a fit: "
                "use armlab.models.load."
            ) from None
        return cls(value=value, residuals=np.zeros(0), excitation=excitation, **parts)


@overload
def value_of(given: Fit[Value]) -> Value: ...
@overload
def value_of(given: Fit[Value] | Value) -> Value: ...
def value_of(given: Any) -> Any:
    """Return the value of a fit; return any other object unchanged."""
    return given.value if isinstance(given, Fit) else given


def _said(text: str, fit: Fit[Any]) -> str:
    return text
