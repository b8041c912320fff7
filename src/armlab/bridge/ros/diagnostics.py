"""How an arm does, as diagnostic_msgs/msg/DiagnosticArray: rate, round trips, lost packets, who commands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from armlab.bridge.ros.arm import header
from armlab.bridge.ros.types import store

__all__ = ["diagnostics"]

_OK, _WARN, _ERROR = 0, 1, 2
_SILENT = 1.0  # s without a packet that are a fault


def diagnostics(
    robot: str, wall_ns: int, counts: Mapping[str, Any], commander: str, answer: str = "", silent: float = 0.0
) -> Any:
    """Return the message of one arm.

    Parameters
    ----------
    robot : its name. wall_ns : wall clock. counts : of `Status.summary`. commander : who commands, "" for nobody.
    answer : the last to a client, "" for none. silent : s since the last packet; infinite before the first.
    """
    types = store().types
    faults = [f"{counts[name]} {words}" for name, words in _FAULTS.items() if counts[name]]
    is_silent = silent > _SILENT
    link = ("no packet yet" if math.isinf(silent) else f"no packet for {silent:.1f} s") if is_silent else "receiving"
    shown = {
        "link": link,
        "rate [1/s]": _number(0.0 if is_silent else counts["rate"]),
        **{f"round trip {name} [us]": _number(counts[key]) for name, key in _TRIPS.items()},
        **{words: str(counts[name]) for name, words in _FAULTS.items()},
        "clamped samples": str(sum(map(sum, counts["clamps"].values()))),
        "session": str(counts["session"]),
        "commander": commander or "nobody",
        "last answer": answer or "none",
    }
    values = [types["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in shown.items()]
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=_ERROR if is_silent else _WARN if faults else _OK,
        name=f"armlab: {robot}",
        message=", ".join([link] * is_silent + faults) or "every packet answered",
        hardware_id=robot,
        values=values,
    )
    return types["diagnostic_msgs/msg/DiagnosticArray"](header(wall_ns), [status])


_TRIPS = {"p50": "p50", "p99": "p99", "longest": "longest"}
_FAULTS = {"missed": "packets missed", "late": "late answers", "drops": "packets refused"}


def _number(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:.1f}"
