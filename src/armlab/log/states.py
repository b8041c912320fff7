"""From the rows of a table back to what a controller saw."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from armlab.errors import UnknownName
from armlab.state import State

# The columns `qd_source` and `tau_source` hold the index of the word.
QD_SOURCES = ("difference", "measured")
TAU_SOURCES = ("none", "measured", "reference")

# Fields of `State` that a table may have.
_ARRAYS = ("qdd", "q_planned", "T_frame_tool", "wrench_raw", "wrench", "q_ext", "rapid_data")
_PREVIOUS = ("q_sent", "qd_sent", "clamped")  # a row holds its own reply, a State the one before
_NUMBERS = {"seq": int, "missed": int, "session": int, "motors": int, "rapid": int, "mci": int}
_NUMBERS |= {"utilization": float, "robot_ns": int, "converged": bool, "rapid_digital": bool}


def iterate(t: np.ndarray, periods: np.ndarray, values: Mapping[str, np.ndarray]) -> Iterator[State]:
    """Yield one `State` per row.

    `dt` is the recorded one, else the difference of `t`. Joint velocities or torques that the table does not have are
    NaN. `q_start` is the position in the first row of the session; `t` the session's time where it was recorded.
    """
    if "q" not in values:
        raise UnknownName.among("column", "q", values)
    return _rows(t, periods, values)


def _rows(times: np.ndarray, periods: np.ndarray, values: Mapping[str, np.ndarray]) -> Iterator[State]:
    q = values["q"]
    nothing = np.full(q.shape[1:], np.nan)
    nothing.flags.writeable = False
    arrays = {name: values[name] for name in _ARRAYS if name in values}
    numbers = {name: (kind, values[name].tolist()) for name, kind in _NUMBERS.items() if name in values}
    replies = {name: values[name] for name in _PREVIOUS if name in values}
    clock = values.get("session_t", times)
    receive = values["receive_ns"].tolist() if "receive_ns" in values else None
    qd, tau = values.get("qd"), values.get("tau")
    words = {"qd_source": QD_SOURCES, "tau_source": TAU_SOURCES}
    codes = {name: (known, values[name].tolist()) for name, known in words.items() if name in values}
    constant = {} if tau is None or "tau_source" in values else {"tau_source": "measured"}
    session, q_start = None, nothing
    for row, (t, dt) in enumerate(zip(clock.tolist(), periods.tolist(), strict=True)):
        extra: dict[str, Any] = {name: array[row] for name, array in arrays.items()}
        extra |= {name: array[row - 1] for name, array in replies.items() if row}
        extra |= {name: kind(column[row]) for name, (kind, column) in numbers.items() if column[row] == column[row]}
        extra |= {name: known[int(code[row])] for name, (known, code) in codes.items()} | constant
        if receive is not None and receive[row] == receive[row]:
            extra["t_receive"] = int(receive[row])
        if extra.get("session", 1) != session:
            session, q_start = extra.get("session", 1), q[row]
        yield State(
            t=t,
            dt=dt,
            q=q[row],
            qd=nothing if qd is None else qd[row],
            tau=nothing if tau is None else tau[row],
            q_start=q_start,
            **extra,
        )


def periods(t: np.ndarray, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the time since the previous row (N,) [s], as a controller was told it.

    That is the recorded `dt`, but the difference of `t` where the two are half a period apart: rows are missing
    there. At the first row of a session they may differ.
    """
    steps = np.diff(t)
    usual = np.median(steps) if len(steps) else np.nan
    differences = np.concatenate(([usual][: len(t)], steps))
    recorded = values.get("dt")
    if recorded is None or not len(t):
        return differences
    begins = np.ones(len(t), dtype=bool)
    begins[1:] = np.diff(values["session"]) != 0 if "session" in values else False
    trusted = begins | (np.abs(recorded - differences) < 0.5 * usual)
    return np.where(trusted & np.isfinite(recorded), recorded, differences)
