"""`Recent`: the last seconds of a stream as one array; curves and paths of tools are drawn from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["Recent"]

_ROOM = 256  # rows for which there is room at least


class Recent:
    """Samples of the last seconds; adding one costs the same however many there are.

    Parameters
    ----------
    width : numbers of a sample. seconds : before the newest sample; what is older is forgotten.
    """

    def __init__(self, width: int, seconds: float) -> None:
        self._table, self._seconds = np.empty((_ROOM, 1 + width)), seconds
        self._first = self._end = 0

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def t(self) -> np.ndarray:
        """Times (N,); they do not change when samples are added."""
        return self._table[self._first : self._end, 0]

    @property
    def values(self) -> np.ndarray:
        """Samples (N, width); they do not change when samples are added."""
        return self._table[self._first : self._end, 1:]

    def add(self, t: float, values: ArrayLike) -> None:
        """Add a sample.

        Parameters
        ----------
        t : [s], not before the last one. values : (width,).
        """
        if self._end == len(self._table):  # what is kept goes to the front of another array: views of this one stay
            kept = self._table[self._first :]
            self._table = np.empty((max(_ROOM, 2 * len(kept)), self._table.shape[1]))
            self._table[: len(kept)] = kept
            self._first, self._end = 0, len(kept)
        row = self._table[self._end]
        row[0], row[1:] = t, values
        self._end += 1
        self._first += int(np.searchsorted(self.t, t - self._seconds))

    def clear(self) -> None:
        """Forget all."""
        self._first = self._end
