"""Intervals of contact: where zero force is outside the 95 % ellipsoid of the estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.errors import ShapeError
from armlab.log import Table

__all__ = ["Contact", "contacts"]

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
