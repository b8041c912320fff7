"""Start and result of a run: `assemble` creates the arms; `finished` returns the `Run`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from armlab._display import Shown
from armlab.bridge.control.arm import ArmSession, End
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.recording import Feed, Recording, paths
from armlab.bridge.control.supervision import Settings
from armlab.bridge.inputs.fusion import Fusion
from armlab.bridge.inputs.sources import Source, check_source
from armlab.bridge.net.events import nobody
from armlab.errors import ConfigError
from armlab.log import Column, Table
from armlab.robots import Robot


def checked_limits(
    limits: Limits | Sequence[Limits] | None, robots: Sequence[Robot], commands: bool = True
) -> list[Limits]:
    given: list[Any] = [Limits.of(robot) for robot in robots]
    if limits is not None:
        given = list(limits) if isinstance(limits, list | tuple) else [limits]
    for one in given:
        if not isinstance(one, Limits):
            raise ConfigError(f"Expected Limits, or a list with one Limits per arm, got {one!r}. Use Limits.of(robot).")
    if len(given) != len(robots):
        names = ", ".join(robot.name for robot in robots)
        raise ConfigError(f"Expected Limits for each of {names}, got {len(given)}. Use Limits.of(robot) for each arm.")
    for one, robot in zip(given, robots, strict=True):
        if len(one.q_min) != robot.n:
            raise ConfigError(
                f"Expected limits for the {robot.n} joints of {robot.name}, got {len(one.q_min)}. Use Limits.of(robot)."
            )
        if commands and not np.isfinite([one.qd_max, one.qdd_max, one.jump]).all():
            raise ConfigError(
                f"Expected speed and acceleration limits for each joint of {robot.name}, got qd_max = {one.qd_max} "
                f"and qdd_max = {one.qdd_max}, which would allow any jump. Add these limits to the robot file, or pass "
                "`limits`."
            )
    return given


def assemble(
    ends: Sequence[End],
    limits: Sequence[Limits],
    settings: Settings,
    *,
    commands: bool,
    answer_stream: bool,
    record: str | Path | None,
    extra: Mapping[str, Column] | None,
    attachments: Mapping[str, bytes],
    feeds: Sequence[Feed],
    sources: Sequence[Source],
) -> list[ArmSession]:
    """Create the arms of a run, with a common clock."""
    wall_ns = time.time_ns() - time.monotonic_ns()
    active_feeds = list(feeds)  # shared, so a failing feed is dropped for all arms
    for name, column in (extra or {}).items():
        if not isinstance(column, Column):
            raise ConfigError(
                f"Expected `extra` to map names to columns, as in extra={{'{name}': Column(unit='N')}}, got {column!r}."
            )
    columns = {**Fusion(sources).columns, **(extra or {})}
    for source in sources:
        check_source(source, [end.robot for end in ends])
    files = paths(record, [end.robot for end in ends])
    arms: list[ArmSession] = []
    try:
        for index, (end, one, file) in enumerate(zip(ends, limits, files, strict=True)):
            recording = Recording(
                end.robot,
                file,
                columns,
                attachments=attachments,
                wait=settings.clock == "robot",
                clock=lambda index=index: arms[index].stamp_ns,
                feeds=active_feeds,
                label=end.robot.name if len(ends) > 1 else "",
            )
            fusion = Fusion(sources, nobody if arms else recording.event)
            arms.append(
                ArmSession(
                    end, one, settings, wall_ns, recording, fusion, commands=commands, answer_stream=answer_stream
                )
            )
    except BaseException:
        for arm in arms:
            arm.recording.close({})
        raise
    for feed in feeds:
        begin = getattr(feed, "begin", None)
        if begin is not None:
            files = [arm.recording.path for arm in arms if arm.recording.path is not None]
            begin(arms[0].recording.note, files, lambda change: [arm.recording.parameter(change) for arm in arms])
    return arms


def finished(arms: Sequence[ArmSession], reason: str, feeds: Sequence[Feed] = ()) -> Run:
    """Close the recordings and return the result of the run."""
    runs = []
    summary = {}
    for feed in feeds:
        summary |= getattr(feed, "summary", dict)()
    for arm in arms:
        try:
            arm.record()
            lost = []
        except Exception as error:  # the recording must still be closed
            lost = [f"The last rows were not recorded: {type(error).__name__}."]
        counted = {**statistics(arm, reason), **summary}
        why = arm.machine.refusing
        refused = [f"The last command to {arm.robot.name} was refused. {why}"] if why else []
        problems = refused + lost + arm.recording.close(counted)
        events = tuple(arm.recording.events)
        runs.append(Run(reason, {**counted, "problems": problems}, events, arm.recording.path, arm.recording))
    if len(runs) == 1:
        return runs[0]
    counted = {"arms": {run.statistics["robot"]: run.statistics for run in runs}, "reason": reason}
    counted["problems"] = [problem for run in runs for problem in run.statistics["problems"]]
    events = tuple(sorted(event for run in runs for event in run.events))
    return Run(reason, counted, events, None, None, tuple(runs))


_CLAMPS = ("position", "velocity", "acceleration", "braking", "torque", "torque rate")


@dataclass(frozen=True, eq=False, repr=False)
class Run(Shown):
    """Result of `Link.run`.

    Attributes
    ----------
    reason : str
        Why the run ended.
    statistics : mapping
        Counts and latencies, also stored as the summary of the recording; with several arms, "arms" maps the name
        of each arm to its statistics.
    events : tuple of (int, str)
        Wall-clock time [ns] and text of each event.
    path : Path
        File of the recording; None if the rows were kept in memory or the run had several arms.
    arms : tuple of Run
        Run of each arm, pacing arm first; empty for a single arm.
    """

    reason: str
    statistics: Mapping[str, Any]
    events: tuple[tuple[int, str], ...]
    path: Path | None
    _recording: Recording | None = field(repr=False)
    arms: tuple[Run, ...] = ()

    @cached_property
    def table(self) -> Table:
        """Measured, commanded and sent values, one row per packet; several arms are merged by `together`."""
        if self._recording is not None:
            return self._recording.table()
        return together({arm.statistics["robot"]: arm.table for arm in self.arms})

    def report(self) -> str:
        """Return a short summary of packets, latency, late cycles, drops, clamps per joint, and clients."""
        arms = [line for arm in self.arms or (self,) for line in arm._lines()]
        return "\n".join([*arms, *served((self.arms or (self,))[0].statistics)])

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.report())}</pre>"

    def _lines(self) -> list[str]:
        """Return the report of one arm."""
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
        if s["skipped"]:
            share = 100.0 * s["skipped"] / (s["skipped"] + s["missed"] + s["packets"])
            lines.append(
                f"Cycles without a packet, according to the clock of the controller: {s['skipped']} ({share:.1f} %). A "
                "simulator skips cycles on a busy computer."
            )
        if s["left_out"]:
            lines.append(f"Skipped {s['left_out']} replies because the robot's receive queue was full.")
        drops = ", ".join(f"{number} {kind}" for kind, number in s["drops"].items())
        lines.append(f"Dropped datagrams: {drops or 'none'}. Socket errors: {s['socket_errors']}.")
        for kind, counts in s["clamps"].items():
            if any(counts):
                worst = f", worst ratio {s['worst_ratio']:.2f}" if kind == "velocity" else ""
                lines.append(f"Clamped by {kind} (count per joint): {', '.join(map(str, counts))}{worst}.")
        if self.path is not None:
            lines.append(f"Log: {self.path}.")
        return lines + s["problems"]


def statistics(arm: ArmSession, reason: str) -> dict[str, Any]:
    session, machine = arm.session, arm.machine
    return {
        "robot": arm.robot.name,
        "robotware": getattr(arm.codec, "robotware", ""),
        "sessions": session.number,
        "period_s": session.period.seconds,
        "seconds": machine.elapsed,
        "packets": session.received,
        "replies": arm.replies,
        "overtaken": arm.overtaken,
        "left_out": arm.trimming.left_out,
        "missed": session.missed,
        "skipped": session.skipped,
        "late": arm.late,
        "refused": machine.refused,
        "drops": dict(session.drops),
        "socket_errors": arm.port.errors,
        "latency_us": arm.latency.summary(),
        "latency_histogram": arm.latency.histogram(),
        "clamps": dict(zip(_CLAMPS, machine.clamps.tolist(), strict=True)),
        "worst_ratio": machine.worst_ratio,
        "reason": reason,
    }


def served(statistics: Mapping[str, Any]) -> list[str]:
    """Return the report lines about served clients, commanding clients and parameters."""
    lines = []
    for name, server in statistics.get("servers", {}).items():
        lost = f" ({server['lost']} lost)" if server["lost"] else ""
        clients = [
            f"{client} {sent}{f' ({dropped} dropped)' if dropped else ''}"
            for client, (sent, dropped) in (server["clients"] or {}).items()
        ]
        unknown = "none" if server["clients"] is not None else "unknown (the server did not answer)"
        lines.append(
            f"Rows to the server {name}: {server['rows']}{lost}. Rows from "
            f"this server to its clients: {', '.join(clients) or unknown}."
        )
    for arm, clients in statistics.get("commands", {}).items():
        lines.append(f"Commands to {arm}: {_counted(clients)}.")
    if statistics.get("commands_refused"):
        lines.append(f"Refused client commands: {_counted(statistics['commands_refused'])}.")
    if statistics.get("parameters"):
        values = (f"{name} = {value}" for name, value in statistics["parameters"].items())
        lines.append(f"Parameter values: {', '.join(values)}.")
    return lines


def _counted(clients: Mapping[str, int]) -> str:
    return ", ".join(f"{client} {number}" for client, number in clients.items()) or "none"


def together(tables: Mapping[str, Table]) -> Table:
    """Merge the tables of several arms into one, with columns such as ``yumi_left.q``.

    The merged table has one row for each row of the first arm. Each row is joined with the last row of every other arm
    at or before its time; ``<robot>.age`` is the age of the joined row.
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
