"""`cut` and `merge`: a stretch of a recording, or several recordings, as one whole file."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlab.errors import ConfigError, LogError
from armlab.log.mcap_copy import Registry, messages_in, new_file, pieces, records_at
from armlab.log.mcap_writer import McapWriter
from armlab.log.messages import clock_metadata
from armlab.log.recording_file import recording_path
from armlab.log.splice_arm import Arm, seconds_channel
from armlab.log.splice_source import Source, attachments, metadata, opened_source, summary

__all__ = ["cut", "merge"]

Progress = Callable[[int, int, str], None]


def cut(
    path: str | Path,
    to: str | Path,
    start: float = -np.inf,
    stop: float = np.inf,
    *,
    robot: str | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the stretch start <= t < stop of a recording to a finished one, and return its path.

    ``log.read(cut(path, to, a, b)).sha256 == log.read(path).between(a, b).sha256``: `t` is not shifted, and no value
    goes through another format. Metadata and attachments stay, and the events that were written between the rows. The
    history of the parameters stays from the beginning, so that what was in force is known.

    Parameters
    ----------
    path : a recording, finished or not; of several robots each is cut on its own clock.
    to : the new file, ending in .mcap; an existing one is replaced in one step or not at all.
    start, stop : seconds of the table.
    robot : whose rows and events are taken, of a recording of several; all when None.
    progress : called with (bytes done, bytes in all, what).

    Raises
    ------
    LogError : the file is no recording of armlab or has no rows there; the new one cannot be written.
    UnknownName : no such robot in it.
    ConfigError : a name that does not end in .mcap, or a stretch that ends before it begins.
    """
    path, to = Path(path), recording_path(to)
    if not start < stop:
        raise ConfigError(f"Expected a stretch from a time to a later one, got {start:g} s to {stop:g} s.")
    with opened_source(path) as source:
        if robot is not None:
            source.keep(robot)
        for arm in source.arms:
            arm.cut(start, stop)
        if not any(arm.rows_left for arm in source.arms):
            t = np.concatenate([arm.rows.t[arm.rows.kept] for arm in source.arms])
            has = f"{t.min():g} s to {t.max():g} s" if len(t) else "no rows at all"
            raise LogError(f"Expected rows between {start:g} s and {stop:g} s in {path}, got none; it has {has}.")
        _write(to, [source], f"between({start:g}, {stop:g})", progress)
    return to


def merge(paths: Sequence[str | Path], to: str | Path, *, progress: Progress | None = None) -> Path:
    """Write several recordings to one, and return its path.

    Recordings of one robot are put one after another, by their wall clocks in whatever order they are named; the gaps
    between them stay, as in `concat`, and a column that one lacks is missing there. Recordings of several robots that
    ran at the same time, such as both arms of a bridge, stand side by side: ``log.read(to, robot="yumi_left")``.

    Parameters
    ----------
    paths : two recordings or more, finished or not.
    to : the new file, ending in .mcap; an existing one is replaced in one step or not at all.
    progress : called with (bytes done, bytes in all, what).

    Raises
    ------
    LogError : a file is no recording of armlab; two of one robot overlap, or were made of other descriptions of it, or
    have columns of one name that differ; robots that did not run at the same time; the new file cannot be written.
    ConfigError : fewer than two files, or a name that does not end in .mcap.
    """
    to = recording_path(to)
    if len(paths) < 2:
        raise ConfigError(f"Expected two recordings or more to merge, got {len(paths)}.")
    with contextlib.ExitStack() as stack:
        sources = [stack.enter_context(opened_source(Path(path))) for path in paths]
        sources.sort(key=lambda source: source.start_ns)
        arms: dict[str, list[Arm]] = {}
        for source in sources:
            for arm in source.arms:
                arms.setdefault(arm.name, []).append(arm)
        for pieces_of_one in arms.values():
            _line_up(sorted(pieces_of_one, key=lambda arm: arm.start_ns))
        _check_together(arms)
        names = ", ".join(source.path.name for source in sources)
        _write(to, sources, f"concat({len(sources)} tables)" if len(arms) == 1 else f"merge({names})", progress)
    return to


