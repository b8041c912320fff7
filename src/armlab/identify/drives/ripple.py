"""Search and fit of torque ripple lines in the residuals of one joint (law: models.friction.RippleLines).

Candidates are the peaks of a least-squares periodogram over position. A group lasso selects among the peaks of the
periodogram. Finally, a line is kept only if removing it increases the held-out error by more than 2 %. A line c causes
ripple at the frequency c |qd| / (2 pi); only samples in which this frequency is below a quarter of the sampling rate
are used. Theory: docs/theory/friction.md.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.estimation.robust import mad
from armlab.identify.drives.regularised import RIDGE, held_out_error, ridge_solution, select_groups
from armlab.identify.record import SLOW_SHARE, slow_enough
from armlab.kernels import basis_weights

P_VALUE = 1e-3
NEIGHBOURS = 50  # grid points on either side for the local median
MAX_LINES = 10
NEWTON = 3  # Gauss-Newton steps to refine a line
GAIN = 0.02  # minimum reduction of the held-out variance
CHUNK = 2**22  # numbers held in memory at once


@dataclass(frozen=True, eq=False)
class _LineSearch:
    """Rows of one joint; `slow` marks the rows in which a line does not alias."""

    q: np.ndarray
    qd: np.ndarray
    y: np.ndarray
    rate: float

    def slow(self, c: np.ndarray | float) -> np.ndarray:
        return slow_enough(self.qd, self.rate, np.asarray(c))


def ripple_lines(
    q: np.ndarray, qd: np.ndarray, y: np.ndarray, rate: float, highest: float, lowest: float = 1.0
) -> np.ndarray:
    """Return the ripple lines (L,) [cycles per revolution] in the residual of one joint, in ascending order.

    Warn about lines that alias in more than half of the samples.

    Parameters
    ----------
    q, qd, y : (N,) position [rad], velocity [rad/s], residual torque [N m].
    rate : sampling rate [Hz].
    highest : largest c of the search, 2.5 times the gear ratio.
    lowest : smallest c of the search.

    Raises
    ------
    ShapeError : inconsistent shapes, NaN, or a non-positive rate.
    """
    q, qd, y = (numbers(x, "q, qd and y", ShapeError) for x in (q, qd, y))
    if q.ndim != 1 or q.shape != qd.shape or q.shape != y.shape or not np.isfinite([q, qd, y]).all():
        raise ShapeError(f"Expected finite q, qd and y of equal shape (N,), got {q.shape}, {qd.shape} and {y.shape}.")
    if not 0 < rate < np.inf or not np.isfinite([highest, lowest]).all():
        raise ShapeError(
            f"Expected a rate above 0 Hz and finite search limits, got {rate:g} Hz and {lowest:g} to {highest:g} "
            "cycles. Pass the sampling rate and, as the upper search limit, 2.5 times the gear ratio."
        )
    turns = np.ptp(q) / (2 * np.pi) if len(q) else 0.0
    if not highest > lowest or turns * (highest - lowest) < 4.0:
        return np.zeros(0)
    seen = highest_seen(qd, rate)
    if seen < highest:
        warn_of_fast_lines({"this joint": seen}, rate)
    search = _LineSearch(q, qd, y - np.mean(y), rate)
    grid = _grid(search, turns, highest, lowest)
    found: list[float] = []
    while len(found) < MAX_LINES and len(grid):
        rest = _LineSearch(q, qd, _left(search, found), rate)
        k = _peak(rest, grid)
        if k is None:
            break
        line = _refined(rest, grid[k], 0.25 / turns)
        if any(abs(line - c) < 0.5 / turns for c in found):
            grid = np.delete(grid, k)
            continue
        found.append(line)
    return np.sort(found)


def strongest_line(
    q: np.ndarray, qd: np.ndarray, y: np.ndarray, rate: float, lowest: float, highest: float
) -> tuple[float, float]:
    """Return the line that explains most of the residual, and its share of the residual power (0, 0 if none)."""
    turns, search = np.ptp(q) / (2 * np.pi), _LineSearch(q, qd, y - np.mean(y), rate)
    if turns * (highest - lowest) < 4.0:
        return 0.0, 0.0
    grid = _grid(search, turns, highest, lowest)
    if not len(grid):
        return 0.0, 0.0
    line = _refined(search, float(grid[np.argmax(_periodogram(search, grid))]), 0.25 / turns)
    slow = search.slow(line)
    left = _left(_LineSearch(q[slow], qd[slow], search.y[slow], rate), [line])
    return line, 1.0 - float(np.var(left) / np.var(search.y[slow]))


def _grid(search: _LineSearch, turns: float, highest: float, lowest: float) -> np.ndarray:
    grid = np.arange(lowest, highest, 0.25 / turns)
    return grid[[np.mean(search.slow(c)) >= 0.5 for c in grid]]


def _peak(search: _LineSearch, grid: np.ndarray) -> int | None:
    """Return the grid index of the most prominent line, or None if it may be noise."""
    power = _periodogram(search, grid)
    floor = np.array([np.median(power[max(k - NEIGHBOURS, 0) : k + NEIGHBOURS + 1]) for k in range(len(grid))])
    ratio = power / np.maximum(floor, 1e-300)
    k = int(np.argmax(ratio))
    # noise power is exponentially distributed, with a probability of one half above its median
    return None if len(grid) * 2.0 ** -ratio[k] > P_VALUE else k


def highest_seen(qd: np.ndarray, rate: float) -> float:
    """Return the highest ripple line [cycles per revolution] whose frequency is below a quarter of the sampling rate in
    half of the samples."""
    return float(2 * np.pi * SLOW_SHARE * rate / max(np.median(np.abs(qd)), 1e-12))


def warn_of_fast_lines(seen: dict[str, float], rate: float) -> None:
    """Warn that ripple lines alias and are not searched for."""
    listed = ", ".join(f"{name} (above {c:.0f} cycles/rev)" for name, c in seen.items())
    warnings.warn(
        f"Expected torque ripple below {SLOW_SHARE * rate:.3g} Hz, a quarter of the sampling rate, in at least "
        f"half of the samples, got faster ripple for {listed}: it aliases and is not searched for. Log slower motion, "
        "such as identify.friction_run, or sample faster.",
        stacklevel=3,
    )


def _left(search: _LineSearch, lines: list[float]) -> np.ndarray:
    """Return the residual after subtracting lines with constant amplitude and phase per direction."""
    if not lines:
        return search.y
    angle = np.outer(search.q, lines)
    waves, forward = np.hstack([np.cos(angle), np.sin(angle)]), search.qd[:, None] > 0
    A = np.hstack([waves * forward, waves * ~forward])
    return search.y - A @ np.linalg.lstsq(A, search.y, rcond=None)[0]


def _periodogram(search: _LineSearch, grid: np.ndarray) -> np.ndarray:
    """Return the explained sum of squares per sample (len(grid),) of each line."""
    power = np.empty(len(grid))
    step = max(1, CHUNK // len(search.q))
    for a in range(0, len(grid), step):
        part = grid[a : a + step]
        angle = np.outer(part, search.q)
        slow = search.slow(part[:, None])
        C, S = np.cos(angle) * slow, np.sin(angle) * slow
        cc, cs, ss = np.sum(C * C, 1), np.sum(C * S, 1), np.sum(S * S, 1)
        cy, sy = C @ search.y, S @ search.y
        det = np.maximum(cc * ss - cs**2, 1e-12 * len(search.q) ** 2)
        power[a : a + step] = (ss * cy**2 - 2 * cs * cy * sy + cc * sy**2) / det
    return power


def _refined(search: _LineSearch, c: float, width: float) -> float:
    """Return the line near c with the smallest residual; phases of the two directions may differ."""
    from scipy.optimize import minimize_scalar

    slow = search.slow(c)
    rows = _LineSearch(search.q[slow], search.qd[slow], search.y[slow], search.rate)
    best = minimize_scalar(
        lambda x: np.sum(_left(rows, [x]) ** 2),
        bounds=(max(c - width, 1.0), c + width),
        method="bounded",
        options={"xatol": 0.05 * width},
    )
    return float(best.x)


def ripple_regressor(
    q: np.ndarray, qd: np.ndarray, z: np.ndarray, cycles: np.ndarray, speeds: np.ndarray, widths: np.ndarray
) -> np.ndarray:
    """Return the columns (N, L 2 S 2) of lines with separate amplitudes per direction."""
    return _waves(q, ripple_amplitudes(qd, z, speeds, widths), cycles)[0]


def ripple_amplitudes(qd: np.ndarray, z: np.ndarray, speeds: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Return the weights (N, 2 S) of the Gaussians in speed, for both directions."""
    along = basis_weights(np.abs(qd), speeds, widths)
    sides = np.stack([0.5 * (1 + z), 0.5 * (1 - z)], axis=1)
    return (sides[:, :, None] * along[:, None, :]).reshape(len(along), -1)


