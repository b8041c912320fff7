"""From logs to arrays that can be fitted: checks first, then segments without gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from armlab.errors import NotExcited, ShapeError
from armlab.log import Table
from armlab.robots import Robot
from armlab.signals import lowpass_offline

__all__ = ["Prepared", "prepare"]

MIN_SECONDS = 5.0
MIN_TURN, MIN_SLIDE = np.deg2rad(5.0), 0.02  # rad, m: range of a joint that is said to move
MIN_SEGMENT = 100  # samples; shorter pieces between gaps are left out


@dataclass(frozen=True, eq=False)
class Prepared:
    """One or several logs as one record of segments without gaps.

    Attributes
    ----------
    t : (N,) time [s], increasing inside a segment. q, qd, tau : (N, n).
    dt : (N,) step to the previous sample [s]; the period at the start of a segment.
    segments : (start, stop) rows of each piece without a gap.
    rate : [Hz]. resolution : (n,) half the smallest step of the encoder [rad].
    sources : name and SHA-256 of each log.
    """

    t: np.ndarray
    dt: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    segments: tuple[tuple[int, int], ...]
    rate: float
    resolution: np.ndarray
    sources: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """Length of all segments [s]."""
        return float(sum(self.t[b - 1] - self.t[a] for a, b in self.segments))

    def filter(self, x: np.ndarray, cutoff: float) -> np.ndarray:
        """Filter (N, ...) with zero phase inside each segment; the same filter serves torque and regressor."""
        out = np.empty_like(x)
        for a, b in self.segments:
            out[a:b] = lowpass_offline(x[a:b], self.rate, cutoff)
        return out

    def differentiate(self, x: np.ndarray) -> np.ndarray:
        """Differentiate (N, ...) by central differences inside each segment."""
        out = np.empty_like(x)
        for a, b in self.segments:
            out[a:b] = np.gradient(x[a:b], self.t[a:b], axis=0, edge_order=2)
        return out

    def blocks(self, seconds: float) -> np.ndarray:
        """Return the block number (N,) of each sample: blocks of `seconds` that never cross a gap."""
        number = np.empty(len(self.t), dtype=int)
        first = 0
        for a, b in self.segments:
            count = max(1, int((self.t[b - 1] - self.t[a]) / seconds))
            number[a:b] = first + np.minimum(((self.t[a:b] - self.t[a]) / seconds).astype(int), count - 1)
            first += count
        return number


def prepare(table: Table | Sequence[Table], robot: Robot) -> Prepared:
    """Check logs and cut them into segments without gaps.

    Parameters
    ----------
    table : one log or several, each with columns q, qd, tau of `robot`.
    robot : the arm that was logged.

    Raises
    ------
    ShapeError : wrong joint count, NaN rows by number, logs of different rates, gaps everywhere, velocity that is not
        the derivative of position.
    NotExcited : too short, joints at rest by name, constant torque.
    """
    tables = [table] if isinstance(table, Table) else list(table)
    if not tables:
        raise ShapeError("Expected at least one log, got none. Give the file of a recorded excitation.")
    pieces = [_segments(one, robot) for one in tables]
    rate = _common_rate(tables)
    t = np.concatenate([t[a:b] for t, _, segs in pieces for a, b in segs])
    columns = [np.concatenate([c[k][a:b] for _, c, segs in pieces for a, b in segs]) for k in range(3)]
    lengths = np.cumsum([0, *(b - a for _, _, segs in pieces for a, b in segs)])
    segments = tuple((int(a), int(b)) for a, b in pairwise(lengths))
    dt = np.diff(t, prepend=t[0])
    dt[lengths[:-1]] = 1.0 / rate
    q, qd, tau = columns
    sources = tuple(f"{one.source or 'table'} sha256:{one.sha256}" for one in tables)
    prepared = Prepared(t, dt, q, qd, tau, segments, rate, _resolution(q), sources)
    _check_motion(prepared, robot)
    _check_velocity(prepared, robot)
    return prepared


def _segments(table: Table, robot: Robot) -> tuple[np.ndarray, list[np.ndarray], list[tuple[int, int]]]:
    """Return time, [q, qd, tau] and the pieces of one log that have no gap."""
    columns = [np.asarray(table[name], dtype=float) for name in ("q", "qd", "tau")]
    for name, values in zip(("q", "qd", "tau"), columns):
        if values.shape != (len(table), robot.n):
            raise ShapeError(
                f"Expected {name} of shape ({len(table)}, {robot.n}) for robot {robot.name!r}, got {values.shape}. "
                "Name the robot that was logged."
            )
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise ShapeError(
                f"Expected finite {name}, got NaN or Inf in {len(bad)} rows, first {bad[:5].tolist()}. "
                "Drop them with table.dropna, or record with the research extension when torque is missing."
            )
    t = np.asarray(table.t, dtype=float)
    if len(t) < MIN_SEGMENT or t[-1] - t[0] < MIN_SECONDS:
        length = t[-1] - t[0] if len(t) else 0.0
        raise NotExcited(
            f"Expected a log of at least {MIN_SECONDS:g} s, got {length:.2f} s in {len(t)} rows. Record for longer.",
            ["everything"],
            ["too short"],
        )
    step = np.diff(t)
    cuts = np.flatnonzero(step > 1.5 * np.median(step)) + 1
    edges = [0, *cuts.tolist(), len(t)]
    pieces = [(a, b) for a, b in pairwise(edges) if b - a >= MIN_SEGMENT]
    if not pieces:
        raise ShapeError(
            f"Expected pieces of at least {MIN_SEGMENT} samples without a gap, got {len(cuts)} gaps in {len(t)} rows, "
            f"the longest piece with {int(np.diff(edges).max())} samples. Record again, or resample the log."
        )
    return t, columns, pieces


def _common_rate(tables: list[Table]) -> float:
    """Return the sampling rate [Hz] of all logs; one filter serves them all, so they must agree."""
    rates = [1.0 / float(np.median(np.diff(one.t))) for one in tables]
    if max(rates) > 1.1 * min(rates):
        listed = ", ".join(f"{rate:.4g} Hz" for rate in rates)
        raise ShapeError(f"Expected logs of one sampling rate, got {listed}. Resample them to the slowest first.")
    return float(np.median(rates))


def _resolution(q: np.ndarray) -> np.ndarray:
    """Return half the smallest non-zero step of each joint (n,) [rad]: the play of the presliding state."""
    steps = np.abs(np.diff(q, axis=0))
    smallest = np.where(steps > 1e-12, steps, np.inf).min(axis=0)
    return np.where(np.isfinite(smallest), 0.5 * smallest, 0.0)


def _check_motion(data: Prepared, robot: Robot) -> None:
    ranges = np.ptp(data.q, axis=0)
    still = np.flatnonzero(ranges < np.where(robot.prismatic, MIN_SLIDE, MIN_TURN))
    if len(still):
        names = [robot.joint_names[i] for i in still]
        spread = [
            f"{1e3 * x:.1f} mm" if robot.prismatic[i] else f"{np.rad2deg(x):.2f} deg" for i, x in enumerate(ranges)
        ]
        spread = [spread[i] for i in still]
        listed = ", ".join(f"{a} ({b})" for a, b in zip(names, spread))
        raise NotExcited(
            f"Expected every joint to move by at least 5 deg (20 mm), got less for {listed}: their inertia, "
            "gravity and friction cannot be told apart. Record a motion of all joints, as of identify.excitation.",
            names,
            spread,
        )
    flat = np.flatnonzero(np.ptp(data.tau, axis=0) == 0)
    if len(flat):
        names = [robot.joint_names[i] for i in flat]
        raise NotExcited(
            f"Expected measured torques, got a constant for {', '.join(names)}. Check that the robot sends torque.",
            names,
            ["constant torque"] * len(names),
        )


def _check_velocity(data: Prepared, robot: Robot) -> None:
    """Refuse a velocity that is not the derivative of the position: wrong sign, unit or joint order."""
    slope = data.filter(data.differentiate(data.q), 5.0)
    qd = data.filter(data.qd, 5.0)
    gain = np.sum(slope * qd, axis=0) / np.sum(slope * slope, axis=0)
    correlation = np.sum(slope * qd, axis=0) / np.sqrt(np.sum(slope**2, axis=0) * np.sum(qd**2, axis=0) + 1e-300)
    wrong = np.flatnonzero((np.abs(gain - 1) > 0.1) | (correlation < 0.98))
    if len(wrong):
        listed = ", ".join(f"{robot.joint_names[i]} ({gain[i]:.3g} times)" for i in wrong)
        raise ShapeError(
            f"Expected qd to be the derivative of q, got other values for {listed}. "
            "Check sign, unit (rad/s) and joint order of the velocity."
        )
