"""An estimated wrench against the true one, or that of a force sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.errors import ShapeError, UnknownName
from armlab.log import Table

__all__ = ["Comparison", "compare"]

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
