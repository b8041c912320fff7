"""Clocks of a log: stamps on the clock of its rows, lost rows bridged, and columns that are late.

Controllers sample evenly, networks and loggers stamp unevenly. The clock of the rows is a monotone fit of stamp over
row number: medians of the stamps in blocks of two seconds, straight lines between them. A row is lost where all later
stamps stay behind by a period; a row that is merely late is caught up with by the rows after it.

A column that is late by T is the motion of T before. The delay maximises the likelihood over shifts of the column,
``sum_i n_i / 2 log R_i(T)`` with R_i the power that the regression of joint i leaves and n_i its independent samples;
its variance is the inverse of the second derivative there, or what the joints' own delays scatter by.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from armlab.estimation.robust import effective_samples

BRIDGED = 4  # lost rows between two that are interpolated; more of them end a segment
WINDOW = 50  # rows in which a late row is caught up with
CAUGHT_UP = 0.25  # periods: jitter of the earliest of so many rows
BLOCK = 2.0  # s, of the medians
JITTER = 0.01  # of the period: less is rounding of the stamps
EARLIEST, LATEST = -0.06, 0.32  # s, of the delays that are searched
STEP = 0.004  # s, between the shifts of the first search
LEAST, SURE = 0.5, 4.0  # periods and deviations: a smaller delay stays as it is
DOUBT = 1e-3  # s: friction lags in ways that no regression has
FEWEST = 100  # rows that tell a delay
EXACT = 1e-6  # share of power that is rounding
VAGUE = 0.01  # s: a larger deviation is no knowledge


@dataclass(frozen=True, eq=False)
class Clock:
    """The rows of one log in time.

    `t`: (N,) time of each row [s]. `index`: (N,) number of its period. `period`: [s]. `jitter`: deviation of the stamps
    from it [s]. `drift`: largest slow deviation of the stamps from even periods [s]. `retimed`: whether t differs from
    the stamps.
    """

    t: np.ndarray
    index: np.ndarray
    period: float
    jitter: float
    drift: float
    retimed: bool

    @classmethod
    def of(cls, t: np.ndarray, q: np.ndarray | None = None, qd: np.ndarray | None = None) -> Clock:
        """Return the clock of rows with stamps t (N,).

        Where position and velocity (N, n) agree better with the stamps, rows were sampled when they were stamped.
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
        """First row of each piece without a gap of more than `BRIDGED` rows, and the number of rows."""
        return _pieces(self.index)

    @property
    def lost(self) -> int:
        """Number of rows that are missing in gaps that are bridged."""
        missing = np.diff(self.index) - 1
        return int(missing[missing <= BRIDGED].sum())

    def bridged(self, columns: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, list[int]]:
        """Return time, columns (N', n), which rows were measured (N',), and the edges of the pieces among them."""
        pieces = self.pieces
        if not self.lost:
            return self.t, columns, np.ones(len(self.t), dtype=bool), pieces
        every = [np.arange(self.index[a], self.index[b - 1] + 1) for a, b in pairwise(pieces)]
        index = np.concatenate(every)
        wide = [np.stack([np.interp(index, self.index, x) for x in column.T], axis=1) for column in columns]
        edges = np.cumsum([0, *map(len, every)]).tolist()
        return np.interp(index, self.index, self.t), wide, np.isin(index, self.index), edges

    def text(self) -> str:
        """Return jitter, drift and lost rows in words; nothing where there are none."""
        said = []
        if self.retimed:
            said.append(
                f"stamps jitter by {1e3 * self.jitter:.2g} ms and drift by {1e3 * self.drift:.2g} ms: rows are put on "
                f"an even clock of {1e3 * self.period:.4g} ms"
            )
        if self.lost:
            share = 100 * self.lost / (self.lost + len(self.t))
            said.append(f"{self.lost} rows are lost ({share:.2g} %): bridged, not counted")
        return "; ".join(said)