def _line_up(arms: list[Arm]) -> None:
    """Put the recordings of one robot on the clock of the first, their messages numbered on."""
    first, before = arms[0], arms[0]
    for arm in arms[1:]:
        if arm.robot_hash != first.robot_hash:
            raise LogError(
                f"Expected recordings with one description of {arm.name}, got another in {arm.path} than in "
                f"{first.path}: its hash is {arm.robot_hash[:12]}, not {first.robot_hash[:12]}."
            )
        arm.follow(first, before)
        before = arm if len(arm.rows.t) else before


def _check_together(arms: dict[str, list[Arm]]) -> None:
    """Refuse robots that did not run at the same time: what could a file of both say?"""
    spans = {
        name: (min(arm.start_ns for arm in pieces), max(arm.end_ns for arm in pieces))
        for name, pieces in arms.items()
        if any(len(arm.rows.t) for arm in pieces)
    }
    if not spans:
        return
    late = max(spans, key=lambda name: spans[name][0])
    early = min(spans, key=lambda name: spans[name][1])
    if spans[late][0] > spans[early][1]:
        raise LogError(
            f"Expected robots that ran at the same time, got {late}, which began "
            f"{(spans[late][0] - spans[early][1]) / 1e9:.3f} s after {early} had ended. Leave one out."
        )


def _write(to: Path, sources: list[Source], operation: str, progress: Progress | None) -> None:
    part = to.with_name(f".{to.name}.part")
    with contextlib.suppress(OSError):
        part.unlink()
    with new_file(to, part, replace=True) as file:
        writer = McapWriter(file, sources[0].found.profile, sources[0].found.library)
        for name, pairs in metadata(sources):
            writer.metadata(name, pairs)
        for log_ns, name, media_type, data in attachments(sources):
            writer.attach(log_ns, name, media_type, data)
        _register(writer, sources)
        lost = _copy(writer, sources, progress)
        told = json.dumps(summary(sources, operation), indent=1).encode()
        writer.attach(max(source.end_ns for source in sources), "summary.json", "application/json", told)
        writer.finish()
    if lost:
        warnings.warn(f"{lost} damaged chunks were left out of {to.name}", stacklevel=3)


def _register(writer: McapWriter, sources: list[Source]) -> None:
    """Write the channels of all sources, one per topic, and those of the column t."""
    registry, known = Registry(writer), {}
    for source in sources:
        for number, channel in source.found.channels.items():
            if any(number == arm.seconds for arm in source.arms):
                continue
            if channel.topic not in known:
                known[channel.topic] = (channel, registry.channel(channel), source.path)
            first, source.numbers[number], where = known[channel.topic]
            if first != channel:
                raise LogError(
                    f"Expected messages of one kind on {channel.topic}, got those in {source.path} to differ from "
                    f"those in {where}: in type, in units or in the names of the joints."
                )
        for arm in source.arms:
            channel = seconds_channel(arm.prefix, clock_metadata(arm.t0_ns, arm.rows.clock))
            if channel.topic not in known:
                known[channel.topic] = (channel, registry.channel(channel), source.path)
            arm.seconds_number = known[channel.topic][1]


def _copy(writer: McapWriter, sources: list[Source], progress: Progress | None) -> int:
    """Copy the messages chunk by chunk, in the order of their times; return how many chunks are damaged."""
    total, done, lost = sum(len(source.view) for source in sources), 0, 0
    for source, piece in _in_order(sources):
        data = records_at(source.view, source.found, piece)
        if data is None:
            lost += 1
            continue
        for channel, sequence, log_ns, publish_ns, message in messages_in(data):
            for copied in source.taken(channel, sequence, log_ns, publish_ns, message):
                writer.message(*copied)
        writer.close_chunk()
        done += 0 if piece is None else piece.stop - piece.start
        if progress:
            progress(done, total, "copied")
    return lost


def _in_order(sources: list[Source]) -> Iterator[tuple[Source, Any]]:
    """Yield what the messages are in by time; what is of one file, or of one robot, stays in its order."""
    latest: dict[str, int] = {}
    keyed = []
    for source in sources:
        names = [arm.name for arm in source.arms]
        at = max((latest.get(name, 0) for name in names), default=0)
        for piece in pieces(source.found):
            at = max(at, 0 if piece is None else piece.first_ns)
            keyed.append((at, len(keyed), source, piece))
        latest |= dict.fromkeys(names, at)
    for _, _, source, piece in sorted(keyed, key=lambda entry: entry[:2]):
        yield source, piece
