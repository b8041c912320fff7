"""Clocks of a log: uniform time of the rows, interpolation of lost rows, and delays of columns.

Controllers sample at even intervals, but networks and loggers make timestamps uneven. The row clock is a monotone fit
of timestamp against row number: piecewise linear through the median timestamps of two-second blocks. A row counts as
lost if all later timestamps are delayed by a period; if a row is merely late, later rows are not delayed.

A column with delay T lags the motion by T. The estimate minimises ``sum_i w_i log R_i(T)`` over shifts
of the column, with R_i the residual power of the regression for joint i. The weight w_i is the second derivative of log
R_i divided by the variance of the first derivative. This variance is estimated from the scatter between blocks of half
a second, so slow torque errors hardly affect the delay. The variance of the delay is the inverse of the weighted second
derivative, or, if larger, the scatter of the joints' delays, multiplied by a Student's t factor if there are few
joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

BRIDGED = 4  # consecutive lost rows that are interpolated; longer gaps end a segment
WINDOW = 50  # number of rows within which the timestamps recover from a late row
CAUGHT_UP = 0.25  # periods: jitter of the earliest row in the window
BLOCK = 2.0  # s, length of the blocks for the medians
JITTER = 0.01  # fraction of the period below which jitter is timestamp rounding
EARLIEST, LATEST = -0.06, 0.32  # s, range of the delay search
STEP = 0.004  # s, spacing of the shifts in the coarse search
LEAST, SURE = 0.5, 4.0  # minimum delay that is corrected, in periods and in standard deviations
DOUBT, SAMPLED = 1e-3, 0.2  # in s and in periods: uncertainty due to unmodelled friction lag; the longer applies
FEWEST, SCATTER = 100, 0.5  # rows needed for a delay; s, length of the blocks whose scatter gives its variance
EXACT = 1e-6  # power fraction attributed to rounding
VAGUE = 0.01  # s; standard deviation above which a delay is undetermined


@dataclass(frozen=True, eq=False)
class Clock:
    """Time of the rows of one log.

    `t`: (N,) time of each row [s]. `index`: (N,) period number of each row. `period`: [s]. `jitter`: standard deviation
    of the timestamps [s]. `drift`: largest slow deviation of the timestamps from uniform periods [s]. `retimed`:
    whether t differs from the timestamps.
    """

    t: np.ndarray
    index: np.ndarray
    period: float
    jitter: float
    drift: float
    retimed: bool

    @classmethod
    def of(cls, t: np.ndarray, q: np.ndarray | None = None, qd: np.ndarray | None = None) -> Clock:
        """Return the clock of rows with timestamps t (N,).

        If position and velocity (N, n) agree better with the timestamps than with a uniform clock, the timestamps are
        kept.
        """
        period = _period(np.diff(t))
        index = np.arange(len(t)) + np.cumsum(_lost(t, period))
        clock, period, drift = _even(t, index, period)
        away = t - clock
        jitter = float(np.sqrt(np.mean((away - np.median(away)) ** 2)))
        uneven = jitter > JITTER * period and not (q is not None and qd is not None and _agree(t, clock, q, qd))
        return cls(clock if uneven else t, index, period, jitter, drift, uneven)

    @property
    def pieces(self) -> list[int]:
        """First row of each segment without a gap of more than `BRIDGED` rows, followed by the total number of rows."""
        return _pieces(self.index)

    @property
    def lost(self) -> int:
        """Number of rows missing in interpolated gaps."""
        missing = np.diff(self.index) - 1
        return int(missing[missing <= BRIDGED].sum())

    def bridged(self, columns: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, list[int]]:
        """Return time, columns (N', n), the mask of measured rows (N',), and the segment edges."""
        pieces = self.pieces
        if not self.lost:
            return self.t, columns, np.ones(len(self.t), dtype=bool), pieces
        every = [np.arange(self.index[a], self.index[b - 1] + 1) for a, b in pairwise(pieces)]
        index = np.concatenate(every)
        wide = [np.stack([np.interp(index, self.index, x) for x in column.T], axis=1) for column in columns]
        edges = np.cumsum([0, *map(len, every)]).tolist()
        return np.interp(index, self.index, self.t), wide, np.isin(index, self.index), edges

    def text(self) -> str:
        """Return a sentence about jitter, drift and lost rows, or an empty string if there is nothing to report."""
        said = []
        if self.retimed:
            said.append(
                f"timestamps jitter by {1e3 * self.jitter:.2g} ms and drift by {1e3 * self.drift:.2g} ms: "
                f"the rows are retimed to a uniform period of {1e3 * self.period:.4g} ms"
            )
        if self.lost:
            share = 100 * self.lost / (self.lost + len(self.t))
            said.append(f"{self.lost} rows are lost ({share:.2g} %): they are interpolated, with weight 0")
        return "; ".join(said)


def _period(step: np.ndarray) -> float:
    """Return the period [s] of rows with steps (N - 1,); averaged over fifty rows if they jitter strongly."""
    period = float(np.median(step))
    if np.median(np.abs(step - period)) < 0.2 * period or len(step) < 2 * WINDOW:
        near = step[np.abs(step - period) < 0.5 * period]
        return float(np.mean(near))
    t = np.cumsum(step)
    return float(np.median(t[WINDOW:] - t[:-WINDOW])) / WINDOW


def _lost(t: np.ndarray, period: float) -> np.ndarray:
    """Return the number of missing rows before each row (N,), based on the least delayed rows before and after a gap.

    Comparing equal numbers of rows before and after the gap eliminates jitter; a longer window identifies single late
    rows.
    """
    N, last = len(t), 0
    lead, lost = t / period - np.arange(N), np.zeros(N, dtype=int)
    for k in np.flatnonzero(np.diff(t) > 1.5 * period) + 1:
        n = min(WINDOW, k - last, N - k)
        before = lead[k - n : k].min()
        near, ahead = lead[k : k + n].min() - before, lead[k : k + WINDOW].min() - before
        if near > 0.5 and ahead > CAUGHT_UP:
            lost[k], last = max(1, min(round(near), round(ahead + CAUGHT_UP))), k
    return lost


def _pieces(index: np.ndarray) -> list[int]:
    return [0, *(np.flatnonzero(np.diff(index) > BRIDGED + 1) + 1).tolist(), len(index)]


def _even(t: np.ndarray, index: np.ndarray, period: float) -> tuple[np.ndarray, float, float]:
    """Return the uniform clock (N,) of timestamps t (N,), its period, and the drift of the timestamps."""
    clock, drift, longest, found = np.empty(len(t)), 0.0, 0, period
    for a, b in pairwise(_pieces(index)):
        blocks = np.array_split(np.arange(a, b), min(b - a, max(1, round(float(t[b - 1] - t[a]) / BLOCK))))
        at = np.array([index[rows].mean() for rows in blocks])
        middle = np.array([np.median(t[rows] - period * (index[rows] - x)) for rows, x in zip(blocks, at)])
        slope = np.polyfit(at - at[0], middle - middle[0], 1)[0] if len(at) > 1 else period
        wander = middle - slope * at
        clock[a:b] = slope * index[a:b] + np.interp(index[a:b], at, wander)
        drift = max(drift, float(np.abs(wander - wander.mean()).max()))
        if b - a > longest:
            longest, found = b - a, slope
    return clock, float(found), drift


def _agree(t: np.ndarray, clock: np.ndarray, q: np.ndarray, qd: np.ndarray) -> bool:
    """Return whether the position steps match the timestamps t (N,) better than the uniform clock (N,)."""
    step, speed = np.diff(q, axis=0), 0.5 * (qd[1:] + qd[:-1])
    near = np.diff(clock) < 1.5 * np.median(np.diff(clock))
    left = [np.abs(step - speed * np.diff(x)[:, None])[near].mean(axis=0) for x in (t, clock)]
    return bool(np.sum(np.log(np.maximum(left[0], 1e-12))) < np.sum(np.log(np.maximum(left[1], 1e-12))))


@dataclass(frozen=True)
class Delay:
    """Delay of a column relative to the positions, and its standard deviation [s]."""

    seconds: float
    sd: float

    def matters(self, period: float) -> bool:
        """Return whether the delay is significant and exceeds half a period [s]."""
        return abs(self.seconds) > max(SURE * self.sd, LEAST * period)


def delay_of(y: np.ndarray, bases: list[np.ndarray], rows: np.ndarray, rate: float, used: np.ndarray) -> Delay | None:
    """Return the delay of the columns y (N, n) of a record, or None if undetermined.

    `bases`: for each joint, orthonormal columns (M, k) that explain y without delay. `rows`: (M,) rows of the record
    for which every shift stays within the segment. `used`: (n,) joints to use.
    """
    joints = np.flatnonzero(used)
    if not len(joints) or len(rows) < FEWEST:
        return None
    (first, last), step = shifts_of(rate), max(1, round(STEP * rate))
    coarse = np.arange(first, last + 1, step)
    score = np.log(_shares(y, bases, rows, joints, coarse)).sum(axis=0)
    if np.argmin(score) in (0, len(coarse) - 1):
        return None
    best = int(coarse[np.argmin(score)])
    near = np.arange(max(first, best - 2 * step), min(last, best + 2 * step) + 1)
    shares = _shares(y, bases, rows, joints, near)
    parts = np.polyfit((near - best) / rate, (shares.T / shares.min(axis=1)), 2)[:2]
    parts = parts * np.maximum(parts[0], 0.0) / _scatter(y, bases, rows, joints, best, rate)
    a, b = parts.sum(axis=1)
    if a <= 0.5 / VAGUE**2:
        return None
    push = parts[1] - b / a * parts[0]  # derivative for each joint, at the common delay
    scatter = len(joints) / max(len(joints) - 3, 1) * np.sum(push**2)  # variance of Student's t, for few joints
    sd = np.sqrt(max(DOUBT, SAMPLED / rate) ** 2 + max(2.0 * a, scatter) / (2.0 * a) ** 2)
    return Delay(float(best / rate - 0.5 * b / a), float(sd))


def shifts_of(rate: float) -> tuple[int, int]:
    """Return the first and the last shift of the search, in rows."""
    return int(np.floor(EARLIEST * rate)), int(np.ceil(LATEST * rate))


def _shares(
    y: np.ndarray, bases: list[np.ndarray], rows: np.ndarray, joints: np.ndarray, shifts: np.ndarray
) -> np.ndarray:
    """Return the residual power fraction (J, S) at each shift."""
    found = []
    for i in joints:
        at = y[rows[:, None] + shifts, i]
        whole = np.maximum(np.sum((at - at.mean(axis=0)) ** 2, axis=0), 1e-300)
        left = np.sum(at * at, axis=0) - np.sum((bases[i].T @ at) ** 2, axis=0)
        found.append(np.maximum(left / whole, EXACT))
    return np.array(found)


def _scatter(
    y: np.ndarray, bases: list[np.ndarray], rows: np.ndarray, joints: np.ndarray, best: int, rate: float
) -> np.ndarray:
    """Return half the variance (J,) of the derivative of log R with respect to delay, from the scatter of blocks."""
    step, block = max(1, round(STEP * rate)), np.unique(rows // max(1, round(SCATTER * rate)), return_inverse=True)[1]
    found = []
    for i in joints:
        at = y[rows[:, None] + best + np.array([-step, 0, step]), i]
        before, here, after = ((at - bases[i] @ (bases[i].T @ at)) ** 2).T
        slope = np.bincount(block, after - before) * rate / (2 * step)
        power = max(float(here.sum()), EXACT * float(np.sum((at[:, 1] - at[:, 1].mean()) ** 2)), 1e-300)
        found.append(0.5 * len(slope) * np.var(slope) / power**2)
    return np.maximum(found, 1e-12)


def earlier(x: np.ndarray, rows: float) -> np.ndarray:
    """Return columns (N, n) of one segment shifted forward by `rows`; the last row is repeated at the end."""
    at = np.arange(len(x))
    return np.stack([np.interp(at + rows, at, column) for column in x.T], axis=1)