def refine_lines(
    q: np.ndarray, amplitudes: np.ndarray, y: np.ndarray, cycles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return refined lines (L,), their columns (N, p), and derivatives (N, L) of their sum with respect to each line.

    The search uses one amplitude per direction; the refinement uses all amplitudes. An error in a line's frequency
    changes the phase at the ends of the range; without the derivatives, the coefficient covariance would be too small.
    """
    for _ in range(NEWTON):
        A, slopes, left = _bent(q, amplitudes, y, cycles)
        both = np.hstack([A, slopes])
        norms = np.linalg.norm(both, axis=0)
        cycles = cycles + (ridge_solution(both / norms, left, RIDGE)[0] / norms)[-len(cycles) :]
    return cycles, *_bent(q, amplitudes, y, cycles)[:2]


def _bent(
    q: np.ndarray, amplitudes: np.ndarray, y: np.ndarray, cycles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the columns of the ripple lines, the derivatives (N, L) of their best-fitting sum with respect to each
    line, and the residual."""
    A, slopes = _waves(q, amplitudes, cycles)
    x = ridge_solution(A, y, RIDGE)[0]
    shape = len(cycles), -1
    return A, np.einsum("nlk,lk->nl", slopes.reshape(len(q), *shape), x.reshape(shape)), y - A @ x


def _waves(q: np.ndarray, amplitudes: np.ndarray, cycles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns (N, L 2 S 2) of lines and their derivatives with respect to the lines."""
    angle = np.outer(q, cycles)
    wave = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    turned = q[:, None, None] * np.stack([-np.sin(angle), np.cos(angle)], axis=2)
    columns, slopes = (np.einsum("nk,nlw->nlkw", amplitudes, part).reshape(len(q), -1) for part in (wave, turned))
    return columns, slopes


def select_lines(A: np.ndarray, y: np.ndarray, size: int, block: np.ndarray) -> np.ndarray:
    """Return the column groups (G,) selected by the group lasso, each of which reduces the held-out error by 2 %."""
    scale = mad(y) or 1.0
    kept = select_groups(A / np.sqrt(np.mean(A**2)), y / scale, size, block)
    while kept.any():
        with_all = held_out_error(A[:, np.repeat(kept, size)], y, block)
        worth = np.full(len(kept), np.inf)
        for g in np.flatnonzero(kept):
            without = kept.copy()
            without[g] = False
            error = held_out_error(A[:, np.repeat(without, size)], y, block)
            worth[g] = 1.0 - with_all / error if error > 0 else 0.0
        weakest = int(np.argmin(worth))
        if worth[weakest] > GAIN:
            break
        kept[weakest] = False
    return kept
