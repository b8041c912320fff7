"""From the rows of a table back to what a controller saw."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import UnknownName
from armlab.state import State

if TYPE_CHECKING:
    from armlab.log.table import Table

__all__ = ["iterate"]

# Fields of `State` that a table may have.
_ARRAYS = ("qdd", "q_planned", "q_sent", "qd_sent", "clamped", "T_frame_tool")
_ARRAYS += ("wrench_raw", "wrench", "q_ext", "rapid_data")
_NUMBERS = {"seq": int, "missed": int, "session": int, "motors": int, "rapid": int, "mci": int}
_NUMBERS |= {"utilization": float, "robot_ns": int, "converged": bool, "rapid_digital": bool}


def iterate(table: Table) -> Iterator[State]:
    """Yield one `State` per row.

    `dt` is the recorded one, else the difference of `t`. Joint velocities or torques that the table does not have are
    NaN. `q_start` is the position in the first row of the session.

    Raises
    ------
    UnknownName : the table has no column q.
    """
    if "q" not in table:
        raise UnknownName.among("column", "q", table.names)
    return _rows(table)


def _rows(table: Table) -> Iterator[State]:
    q = table["q"]
    nothing = np.full(q.shape[1:], np.nan)
    nothing.flags.writeable = False
    arrays = {name: table[name] for name in _ARRAYS if name in table}
    numbers = {name: (kind, table[name].tolist()) for name, kind in _NUMBERS.items() if name in table}
    receive = table["receive_ns"].tolist() if "receive_ns" in table else None
    qd, tau = table.values.get("qd"), table.values.get("tau")
    sources = {"tau_source": "none" if tau is None else "measured"}
    session, q_start = None, nothing
    for row, (t, dt) in enumerate(zip(table.t.tolist(), table.dt.tolist(), strict=True)):
        extra: dict[str, Any] = {name: array[row] for name, array in arrays.items()}
        extra |= {name: kind(values[row]) for name, (kind, values) in numbers.items() if values[row] == values[row]}
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
            **sources,
            **extra,
        )
