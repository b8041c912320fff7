"""What a controller sees of a packet: `seen` makes the State."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from armlab.bridge.limits import Reply
from armlab.bridge.session import Sample
from armlab.state import State


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
    packet = sample.packet
    return State(
        t=t,
        dt=sample.dt,
        q=packet.q,
        qd=sample.qd,
        tau=_missing(len(packet.q)) if packet.tau is None else packet.tau,
        seq=packet.seqno,
        missed=sample.missed,
        session=sample.session,
        qd_source=sample.qd_source,
        tau_source=packet.tau_source,
        q_start=q_start,
        q_planned=packet.q_planned,
        q_sent=last.q,
        qd_sent=last.qd,
        clamped=last.clamped,
        T_frame_tool=packet.T_frame_tool,
        wrench_raw=packet.wrench_raw,
        q_ext=packet.q_ext,
        motors=packet.motors,
        rapid=packet.rapid,
        mci=packet.mci,
        converged=packet.converged,
        utilization=packet.utilization,
        robotware=packet.robotware,
        rapid_data=packet.rapid_data,
        rapid_digital=packet.rapid_digital,
        robot_ns=packet.robot_ns,
        t_receive=t_receive,
        robot=robot,
        **fused,
    )


@cache
def _missing(n: int) -> np.ndarray:
    """Return n times NaN, read-only: what a robot does not measure."""
    missing = np.full(n, np.nan)
    missing.flags.writeable = False
    return missing
