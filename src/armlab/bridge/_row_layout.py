"""Where things stand in a row: its head, the fields of a robot and their order."""

from __future__ import annotations

import struct

VERSION = 1
HEAD = struct.Struct("<4sI8sQqq")
TYPES = {"float64": "<f8", "int64": "<i8", "text": "S1"}
WORDS = 48  # bytes of a commander's name: a server, a blank, 16 bytes in hexadecimal digits
REALS = ("session_t", "dt", "utilization", "age")
COUNTS = (
    "tick", "seq", "seq_sent", "session", "missed", "drops", "robot_ns", "receive_ns", "send_ns", "step_ns", "motors",
    "mci", "rapid", "converged", "late", "fresh",
)  # fmt: skip
UNITS = {"age": "s", "fresh": "1", "commander": "1"}
MEASURED = ("q", "qd", "tau", "q_planned")
ASKED = {"q_ref": "q", "qd_ref": "qd", "tau_ref": "tau"}
SENT = ("q_sent", "qd_sent", "tau_sent")
FIXED = {"wrench_raw": (6,), "wrench": (6,), "T_frame_tool": (4, 4), "q_ext": (6,)}
RECORDED = {"wrench_hat": (6,), "wrench_hat_cov": (6, 6)}
