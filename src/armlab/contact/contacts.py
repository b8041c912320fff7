"""Contact detection and localisation in a log with wrench estimates, and comparison with a reference wrench.

Hypotheses about the contact location:

    none     no contact
    point    a force at a known point of the tool: 3 unknowns
    segment  a force at an unknown point along a line on the tool: 3 + 1
    wrench   force and moment at the tool: 6
    link k   a force somewhere on link k: the torques of distal joints are zero

The score of each hypothesis over a window is the log evidence ``sum log N(tau_e; 0, J_h^T C_h J_h + C_tau)``, scaled to
the effective sample size. Theory: docs/theory/contact_force.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only, number, numbers
from armlab.contact.estimator import check_distance, contact_point
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.log import Table
from armlab.models.uncertainty import PRIOR
from armlab.robots import Robot

DECISIVE = 3.0  # log Bayes factor
EXCLUDED = 6.0  # log Bayes factor for excluding a link (400 to 1); strict, because a person may be touching the link
GRID = 50  # points along a segment
ROWS_PER_MEMORY = 2  # rows used per correlation time
SLOW = 0.02  # rad/s; if all joints are slower, friction errors are constant and the window counts as one sample
CHUNK = 64  # windows per batch
UNDECIDED = "undecided"


@dataclass(frozen=True, eq=False, repr=False)
class Hypotheses(Shown):
    """Posterior probabilities of contact hypotheses per window.

    Attributes
    ----------
    t : array, shape (K,), s
        Centre of each window.
    names : tuple of str, length H
        Names of the hypotheses.
    log_evidence : array, shape (K, H)
        Log evidence of each hypothesis.
    posterior : array, shape (K, H)
        Posterior probabilities for equal prior odds; rows sum to 1.
    decision : tuple of str, length K
        Most likely hypothesis; "undecided" if it is less than 20 times as likely as the second.
    link : bool array, shape (K,)
        True if there is contact and at least one hypothesis "link k" is not excluded at odds of 400 to 1. A force
        reported at the tool may then act on a link.
    place : array, shape (K,), m
        Distance along the segment from its start to the most likely contact point; NaN without a segment.
    samples : array, shape (K,)
        Effective sample size of each window.
    """

    t: np.ndarray
    names: tuple[str, ...]
    log_evidence: np.ndarray
    posterior: np.ndarray
    decision: tuple[str, ...]
    link: np.ndarray
    place: np.ndarray
    samples: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, "t", "log_evidence", "posterior", "link", "place", "samples")

    def during(self, start: float, end: float) -> str:
        """Describe the decision for a contact from `start` to `end` [s].

        Uses the windows centred inside the contact or, if there are none, the nearest window.
        """
        inside = (self.t >= start) & (self.t <= end)
        if not inside.any():
            inside[np.argmin(np.abs(self.t - 0.5 * (start + end)))] = True
        evidence = self.log_evidence[inside].mean(axis=0)
        best = np.argsort(-evidence)
        odds = np.exp(evidence - evidence[best[0]])
        shares = odds / odds.sum()
        said = [f"{self.names[i]} {100 * shares[i]:.0f} %" for i in best[:3] if shares[i] >= 0.005]
        sure = evidence[best[0]] - evidence[best[1]] > DECISIVE
        name = self.names[best[0]] if sure else UNDECIDED
        place = f", {1e3 * np.median(self.place[inside]):.0f} mm along" if name == "segment" else ""
        doubt = (
            "; possibly on a link" if self.link[inside].any() and not name.startswith("link") and name != "none" else ""
        )
        first, *others = said if sure else (f"{UNDECIDED}: {', '.join(said)}",)
        beside = f" ({', '.join(others)})" if others else ""
        return f"{first}{place}{beside}{doubt}"

    def text(self) -> str:
        """Return one line per time interval with a constant decision; intervals without contact are omitted."""
        lines, at = [], 0
        for decision, group in groupby(self.decision):
            start, at = at, at + len(list(group))
            if decision != "none":
                span = float(self.t[start]), float(self.t[at - 1])
                lines.append(f"{span[0]:7.2f} to {span[1]:7.2f} s  {self.during(*span)}")
        return "\n".join(lines or ["no contact in any window"])


def hypotheses(
    table: Table,
    robot: Robot,
    *,
    point: ArrayLike | None = None,
    segment: ArrayLike | None = None,
    prior: ArrayLike | None = None,
    window: float = 1.0,
    memory: float = 0.1,
) -> Hypotheses:
    """Compare hypotheses about the contact location in windows that overlap by half.

    Parameters
    ----------
    table : log with q, qd, tau_error and tau_variance (N, n), from `Estimator.run` with a static method.
    robot : the arm.
    point : (3,) contact point of the hypothesis "point", tool axes [m]; default: the tool point, unless a segment is
        given.
    segment : (M, 3) vertices of a polyline on the tool, tool axes [m]; default: no segment hypothesis.
    prior : (6,) standard deviations of the wrench [N, N m], at the tool and on links; default: 20 N and 2 N m.
    window : window length [s]; contacts shorter than a window are averaged with free motion.
    memory : correlation time of the torque error [s], see `correlation_time`. A window counts as window / (2 memory)
        independent samples. For an identified YuMi model and the 10 Hz filter, the correlation time in motion is 0.02
        to 0.06 s. The default of 0.1 s is conservative; above 0.2 s, windows of free motion remain undecided.

    Raises
    ------
    UnknownName : the table has no estimate.
    ShapeError : the joint count, point, segment, prior or a time is invalid; a point is farther from the tool than the
        length of the arm; the table is shorter than a window; or every window has missing rows.

    References
    ----------
    Kass and Raftery (1995), Bayes factors (scale of evidence).
    """
    q, qd, error, variance = _columns(table, robot)
    at, line, sd = _places(point, segment, prior, robot)
    window, memory = number(window, "the window [s]"), number(memory, "the memory [s]")
    if not 0 < memory < np.inf or not 0 < window < np.inf:
        raise ShapeError(f"Expected a window and a memory above 0 s, got {window} s and {memory} s.")
    rows = _windows(table, error, window, memory)
    links = [f"link {k + 1}" for k in range(robot.n - 1)]
    names = ("none", *["point"] * len(at), *["segment"] * bool(len(line)), "wrench", *links)
    samples = np.maximum(1.0, np.where(np.abs(qd[rows]).max(axis=(1, 2)) < SLOW, 1.0, window / (2.0 * memory)))
    evidence, place = np.empty((len(rows), len(names))), np.full(len(rows), np.nan)
    for a in range(0, len(rows), CHUNK):
        part = slice(a, a + CHUNK)
        score = _scores(robot, q[rows[part]], error[rows[part]], variance[rows[part]], np.vstack([at, line]), sd)
        score = score.sum(axis=1) * (samples[part] / rows.shape[1])[:, None]
        simple, along, rest = np.split(score, np.cumsum([1 + len(at), len(line)]), axis=1)
        if len(line):
            place[part] = _peak(along) * _length(segment) / (GRID - 1)
            top = along.max(axis=1, keepdims=True)
            along = top + np.log(np.mean(np.exp(along - top), axis=1, keepdims=True))
        evidence[part] = np.hstack([simple, along, rest])
    return _decided(table.t[rows].mean(axis=1), names, evidence, place, samples)


def _columns(table: Table, robot: Robot) -> list[np.ndarray]:
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    columns = [table[name] for name in ("q", "qd", "tau_error", "tau_variance")]
    if any(values.shape != (len(table), robot.n) for values in columns):
        raise ShapeError(
            f"Expected columns of shape ({len(table)}, {robot.n}) for {robot.name!r}, got {columns[0].shape}. "
            "Pass the robot that was logged."
        )
    return columns


def _places(
    point: ArrayLike | None, segment: ArrayLike | None, prior: ArrayLike | None, robot: Robot
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the point (1 or 0, 3), the points on the segment (GRID or 0, 3), and the standard deviations (6,)."""
    at = np.zeros(3) if point is None else contact_point(point, robot)
    sd = numbers(PRIOR if prior is None else prior, "the prior", ShapeError)
    corners = np.zeros((0, 3)) if segment is None else numbers(segment, "the segment", ShapeError)
    if sd.shape != (6,) or not np.isfinite(sd).all() or not np.all(sd > 0):
        raise ShapeError(f"Expected six positive standard deviations [N, N m] as prior, got {prior!r}.")
    if segment is None:
        return at[None], corners, sd
    if corners.ndim != 2 or corners.shape[1] != 3 or not np.isfinite(corners).all() or not _length(corners) > 0:
        raise ShapeError(f"Expected a polyline of at least two distinct points (M, 3) [m], got shape {corners.shape}.")
    check_distance(corners, robot)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    grid = np.linspace(0.0, way[-1], GRID)
    known = at[None] if point is not None else np.zeros((0, 3))
    return known, np.stack([np.interp(grid, way, c) for c in corners.T], axis=1), sd


