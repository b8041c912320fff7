"""`Run`: what a run left behind, and its report; `statistics` of one arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from armlab.bridge.control.arm import Arm
from armlab.bridge.control.recording import Recording
from armlab.log import Table

__all__ = ["Run", "served", "statistics", "together"]

_CLAMPS = ("position", "velocity", "acceleration", "braking", "torque", "torque rate")


@dataclass(frozen=True, eq=False)
class Run:
    """The result of `Link.run`.

    Attributes
    ----------
    reason : why it ended, in words. path : the recording, None when rows were kept in memory or there are several arms.
    statistics : what was counted; also kept in the recording as its summary. With several arms: under "arms", by name.
    events : (wall clock ns, sentence).
    arms : the Run of each arm when there are several, the pacing arm first.
    """

    reason: str
    statistics: Mapping[str, Any]
    events: tuple[tuple[int, str], ...]
    path: Path | None
    _recording: Recording | None = field(repr=False)
    arms: tuple[Run, ...] = ()

    @classmethod
    def of_several(cls, reason: str, arms: tuple[Run, ...]) -> Run:
        """Return the run of several arms.

        Parameters
        ----------
        reason : why it ended. arms : each arm's, the pacing arm first.
        """
        counted = {"arms": {arm.statistics["robot"]: arm.statistics for arm in arms}, "reason": reason}
        counted["problems"] = [problem for arm in arms for problem in arm.statistics["problems"]]
        return cls(reason, counted, tuple(sorted(event for arm in arms for event in arm.events)), None, None, arms)

    @cached_property
    def table(self) -> Table:
        """What was measured, asked and sent, one row per packet; with several arms see `together`."""
        if self._recording is not None:
            return self._recording.table()
        return together({arm.statistics["robot"]: arm.table for arm in self.arms})

    def report(self) -> str:
        """Return the run in a few lines: packets, latency, late cycles, drops, clamps per joint; see also `served`."""
        arms = [line for arm in self.arms or (self,) for line in arm._lines()]
        return "\n".join([*arms, *served((self.arms or (self,))[0].statistics)])

    def _lines(self) -> list[str]:
        """Return what there is to say of one arm."""
        s = self.statistics
        lines = [
            f"Ended: {self.reason}.",
            f"{s['robot']}, RobotWare {s['robotware'] or 'unknown'}, {s['sessions']} sessions, "
            f"period {1e3 * s['period_s']:.3f} ms, {s['seconds']:.2f} s under guidance.",
            f"Packets {s['packets']}, replies {s['replies']}, overtaken {s['overtaken']}, missed {s['missed']}, "
            f"late {s['late']}, commands refused {s['refused']}.",
        ]
        if s["replies"]:
            latency = ", ".join(f"{name} {value:.0f}" for name, value in s["latency_us"].items())
            lines.append(f"Arrival to reply [us]: {latency}.")
        if s["left_out"]:
            lines.append(f"Left out {s['left_out']} replies: so many messages waited in the robot's queue.")
        drops = ", ".join(f"{number} {kind}" for kind, number in s["drops"].items())
        lines.append(f"Dropped datagrams: {drops or 'none'}. Socket errors: {s['socket_errors']}.")
        for kind, counts in s["clamps"].items():
            if any(counts):
                worst = f", worst ratio {s['worst_ratio']:.2f}" if kind == "velocity" else ""
                lines.append(f"Clamped by {kind}, times per joint: {', '.join(map(str, counts))}{worst}.")
        return lines + s["problems"]


def statistics(arm: Arm, reason: str) -> dict[str, Any]:
    """Return what was counted of one arm."""
    session, guide = arm.session, arm.guide
    return {
        "robot": arm.robot.name,
        "robotware": getattr(arm.codec, "robotware", ""),
        "sessions": session.number,
        "period_s": session.period.seconds,
        "seconds": guide.elapsed,
        "packets": session.received,
        "replies": arm.replies,
        "overtaken": arm.overtaken,
        "left_out": arm.surplus.left_out,
        "missed": session.missed,
        "late": arm.late,
        "refused": guide.refused,
        "drops": dict(session.drops),
        "socket_errors": arm.port.errors,
        "latency_us": arm.latency.summary(),
        "latency_histogram": arm.latency.histogram(),
        "clamps": dict(zip(_CLAMPS, guide.clamps.tolist(), strict=True)),
        "worst_ratio": guide.worst_ratio,
        "reason": reason,
    }


def served(statistics: Mapping[str, Any]) -> list[str]:
    """Return who was served and who commanded in a run with servers, and its parameters, in sentences."""
    lines = []
    for name, server in statistics.get("servers", {}).items():
        lost = f" ({server['lost']} lost)" if server["lost"] else ""
        clients = [
            f"{client} {sent}{f' ({dropped} dropped)' if dropped else ''}"
            for client, (sent, dropped) in (server["clients"] or {}).items()
        ]
        unknown = "none" if server["clients"] is not None else "unknown, it did not answer"
        lines.append(
            f"Rows to the server {name}: {server['rows']}{lost}. To its clients: {', '.join(clients) or unknown}."
        )
    for arm, clients in statistics.get("commands", {}).items():
        lines.append(f"Commands to {arm}: {_counted(clients)}.")
    if statistics.get("commands_refused"):
        lines.append(f"Commands of clients refused: {_counted(statistics['commands_refused'])}.")
    if statistics.get("parameters"):
        values = (f"{name} = {value}" for name, value in statistics["parameters"].items())
        lines.append(f"Parameters in force: {', '.join(values)}.")
    return lines


def _counted(clients: Mapping[str, int]) -> str:
    return ", ".join(f"{client} {number}" for client, number in clients.items()) or "none"


def together(tables: Mapping[str, Table]) -> Table:
    """Return the tables of several arms as one, with columns such as ``yumi_left.q``.

    The rows are those of the first arm; the others have their last row at or before, and its age in ``<robot>.age``.
    """
    named = [
        (robot, table.rename({name: f"{robot}.{name}" for name in table.names})) for robot, table in tables.items()
    ]
    (_, rows), *others = named
    for robot, table in others:
        if len(rows) and len(table):
            joined = rows.join(table)
            ages = [f"{name}_age" for name in table.names]
            rows = joined.rename({ages[0]: f"{robot}.age"}).without(*ages[1:])
    return rows
