"""State of the arms of a running bridge: `Status` counts rows, `Watch` formats the state as text."""

from __future__ import annotations

import math
import shutil
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.bridge.control.feedback import not_ready_reason
from armlab.bridge.servers.row import RowSchema, places, read_head
from armlab.errors import UnknownName

if TYPE_CHECKING:
    from armlab.bridge.servers.row import Row


_KEPT = 2500  # round trips: 10 s at 250 Hz
_COUNTED = ("fresh", "receive_ns", "send_ns", "missed", "late", "drops", "session", "clamped")
_BITS = {"position": 1, "velocity": 2, "acceleration": 4, "braking": 8}


class _ArmCounts:
    """Row statistics of one arm."""

    def __init__(self, schema: RowSchema, name: str) -> None:
        self._places = places(schema, name)
        self.trips: deque[float] = deque(maxlen=_KEPT)
        self.times: deque[int] = deque(maxlen=_KEPT)
        self.rows = self.missed = self.late = self.drops = self.session = 0
        self.longest = 0.0
        self.clamps = {kind: [0] * math.prod(schema.fields[f"{name}.clamped"].shape) for kind in _BITS}

    def add(self, data: bytes, mono_ns: int) -> None:
        fresh, received, sent, missed, late, drops, session, *clamped = (
            value
            for form, offset in map(self._places.__getitem__, _COUNTED)
            for value in form.unpack_from(data, offset)
        )
        if not fresh:
            return
        self.rows += 1
        self.times.append(mono_ns)
        if sent > 0:
            self.trips.append(1e-3 * (sent - received))
            self.longest = max(self.longest, self.trips[-1])
        self.missed, self.late = self.missed + missed, self.late + late
        self.drops, self.session = drops, session
        if any(clamped):
            for kind, bit in _BITS.items():
                self.clamps[kind] = [count + bool(word & bit) for count, word in zip(self.clamps[kind], clamped)]


class Status:
    """Row statistics of all arms."""

    def __init__(self, schema: RowSchema) -> None:
        self._schema = schema
        self._arms = {name: _ArmCounts(schema, name) for name in schema.robots}
        self._seq = self._first = self._rows = 0

    def add(self, data: bytes) -> None:
        """Count one row."""
        self._seq, mono_ns, _ = read_head(self._schema, data)
        self._rows += 1
        self._first = self._first or self._seq
        for arm in self._arms.values():
            arm.add(data, mono_ns)

    def summary(self) -> dict[str, Any]:
        """Return the counts of the feed and of each arm by name; round-trip times in us, NaN without rows."""
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


_SILENT = 0.5  # s without packets after which an arm counts as silent
_EVENTS = 8
_USED = ("motors", "rapid", "mci", "receive_ns", "seq_sent", "q_ref", "qd_ref", "wrench", "wrench_hat", "commander")


