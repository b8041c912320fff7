"""`Status`: how the arms do, counted from the rows: rate, round trips, lost and late packets, clamps."""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import Any

import numpy as np

from armlab.bridge.servers.row import RowSchema

__all__ = ["Status"]

_KEPT = 2500  # round trips: 10 s at 250 Hz
_HEAD_SEQ, _HEAD_MONO = 16, 24  # bytes from the beginning of a row
_TOGETHER = 64  # rows: one alone takes eight times as long, as nothing of this is in the cache then
_BITS = {"position": 1, "velocity": 2, "acceleration": 4, "braking": 8}


class _Arm:
    """What is counted of one arm."""

    def __init__(self, schema: RowSchema, name: str) -> None:
        fields = schema.fields
        self.at = {
            word: fields[f"{name}.{word}"].offset
            for word in ("fresh", "receive_ns", "send_ns", "missed", "late", "drops", "session", "clamped")
        }
        self.joints = struct.Struct(f"<{math.prod(fields[f'{name}.clamped'].shape)}q")
        self.trips: deque[float] = deque(maxlen=_KEPT)
        self.times: deque[int] = deque(maxlen=_KEPT)
        self.rows = self.missed = self.late = self.drops = self.session = 0
        self.longest = 0.0
        self.clamps = {kind: [0] * (self.joints.size // 8) for kind in _BITS}


class Status:
    """Counts rows as they come."""

    def __init__(self, schema: RowSchema) -> None:
        self._arms = {name: _Arm(schema, name) for name in schema.robots}
        self._seq = self._first = self._rows = 0
        self._waiting: list[bytes] = []

    def add(self, data: bytes) -> None:
        """Count one row, at the latest when somebody asks for the counts."""
        self._waiting.append(data)
        if len(self._waiting) == _TOGETHER:
            self._count_waiting()

    def _count_waiting(self) -> None:
        for data in self._waiting:
            self._count(data)
        self._waiting.clear()

    def _count(self, data: bytes) -> None:
        (self._seq,) = struct.unpack_from("<Q", data, _HEAD_SEQ)
        (mono_ns,) = struct.unpack_from("<q", data, _HEAD_MONO)
        self._rows += 1
        self._first = self._first or self._seq
        for arm in self._arms.values():
            if not _integer(data, arm.at["fresh"]):
                continue
            arm.rows += 1
            arm.times.append(mono_ns)
            received, sent = _integer(data, arm.at["receive_ns"]), _integer(data, arm.at["send_ns"])
            if sent > 0:
                trip = 1e-3 * (sent - received)
                arm.trips.append(trip)
                arm.longest = max(arm.longest, trip)
            arm.missed += _integer(data, arm.at["missed"])
            arm.late += _integer(data, arm.at["late"])
            arm.drops, arm.session = _integer(data, arm.at["drops"]), _integer(data, arm.at["session"])
            clamped = arm.joints.unpack_from(data, arm.at["clamped"])
            if any(clamped):
                for kind, bit in _BITS.items():
                    arm.clamps[kind] = [count + bool(word & bit) for count, word in zip(arm.clamps[kind], clamped)]

    def summary(self) -> dict[str, Any]:
        """Return the counts: of the feed, and by name of each arm; round trips in microseconds, NaN without any."""
        self._count_waiting()
        arms = {}
        for name, arm in self._arms.items():
            seconds = 1e-9 * (arm.times[-1] - arm.times[0]) if len(arm.times) > 1 else 0.0
            p50, p99 = np.percentile(arm.trips, (50.0, 99.0)) if arm.trips else (math.nan, math.nan)
            arms[name] = {
                "rows": arm.rows,
                "last_ns": arm.times[-1] if arm.times else None,
                "rate": (len(arm.times) - 1) / seconds if seconds > 0.0 else math.nan,
                "p50": float(p50),
                "p99": float(p99),
                "longest": arm.longest if arm.trips else math.nan,
                "missed": arm.missed,
                "late": arm.late,
                "drops": arm.drops,
                "session": arm.session,
                "clamps": arm.clamps,
            }
        lost = self._seq - self._first + 1 - self._rows if self._rows else 0
        return {"rows": self._rows, "lost": lost, "arms": arms}


def _integer(data: bytes, offset: int) -> int:
    return struct.unpack_from("<q", data, offset)[0]
