"""Rows of a regression over joint torque for the solver, joint by joint and in pieces of bounded size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.estimation import Rows

__all__ = ["DesignRows"]

AT_ONCE = 8192  # rows handed to the solver


@dataclass(frozen=True, eq=False)
class DesignRows:
    """Rows of J joints; reading it again makes them again.

    Attributes
    ----------
    tau : (M, J) torque. rigid, local : of each joint (M, w) and (M, k), its columns, in this order.
    columns : of each joint (w + k,), the parameters that they belong to.
    block : (M,) number of the block of time of each row. trust : (M, J) weights of the rows, None for 1.
    """

    tau: np.ndarray
    rigid: Sequence[np.ndarray]
    local: Sequence[np.ndarray]
    columns: Sequence[np.ndarray]
    block: np.ndarray
    trust: np.ndarray | None

    def __iter__(self) -> Iterator[Rows]:
        """Yield the rows of one joint after the other."""
        for i, columns in enumerate(self.columns):
            for a in range(0, len(self.block), AT_ONCE):
                part = slice(a, a + AT_ONCE)
                A, y = np.hstack([self.rigid[i][part], self.local[i][part]]), self.tau[part, i]
                if self.trust is not None:
                    A, y = A * self.trust[part, i, None], y * self.trust[part, i]
                yield Rows(A, y, self.block[part], i, columns)