class Watch:
    """Formats the state of a bridge as text, based on its messages."""

    cell: str = ""
    told: int = 0

    def __init__(self, robot: str | None = None) -> None:
        self._robot = robot
        self._status: dict[str, Any] = {}
        self._row: Row | None = None
        self._files: list[Path] = []
        self._sizes: tuple[float, int] | None = None
        self.events: deque[str] = deque(maxlen=_EVENTS)

    @property
    def lost(self) -> int:
        return self._status.get("lost", 0)

    def take(self, message: Row | dict[str, Any]) -> None:
        if not isinstance(message, dict):
            self._row = message
            if self._robot is not None and f"{self._robot}.q" not in message.values:
                raise UnknownName.among("robot of this cell", self._robot, _names(message))
        elif message["kind"] == "about":
            self.cell = message.get("cell", "")
        elif message["kind"] == "status":
            self._status = message
        elif message["kind"] == "recording":
            self._files, self._sizes = [Path(file) for file in message["files"]], None
        elif message["kind"] == "event":
            stamp = time.strftime("%H:%M:%S", time.localtime(1e-9 * message["stamp_ns"]))
            self.events.append(f"{stamp} {message['text']}")
            self.told += 1

    def arms(self, now_ns: int) -> list[dict[str, str]]:
        """Return one table row per arm, as a mapping from headings to text."""
        if self._row is None:
            return []
        return [self._arm(self._row, name, now_ns) for name in _names(self._row) if self._robot in (None, name)]

    def _arm(self, row: Row, name: str, now_ns: int) -> dict[str, str]:
        values = {key: row.values[f"{name}.{key}"] for key in _USED}
        status = self._status.get("arms", {}).get(name, {})
        trips = " / ".join(_number(status.get(key), "{:.0f}") for key in ("p50", "p99", "longest"))
        wrench = values["wrench"] if math.isfinite(values["wrench"][0]) else values["wrench_hat"]
        has_wrench = math.isfinite(wrench[0])
        clamps = [f"{kind} {' '.join(map(str, n))}" for kind, n in status.get("clamps", {}).items() if any(n)]
        return {
            "arm": name,
            "state": _state(values, now_ns),
            "rate [Hz]": _number(status.get("rate"), "{:.1f}"),
            "p50 / p99 / max [us]": trips,
            "missed": str(status.get("missed", "-")),
            "late": str(status.get("late", "-")),
            "refused packets": str(status.get("drops", "-")),
            "force [N]": " ".join(f"{one:.1f}" for one in wrench[:3]) if has_wrench else "-",
            "moment [N m]": " ".join(f"{one:.2f}" for one in wrench[3:]) if has_wrench else "-",
            "clamps per joint": "; ".join(clamps) or "none",
            "commander": values["commander"] or "nobody",
        }

    def recording(self) -> str:
        """Return the recording files, their size, and the time until the disk is full."""
        found = {file: size for file in self._files if (size := _size(file)) is not None}
        sizes = list(found.values())
        if not sizes:
            return "none"
        total, now = sum(sizes), time.monotonic()
        if self._sizes is None:
            self._sizes = (now, total)
        seconds, grown = now - self._sizes[0], total - self._sizes[1]
        room = shutil.disk_usage(next(iter(found)).parent).free
        hours = f", space for {room / grown * seconds / 3600.0:.0f} h" if grown > 0 else ""
        return f"{', '.join(str(file) for file in self._files)}: {1e-6 * total:.1f} MB{hours}"

    def lines(self, now_ns: int) -> list[str]:
        return [
            ", ".join(value if key == "arm" else f"{key} {value}" for key, value in arm.items())
            for arm in self.arms(now_ns)
        ] or ["No rows yet, because no robot packet has arrived."]

    def notes(self) -> list[str]:
        """Return the lines for the recording, the lost rows and the last events."""
        lost = [f"Rows lost by this feed: {self.lost}"] if self.lost else []
        return [f"Recording: {self.recording()}", *lost, *self.events]


def _names(row: Row) -> list[str]:
    commanders = [name for name in row.values if name.endswith(".commander") and isinstance(row.values[name], str)]
    return [name.removesuffix(".commander") for name in commanders]


def _size(file: Path) -> int | None:
    """Return the size of a file [bytes], or None if it is unreadable or on another computer."""
    try:
        return file.stat().st_size
    except (OSError, ValueError):  # ValueError: not a path
        return None


def _state(values: dict[str, Any], now_ns: int) -> str:
    age = 1e-9 * (now_ns - values["receive_ns"])
    if age > _SILENT:
        return f"no packet for {age:.1f} s"
    is_commanded = math.isfinite(values["q_ref"][0]) or math.isfinite(values["qd_ref"][0])
    return arm_state(values["motors"], values["rapid"], values["mci"], values["seq_sent"] >= 0, is_commanded)


def arm_state(motors: int, rapid: int, mci: int, is_answered: bool, is_commanded: bool) -> str:
    """Return the state of an arm that sends packets, or the reason why the arm cannot move."""
    doing = "listening" if not is_answered else "running" if is_commanded else "holding"
    return not_ready_reason(motors, rapid, mci) or doing


def _number(value: float | None, form: str) -> str:
    return "-" if value is None or not math.isfinite(value) else form.format(value)
