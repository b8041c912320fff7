"""`Run`: what a run left behind, and its report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from armlab.bridge.recording import Recording
from armlab.log import Table

__all__ = ["Run"]


@dataclass(frozen=True, eq=False)
class Run:
    """The result of `Link.run`.

    Attributes
    ----------
    reason : why it ended, in words. path : the recording, None when rows were kept in memory.
    statistics : what was counted; also kept in the recording as its summary.
    events : (wall clock ns, sentence).
    """

    reason: str
    statistics: Mapping[str, Any]
    events: tuple[tuple[int, str], ...]
    path: Path | None
    _recording: Recording = field(repr=False)

    @cached_property
    def table(self) -> Table:
        """What was measured, asked and sent, one row per packet."""
        return self._recording.table()

    def report(self) -> str:
        """Return the run in a few lines: packets, latency, late cycles, drops, clamps per joint."""
        s = self.statistics
        latency = ", ".join(f"{name} {value:.0f}" for name, value in s["latency_us"].items())
        lines = [
            f"Ended: {self.reason}.",
            f"{s['robot']}, RobotWare {s['robotware'] or 'unknown'}, {s['sessions']} sessions, "
            f"period {1e3 * s['period_s']:.3f} ms, {s['seconds']:.2f} s under guidance.",
            f"Packets {s['packets']}, replies {s['replies']}, overtaken {s['overtaken']}, missed {s['missed']}, "
            f"late {s['late']}, commands refused {s['refused']}.",
            f"Arrival to reply [us]: {latency}.",
        ]
        drops = ", ".join(f"{number} {kind}" for kind, number in s["drops"].items())
        lines.append(f"Dropped datagrams: {drops or 'none'}. Socket errors: {s['socket_errors']}.")
        for kind, counts in s["clamps"].items():
            if any(counts):
                worst = f", worst ratio {s['worst_ratio']:.2f}" if kind == "velocity" else ""
                lines.append(f"Clamped by {kind}, times per joint: {', '.join(map(str, counts))}{worst}.")
        lines += s["problems"]
        return "\n".join(lines)
