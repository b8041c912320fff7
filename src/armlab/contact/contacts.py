"""Intervals of contact, and the comparison of estimated with measured wrenches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.errors import ShapeError, UnknownName
from armlab.log import Table

CHI2_95 = 7.81  # 95 % of a chi-squared variable with three degrees of freedom
SHORTEST = 0.2  # s; shorter excursions are what 5 % of the samples do without contact
HOLE = 0.1  # s; shorter returns do not end a contact


@dataclass(frozen=True)
class Contact:
    """One interval of contact.

    Attributes
    ----------
    start, end : seconds of the table's clock.
    force : mean force (fx, fy, fz) [N], base axes.
    band : mean 2-sigma of the least certain axis [N].
    """

    start: float
    end: float
    force: tuple[float, float, float]
    band: float


def contacts(table: Table) -> list[Contact]:
    """Return the intervals of at least 0.2 s in which ``f^T Sigma^-1 f > 7.81``, in most of their rows.

    Without contact 5 % of the rows are beyond that, and a filter that is slow lines them up: so one that is not beyond
    it most of the time is none.

    Parameters
    ----------
    table : with wrench_hat and wrench_hat_cov, from `Estimator.run`.

    Raises
    ------
    ShapeError : something else than a table. UnknownName : it was not estimated.
    """
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    force, cov = table["wrench_hat"][:, :3], table["wrench_hat_cov"][:, :3, :3]
    known = np.isfinite(force).all(axis=1)
    distance = np.zeros(len(table))
    distance[known] = np.einsum("ki,ki->k", force[known], np.linalg.solve(cov[known], force[known][..., None])[..., 0])
    touched = distance > CHI2_95
    edges = np.flatnonzero(np.diff(touched.astype(int), prepend=0, append=0))
    spans = [(float(table.t[a]), float(table.t[b - 1])) for a, b in edges.reshape(-1, 2)]
    merged: list[tuple[float, float]] = []
    for start, end in spans:
        if merged and start - merged[-1][1] < HOLE:
            merged[-1] = (merged[-1][0], end)
        else:
            merged.append((start, end))
    long = [(start, end) for start, end in merged if end - start >= SHORTEST]
    mostly = [np.mean(touched[(table.t >= start) & (table.t <= end)]) > 0.5 for start, end in long]
    return [_contact(table, start, end) for (start, end), counts in zip(long, mostly) if counts]


def _contact(table: Table, start: float, end: float) -> Contact:
    rows = (table.t >= start) & (table.t <= end)
    x, y, z = np.nanmean(table["wrench_hat"][rows, :3], axis=0)
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"][rows])[:, :3])
    return Contact(float(start), float(end), (float(x), float(y), float(z)), float(2 * np.nanmean(sigma, axis=0).max()))


# An estimated wrench against the true one, or that of a force sensor.


SOURCES = {"wrench_true": "the true wrench", "wrench": "the force sensor"}


@dataclass(frozen=True, eq=False)
class Comparison:
    """How far an estimate is from what it should be.

    Attributes
    ----------
    against : what it was compared with. rows : rows in which both are known.
    rms : (6,) error per axis [N, N m]. inside : (6,) share of the errors inside two sigma.
    """

    against: str
    rows: int
    rms: np.ndarray
    inside: np.ndarray

    def text(self) -> str:
        """Return the forces in one line."""
        rms = " ".join(f"{value:.2f}" for value in self.rms[:3])
        share = 100 * float(np.mean(self.inside[:3]))
        return f"force x y z against {self.against}: {rms} N RMS, {share:.0f} % inside 2 sigma"


def compare(table: Table) -> Comparison:
    """Compare an estimate with the true wrench where the table has it, else with a force sensor.

    Errors are ``wrench_hat - wrench_true`` (or the column `wrench`); a true covariance holds 95.4 % of them inside two
    sigma.

    Parameters
    ----------
    table : with wrench_hat (N, 6), wrench_hat_cov (N, 6, 6), and wrench_true or wrench (N, 6); base axes, tool point.

    Raises
    ------
    UnknownName : a column is missing, or no row has both. ShapeError : something else than a table.
    """
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    for name in ("wrench_hat", "wrench_hat_cov"):
        if name not in table:
            raise UnknownName.among("column of a comparison", name, table.names)
    source = next((name for name in SOURCES if name in table), None)
    if source is None:
        raise UnknownName.among("column to compare a wrench with", " or ".join(SOURCES), table.names)
    error = table["wrench_hat"] - table[source]
    known = np.isfinite(error).all(axis=1)
    if not known.any():
        raise UnknownName(f"Expected rows with an estimate and with {source}, got none among {len(table)}.")
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
    rms = np.sqrt(np.mean(error[known] ** 2, axis=0))
    inside = np.mean(np.abs(error[known]) <= 2 * sigma[known], axis=0)
    for array in (rms, inside):
        array.flags.writeable = False
    return Comparison(SOURCES[source], int(known.sum()), rms, inside)
