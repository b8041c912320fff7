"""What a controller sees of a packet: `seen` makes the State."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np

from armlab import kernels
from armlab.bridge.limits import Reply
from armlab.bridge.session import Sample
from armlab.state import State

_NAMES = (
    "t", "dt", "q", "qd", "tau", "seq", "missed", "session", "qd_source", "tau_source", "q_start", "q_planned",
    "q_sent", "qd_sent", "clamped", "T_frame_tool", "wrench_raw", "q_ext", "motors", "rapid", "mci", "converged",
    "utilization", "robotware", "rapid_data", "rapid_digital", "robot_ns", "t_receive", "robot",
)  # fmt: skip
_PLAIN = State(0.0, 0.0, np.zeros(0), np.zeros(0), np.zeros(0))
_OTHERS = tuple((field.name, getattr(_PLAIN, field.name)) for field in fields(State) if field.name not in _NAMES)
_make = kernels.RecordMaker(State, (*_NAMES, *(name for name, _ in _OTHERS))).make


def seen(
    sample: Sample,
    last: Reply,
    t: float,
    q_start: np.ndarray,
    t_receive: int,
    robot: str,
    fused: Mapping[str, Any],
) -> State:
    """Return the state: the packet of a sample, the reply `last` to the one before, and what is `fused` with them."""
    packet, _, dt, missed, session, _, qd, qd_source, _ = sample
    (
        seqno, _, robot_ns, q, q_planned, q_ext, _, tau, tau_source, T_frame_tool, wrench_raw, motors, mci, rapid,
        converged, utilization, robotware, rapid_data, rapid_digital, _, _,
    ) = packet  # fmt: skip
    return _make(
        (
            t, dt, q, qd, _missing(len(q)) if tau is None else tau, seqno, missed, session, qd_source, tau_source,
            q_start, q_planned, last.q, last.qd, last.clamped, T_frame_tool, wrench_raw, q_ext, motors, rapid, mci,
            converged, utilization, robotware, rapid_data, rapid_digital, robot_ns, t_receive, robot,
            *[fused.get(name, plain) for name, plain in _OTHERS],
        )
    )  # fmt: skip


@cache
def _missing(n: int) -> np.ndarray:
    """Return n times NaN, read-only: what a robot does not measure."""
    missing = np.full(n, np.nan)
    missing.flags.writeable = False
    return missing