def _period(step: np.ndarray) -> float:
    """Return the period [s] of rows with steps (N - 1,); where they jitter by more than a fifth, of fifty rows."""
    period = float(np.median(step))
    if np.median(np.abs(step - period)) < 0.2 * period or len(step) < 2 * WINDOW:
        near = step[np.abs(step - period) < 0.5 * period]
        return float(np.mean(near))
    t = np.cumsum(step)
    return float(np.median(t[WINDOW:] - t[:-WINDOW])) / WINDOW


def _lost(t: np.ndarray, period: float) -> np.ndarray:
    """Return how many rows are missing before each row (N,): the earliest rows around a gap tell.

    As many rows after it as before count jitter out; more of them tell a row that is late alone.
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
    """Return the even clock (N,) of stamps t (N,), its period, and the drift of the stamps."""
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
    """Return whether steps of position follow the stamps t (N,) better than the even clock (N,)."""
    step, speed = np.diff(q, axis=0), 0.5 * (qd[1:] + qd[:-1])
    near = np.diff(clock) < 1.5 * np.median(np.diff(clock))
    left = [np.abs(step - speed * np.diff(x)[:, None])[near].mean(axis=0) for x in (t, clock)]
    return bool(np.sum(np.log(np.maximum(left[0], 1e-12))) < np.sum(np.log(np.maximum(left[1], 1e-12))))


@dataclass(frozen=True)
class Delay:
    """How late a column is against the positions, and its deviation [s]."""

    seconds: float
    sd: float

    def matters(self, period: float) -> bool:
        """Return whether it is known, and more than half a period [s]."""
        return abs(self.seconds) > max(SURE * self.sd, LEAST * period)


def delay_of(y: np.ndarray, bases: list[np.ndarray], rows: np.ndarray, rate: float, used: np.ndarray) -> Delay | None:
    """Return how late the columns y (N, n) of a record are; None where nothing tells.

    `bases`: of each joint, orthonormal columns (M, k) that explain y when it is on time. `rows`: (M,) of the record, so
    far inside its segments that shifts stay there. `used`: (n,) joints that count.
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
    shares, weights = _shares(y, bases, rows, joints, near), []
    for i in joints:
        left = y[rows + best, i]
        weights.append(0.5 * effective_samples(left - bases[i] @ (bases[i].T @ left)))
    parts = np.polyfit((near - best) / rate, (weights / shares.min(axis=1) * shares.T), 2)[:2]
    a, b = parts.sum(axis=1)
    if a <= 0.5 / VAGUE**2:
        return None
    push = parts[1] - b / a * parts[0]  # of each joint, at the common delay
    scatter = len(joints) / max(len(joints) - 1, 1) * np.sum(push**2)
    sd = np.sqrt(DOUBT**2 + max(2.0 * a, scatter) / (2.0 * a) ** 2)
    return Delay(float(best / rate - 0.5 * b / a), float(sd))


def shifts_of(rate: float) -> tuple[int, int]:
    """Return the first and the last shift in rows that is searched."""
    return int(np.floor(EARLIEST * rate)), int(np.ceil(LATEST * rate))


def _shares(
    y: np.ndarray, bases: list[np.ndarray], rows: np.ndarray, joints: np.ndarray, shifts: np.ndarray
) -> np.ndarray:
    """Return the share of power (J, S) that is left at each shift."""
    found = []
    for i in joints:
        at = y[rows[:, None] + shifts, i]
        whole = np.maximum(np.sum((at - at.mean(axis=0)) ** 2, axis=0), 1e-300)
        left = np.sum(at * at, axis=0) - np.sum((bases[i].T @ at) ** 2, axis=0)
        found.append(np.maximum(left / whole, EXACT))
    return np.array(found)


def earlier(x: np.ndarray, rows: float) -> np.ndarray:
    """Return columns (N, n) of one segment as they are `rows` later; beyond the end the last row stays."""
    at = np.arange(len(x))
    return np.stack([np.interp(at + rows, at, column) for column in x.T], axis=1)
