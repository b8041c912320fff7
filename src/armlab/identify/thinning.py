"""Zero-phase low-pass and decimation of a long record in one pass, block by block.

    y_m = sum_j h_j x_{m every + j},   |j| <= L

with h the impulse response of a Butterworth filter run forward and backward, cut where it has decayed. Torque and every
column of the regressor pass the same h, so linear relations survive it exactly. Only the rows that are kept are
computed, as products with a narrow matrix, and never more than a few thousand rows of the regressor exist at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from armlab.identify.preparation import Prepared

__all__ = ["Piece", "Thinning"]

ORDER = 4
DECAYED = 1e-6  # of the largest tap
AT_ONCE = 1024  # rows of the record: their regressor stays in the cache
WIDE, NARROW = 64, 16  # columns: of fewer than the first more rows at once
BAND = 32  # kept rows of one product


@dataclass(frozen=True)
class Piece:
    """Rows `start` to `stop` of a record give the kept rows `first` to `last`, continued by `before` and `after`."""

    start: int
    stop: int
    before: int
    after: int
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Thinning:
    """A zero-phase filter that keeps every few rows of each segment.

    Attributes
    ----------
    segments : (start, stop) of each piece of the record without a gap.
    every : rows from one kept row to the next.
    taps : (2 L + 1,) impulse response h; one tap, 1, filters nothing.
    rows : (M,) rows that are kept.
    """

    segments: tuple[tuple[int, int], ...]
    every: int
    taps: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, data: Prepared, cutoff: float, every: int) -> Thinning:
        """Return the filter for a record.

        Parameters
        ----------
        data : the record.
        cutoff : corner of one pass [Hz]; infinite for none.
        every : rows from one kept row to the next.
        """
        taps = np.ones(1) if np.isinf(cutoff) else _taps(cutoff / data.rate)
        rows = np.concatenate([np.arange(a, b, every) for a, b in data.segments])
        return cls(data.segments, every, taps, rows)

    def run(self, columns: Callable[[int, int], np.ndarray], width: int) -> np.ndarray:
        """Return the kept rows (M, width) of columns that are made on the fly.

        Parameters
        ----------
        columns : (start, stop) -> rows (stop - start, width) of the record.
        width : number of columns.
        """
        out = np.empty((len(self.rows), width))
        for piece in self.pieces(AT_ONCE * max(1, WIDE // max(width, 1))):
            self.thin(piece, columns(piece.start, piece.stop), out[piece.first : piece.last])
        return out

    def pieces(self, rows: int = AT_ONCE) -> Iterator[Piece]:
        """Yield what rows of the record are needed for what kept rows, about so many rows of the record at once."""
        reach, count = len(self.taps) // 2, max(BAND, rows // self.every // BAND * BAND)
        first = 0
        for a, b in self.segments:
            kept = -(-(b - a) // self.every)
            for k in range(0, kept, count):
                last = min(k + count, kept)
                start, stop = a + self.every * k - reach, a + self.every * (last - 1) + reach + 1
                inside = max(start, a), min(stop, b)
                yield Piece(*inside, inside[0] - start, stop - inside[1], first + k, first + last)
            first += kept

    def thin(self, piece: Piece, x: np.ndarray, out: np.ndarray) -> None:
        """Write the kept rows of one piece; ends of a segment are continued by point reflection.

        Parameters
        ----------
        piece : from `pieces`. x : (stop - start, C) its rows. out : (last - first, C) where they go.
        """
        if piece.before or piece.after:
            x = _continued(x, piece.before, piece.after)
        if len(self.taps) == 1:
            out[:] = x[:: self.every]
            return
        T, kept, done = self._band, piece.last - piece.first, 0
        if 0 < x.shape[1] <= NARROW and kept >= BAND:
            # Few columns: all bands side by side, in one product.
            bands = kept // BAND
            windows = sliding_window_view(x, T.shape[1], axis=0)[:: self.every * BAND][:bands]
            product = T @ windows.transpose(2, 0, 1).reshape(T.shape[1], -1)
            done = bands * BAND
            out[:done] = product.reshape(BAND, bands, -1).transpose(1, 0, 2).reshape(done, -1)
        for k in range(done, kept, BAND):
            m = min(BAND, kept - k)
            width = self.every * (m - 1) + len(self.taps)
            np.matmul(T[:m, :width], x[self.every * k : self.every * k + width], out=out[k : k + m])

    @cached_property
    def _band(self) -> np.ndarray:
        """The matrix of BAND kept rows: the taps, moved by `every` from row to row."""
        T = np.zeros((BAND, self.every * (BAND - 1) + len(self.taps)))
        for k in range(BAND):
            T[k, self.every * k : self.every * k + len(self.taps)] = self.taps
        return T


def _continued(x: np.ndarray, before: int, after: int) -> np.ndarray:
    """Return x (N, C) with rows before and after it, reflected at its ends."""
    if max(before, after) >= len(x):
        return np.pad(x, ((before, after), (0, 0)), mode="reflect", reflect_type="odd")
    out = np.empty((before + len(x) + after, x.shape[1]))  # ten times as fast, for the usual piece
    out[before : before + len(x)] = x
    np.subtract(2.0 * x[0], x[before:0:-1], out=out[:before])
    np.subtract(2.0 * x[-1], x[-2 : -2 - after : -1], out=out[before + len(x) :])
    return out


def _taps(corner: float) -> np.ndarray:
    """Return the impulse response of the filter, forward and backward, at `corner` cycles per sample."""
    from scipy.signal import butter, sosfilt

    sections = np.asarray(butter(ORDER, 2.0 * corner, output="sos"))
    impulse = np.zeros(int(np.ceil(12.0 / corner)))
    impulse[0] = 1.0
    response = np.asarray(sosfilt(sections, impulse))
    size = 2 ** int(np.ceil(np.log2(2 * len(response))))
    h = np.fft.irfft(np.abs(np.fft.rfft(response, size)) ** 2, size)[: len(response)]
    reach = int(np.flatnonzero(np.abs(h) > DECAYED * h[0])[-1])
    taps = np.concatenate([h[reach:0:-1], h[: reach + 1]])
    return taps / taps.sum()