def _length(corners: ArrayLike | None) -> float:
    return float(np.linalg.norm(np.diff(np.asarray(corners, dtype=float), axis=0), axis=1).sum())


def _windows(table: Table, error: np.ndarray, window: float, memory: float) -> np.ndarray:
    """Return the rows (K, m) used by each window, evenly spaced; windows with missing rows are skipped."""
    step = float(np.median(np.diff(table.t))) if len(table) > 1 else np.inf
    width = round(window / step)
    if not 1 <= width <= len(table):
        raise ShapeError(f"Expected a table of at least one window of {window} s, got {len(table)} rows.")
    count = max(1, min(width, round(ROWS_PER_MEMORY * window / memory)))
    inside = ((np.arange(count) + 0.5) * width / count).astype(int)
    rows = np.arange(0, len(table) - width + 1, max(1, width // 2))[:, None] + inside
    whole = np.isfinite(error[rows]).all(axis=(1, 2)) & (np.ptp(table.t[rows], axis=1) <= 1.1 * window)
    if not whole.any():
        raise ShapeError(f"Expected windows of {window} s without missing rows, got none. Pass a complete log.")
    return rows[whole]


def _scores(
    robot: Robot, q: np.ndarray, error: np.ndarray, variance: np.ndarray, places: np.ndarray, sd: np.ndarray
) -> np.ndarray:
    """Return the row log likelihoods (K, m, 1 + points + 1 + links): no contact, each point, wrench, links."""
    T_base_tool, J = robot.chain.forward_jacobian(q)
    linear, angular = np.swapaxes(J[..., :3, :], -1, -2), np.swapaxes(J[..., 3:, :], -1, -2)  # (..., n, 3)
    arms = np.einsum("...ab,pb->...pa", T_base_tool[..., :3, :3], places)
    at = linear[..., None, :, :] + np.cross(angular[..., None, :, :], arms[..., :, None, :])
    spread = [np.zeros((*q.shape[:-1], 1, robot.n, robot.n)), sd[0] * sd[0] * at @ np.swapaxes(at, -1, -2)]
    whole = np.concatenate([linear * sd[:3], angular * sd[3:]], axis=-1)
    spread.append((whole @ np.swapaxes(whole, -1, -2))[..., None, :, :])
    T_base_link = robot.chain.link_transforms(q)
    origins = np.concatenate([T_base_link[..., :3, 3], T_base_tool[..., None, :3, 3]], axis=-2)
    for k in range(robot.n - 1):
        middle = 0.5 * (origins[..., k, :] + origins[..., k + 1, :])
        moved = linear + np.cross(angular, (middle - T_base_tool[..., :3, 3])[..., None, :])
        held = np.concatenate([moved * sd[:3], angular * sd[3:]], axis=-1) * (np.arange(robot.n) <= k)[:, None]
        spread.append((held @ np.swapaxes(held, -1, -2))[..., None, :, :])
    S = np.concatenate(spread, axis=-3) + (variance[..., None, :, None] * np.eye(robot.n))
    root = np.linalg.cholesky(S)
    white = np.linalg.solve(root, np.broadcast_to(error[..., None, :, None], (*S.shape[:-1], 1)))[..., 0]
    return -0.5 * np.sum(white**2, axis=-1) - np.sum(np.log(np.einsum("...ii->...i", root)), axis=-1)


def _peak(score: np.ndarray) -> np.ndarray:
    """Return the grid position (K,) of the largest score (K, GRID), refined by a parabola through three points."""
    k = np.clip(np.argmax(score, axis=1), 1, score.shape[1] - 2)
    left, middle, right = (np.take_along_axis(score, (k + i)[:, None], 1)[:, 0] for i in (-1, 0, 1))
    bend = left - 2.0 * middle + right
    shift = np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend < 0)
    return k + np.clip(shift, -1.0, 1.0)


def _decided(
    t: np.ndarray, names: tuple[str, ...], evidence: np.ndarray, place: np.ndarray, samples: np.ndarray
) -> Hypotheses:
    order = np.sort(evidence, axis=1)
    best = np.argmax(evidence, axis=1)
    clear = order[:, -1] - order[:, -2] > DECISIVE
    decision = tuple(names[i] if sure else UNDECIDED for i, sure in zip(best, clear))
    odds = np.exp(evidence - order[:, -1:])
    links = [i for i, name in enumerate(names) if name.startswith("link")]
    possible = order[:, -1] - evidence[:, links].max(axis=1, initial=-np.inf) <= EXCLUDED
    contact = np.array([name != "none" for name in decision])
    posterior = odds / odds.sum(axis=1, keepdims=True)
    return Hypotheses(t, names, evidence, posterior, decision, possible & contact, place, samples)


CHI2_95 = 7.81  # 95 % quantile of the chi-squared distribution with three degrees of freedom
FALSE_ALARMS = 600.0  # s of free motion per false alarm, for Gaussian errors and independent rows
INDEPENDENT = 0.1  # s; force errors at least this far apart are treated as independent
SHORTEST = 0.05  # s; minimum duration of a contact; friction errors at a reversal are shorter
HOLE = 0.1  # s; shorter gaps do not end a contact


@dataclass(frozen=True, repr=False)
class Contact(Shown):
    """Contact interval.

    Attributes
    ----------
    start : float, s
        Start of the contact on the table's clock.
    end : float, s
        End of the contact on the same clock.
    force : tuple of 3 floats, N
        Mean force (fx, fy, fz) in base axes.
    band : float, N
        Mean 2-sigma band of the least certain axis.
    """

    start: float
    end: float
    force: tuple[float, float, float]
    band: float


def contacts(table: Table) -> list[Contact]:
    """Detect contacts: intervals that free motion would produce less than once in ten minutes.

    Within an interval, ``d = f^T Sigma^-1 f`` exceeds 7.81, its 95 % quantile without contact; gaps below 0.1 s are
    bridged. The sum of d over the independent samples of the interval is tested against the chi-squared distribution.
    Intervals in which d never stays above 7.81 for 0.05 s are ignored.

    Parameters
    ----------
    table : log with wrench_hat and wrench_hat_cov, from `Estimator.run`.

    Raises
    ------
    ShapeError : `table` is not a table.
    UnknownName : the table has no estimate.
    """
    from scipy.special import chdtrc

    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    force, cov, t = table["wrench_hat"][:, :3], table["wrench_hat_cov"][:, :3, :3], table.t
    known = np.isfinite(force).all(axis=1)
    distance = np.zeros(len(table))
    distance[known] = np.einsum("ki,ki->k", force[known], np.linalg.solve(cov[known], force[known][..., None])[..., 0])
    edges = np.flatnonzero(np.diff((distance > CHI2_95).astype(int), prepend=0, append=0)).reshape(-1, 2)
    if not len(edges):
        return []
    starts, ends = t[edges[:, 0]], t[edges[:, 1] - 1]
    begins = np.flatnonzero(np.append(True, starts[1:] - ends[:-1] >= HOLE))
    longest = np.maximum.reduceat(ends - starts, begins)
    step = float(np.median(np.diff(t))) if len(t) > 1 else SHORTEST
    found = []
    for a, b, long in zip(edges[begins, 0], edges[np.append(begins[1:], len(edges)) - 1, 1], longest):
        samples = max(1.0, (t[b - 1] - t[a]) / INDEPENDENT)
        chance = chdtrc(3.0 * samples, samples * np.mean(distance[a:b]))
        if long >= SHORTEST and chance < step / FALSE_ALARMS:
            found.append(_contact(table, float(t[a]), float(t[b - 1])))
    return found


def _contact(table: Table, start: float, end: float) -> Contact:
    rows = (table.t >= start) & (table.t <= end)
    x, y, z = np.nanmean(table["wrench_hat"][rows, :3], axis=0)
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"][rows])[:, :3])
    return Contact(float(start), float(end), (float(x), float(y), float(z)), float(2 * np.nanmean(sigma, axis=0).max()))


SOURCES = {"wrench_true": "the true wrench", "wrench": "the force sensor"}


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Shown):
    """Error of an estimated wrench relative to a reference.

    Attributes
    ----------
    against : str
        Reference: "the true wrench" or "the force sensor".
    rows : int
        Number of rows with both estimate and reference.
    rms : array, shape (6,), N and N m
        RMS error per axis.
    inside : array, shape (6,)
        Fraction of errors within 2 sigma.
    """

    against: str
    rows: int
    rms: np.ndarray
    inside: np.ndarray

    def text(self) -> str:
        """Return the force errors as one line."""
        rms = " ".join(f"{value:.2f}" for value in self.rms[:3])
        share = 100 * float(np.mean(self.inside[:3]))
        return f"force x y z against {self.against}: {rms} N RMS, {share:.0f} % within 2 sigma"


def compare(table: Table) -> Comparison:
    """Compare the estimated wrench with the true wrench if the table contains it, otherwise with the force sensor.

    Errors are ``wrench_hat - wrench_true`` or ``wrench_hat - wrench``; with a correct covariance, 95.4 % of them are
    within two sigma.

    Parameters
    ----------
    table : log with wrench_hat (N, 6), wrench_hat_cov (N, 6, 6), wrench_true or wrench (N, 6); base axes, tool point.

    Raises
    ------
    UnknownName : a column is missing, or no row has both estimate and reference.
    ShapeError : `table` is not a table.
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
        raise UnknownName(f"Expected rows with an estimate and with {source}, got none among {len(table)} rows.")
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
    rms = np.sqrt(np.mean(error[known] ** 2, axis=0))
    inside = np.mean(np.abs(error[known]) <= 2 * sigma[known], axis=0)
    for array in (rms, inside):
        array.flags.writeable = False
    return Comparison(SOURCES[source], int(known.sum()), rms, inside)
