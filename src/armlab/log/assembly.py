"""Assembly of recorded columns into a `Table` with its clock."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from armlab.log.column import Column
from armlab.log.table import Table

_PADDED = ("q_ext", "q_ext_ref", "q_ext_sent", "rapid_data", "rapid_data_sent")  # padded to the largest robot

_MAX_DISAGREEMENT = 1.0  # s per row, robot clock minus session time; if larger, the clock was adjusted


def recording_table(
    values: Mapping[str, np.ndarray], columns: Mapping[str, Column], stamp_ns: np.ndarray, *, raw: bool = False
) -> Table:
    """Return a table of the columns (N, ...) that contain values; t = 0 at the first row."""
    t, clock = recording_clock(values, stamp_ns)
    t, keep, dropped = rows_in_order(t, raw)
    notes = [*dropped]
    values = {name: _used(array) if name in _PADDED else array for name, array in values.items()}
    if not keep.all():
        values = {name: array[keep] for name, array in values.items()}
        t, stamp_ns = t[keep], stamp_ns[keep]
    present = {name: array for name, array in values.items() if name != "t" and not _absent(array, columns[name])}
    present = dict(sorted(present.items(), key=lambda item: item[1].ndim == 1))  # q, qd, tau, then counters
    described = {name: replace(columns[name], shape=()) for name in present}
    for name, array in present.items():
        if not _fits(array, described[name].kind):  # an invalid value must not make the recording unreadable
            notes.append(f"{name}: stored as real because values do not match the kind {described[name].kind}")
            described[name] = replace(described[name], kind="real")
    return Table(t, present, described, t0_ns=wall_at_zero(t, stamp_ns), clock=clock, notes=tuple(notes))


def recording_clock(values: Mapping[str, np.ndarray], stamp_ns: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the times t (N,) [s], which begin at 0, and the name of their clock.

    Uses the first available clock: a column `t`, the robot's clock, the session time (offset by the stamps of each
    session), or the stamps. The robot's clock must be complete, increasing and within 1 s of the session time;
    otherwise, it is ignored because it was set during recording.
    """
    if "t" in values and np.isfinite(values["t"]).any():
        return np.asarray(values["t"], dtype=float), "file"
    stamps = (stamp_ns - stamp_ns[:1]) / 1e9 if len(stamp_ns) else np.zeros(0)
    session_t = values.get("session_t")
    session = values.get("session", np.ones(len(stamps)))
    robot = values.get("robot_ns")
    same = np.diff(session) == 0
    if robot is not None and len(robot) and robot.dtype.kind == "i" and (robot != 0).all():
        steps = np.diff(robot) / 1e9
        expected = np.diff(session_t) if session_t is not None else np.diff(stamps)
        if (steps > 0).all() and (np.abs(steps - expected)[same] <= _MAX_DISAGREEMENT).all():
            return (robot - robot[0]) / 1e9, "robot"
    if session_t is None or not np.isfinite(session_t).all():
        return stamps, "bridge"
    first = np.concatenate(([0], np.flatnonzero(~same) + 1)).astype(int)[: len(stamps)]
    session_t = _before_guidance(session_t, values.get("dt"), first)
    begin = np.repeat(stamps[first] - session_t[first], np.diff(np.append(first, len(stamps))))
    return session_t + begin, "robot"


def _before_guidance(session_t: np.ndarray, dt: np.ndarray | None, first: np.ndarray) -> np.ndarray:
    """Return the session time, with negative times before guidance begins."""
    if dt is None or not np.isfinite(dt).all():
        return session_t
    session_t = np.array(session_t)
    for rows in np.split(np.arange(len(session_t)), first[1:]):
        moves = np.flatnonzero(session_t[rows] != session_t[rows[:1]])
        still = rows[: moves[0]] if len(moves) else rows
        passed = np.cumsum(dt[still])
        session_t[still] -= passed[-1:] - passed
    return session_t


def wall_at_zero(t: np.ndarray, stamp_ns: np.ndarray) -> int:
    """Return the wall-clock time at t = 0 [ns], or 0 without rows; `t` need not be 0 in the first row."""
    return int(stamp_ns[0]) - round(float(t[0]) * 1e9) if len(t) else 0


def in_time_order(t: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the mask (N,) of rows later than all previous rows, and the number of rows excluded by the mask."""
    finite = np.where(np.isfinite(t), t, -np.inf)
    before = np.concatenate(([-np.inf], np.maximum.accumulate(finite)[:-1]))[: len(t)]
    keep = finite > before
    return keep, int((~keep).sum())


def rows_in_order(
    t: np.ndarray, raw: bool, row: Callable[[int], str] = "row {}".format, of: str = ""
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return increasing times (N,), the mask (N,) of kept rows, and a note on any dropped rows; also warn."""
    keep, lost = in_time_order(t)
    if not lost:
        return t, keep, ()
    if raw:  # if the clock stops or steps back, the row is 1 ns after the previous row
        steps = np.arange(len(t)) * 1e-9
        t = np.maximum.accumulate(np.where(np.isfinite(t), t, -np.inf) - steps) + steps
        return t, np.ones(len(t), dtype=bool), ()
    first = ", ".join(row(int(number)) for number in np.flatnonzero(~keep)[:5])
    note = f"{lost} rows{of} dropped: their time does not increase ({first}{', ...' if lost > 5 else ''})"
    warnings.warn(f"{note}; raw=True keeps them", stacklevel=4)
    return t, keep, (note,)


def _fits(array: np.ndarray, kind: str | None) -> bool:
    """Return whether the values are valid for the kind of their column; missing values are handled by the table."""
    if array.dtype.kind != "f" or kind not in ("count", "flag") or not np.isfinite(array).all():
        return True
    with np.errstate(invalid="ignore"):
        return bool(np.array_equal(array.astype(bool if kind == "flag" else np.int64), array))


def _absent(array: np.ndarray, column: Column) -> bool:
    """Return whether all values are missing; for a clock, a value of 0 means that it was never sent."""
    if array.dtype.kind == "i" and column.unit == "ns":
        return array.size > 0 and not (array > 0).any()
    return array.dtype.kind == "f" and array.size > 0 and bool(np.isnan(array).all())


def _used(padded: np.ndarray) -> np.ndarray:
    """Return the columns up to the last column that contains a value."""
    used = np.flatnonzero(~np.isnan(padded).all(axis=0))
    return padded[:, : used[-1] + 1 if len(used) else 1]
