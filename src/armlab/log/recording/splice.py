"""`cut` writes a segment of a recording as a complete file; `merge` joins several recordings into one file."""

from __future__ import annotations

import contextlib
import json
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from armlab.errors import ConfigError, LogError
from armlab.log.column import Column, resolved
from armlab.log.file_formats.description import Progress
from armlab.log.file_formats.opening import check_readable, file_hash, naming, opened, undamaged
from armlab.log.mcap.records import DAMAGE, Channel, Contents, contents, messages_in, pieces, records_at
from armlab.log.mcap.recovery import copied_channel, new_file
from armlab.log.mcap.writer import McapWriter
from armlab.log.recording.columns import Rows, clock_channel, clocks, earlier, rows_of, summary_of
from armlab.log.recording.file import recording_path
from armlab.log.recording.ros_messages import COLUMN_KEY, clock_metadata, column_topic, definition, topic_name
from armlab.log.recording.rows import Slot

_SECONDS = struct.Struct("<4sIIIB3xI4xd")  # message of the column t: stamp, empty frame name, one number
_NUMBERS = 1 << 32  # number of distinct sequence numbers in MCAP
_NEVER = (1 << 63) - 1


class SplicedRows:
    """Selected rows of one robot in a file, with their times `t` and numbers in the new file."""

    def __init__(self, path: Path, prefix: str, robot_hash: str, rows: Rows, seconds: int | None) -> None:
        self.path, self.prefix, self.name, self.robot_hash = path, prefix, prefix.strip("/"), robot_hash
        self.rows, self.seconds, self.seconds_number = rows, seconds, 0
        self.t, self.t0_ns = rows.t, rows.t0_ns
        self.inside, self.is_over = True, False
        self._first, self._last = 0, len(rows.t)
        self._offset = 0
        self._place = {int(number): place for place, number in enumerate(rows.sequence)}
        twice = len(rows.t) - len(self._place)
        if twice:
            raise LogError(
                f"Expected distinct row numbers in {path}, got {twice} repeated numbers. "
                "Rewrite the file: log.write(log.read(path), 'new.mcap', robot)."
            )

    @property
    def start_ns(self) -> int:
        """Wall-clock time of the first row [ns]; without rows, the largest value, so an empty file never sets the
        clock."""
        return self._wall(0) if self.rows.kept.any() else _NEVER

    @property
    def end_ns(self) -> int:
        return self._wall(-1)

    @property
    def rows_left(self) -> int:
        """Number of selected rows of the table."""
        return int(self.rows.kept[self._first : self._last].sum())

    @property
    def ticks(self) -> tuple[int, int]:
        """Numbers of the first and last selected rows in the original file."""
        numbers = self.rows.sequence[self._first : self._last]
        return (int(numbers[0]), int(numbers[-1])) if len(numbers) else (0, -1)

    def cut(self, start: float, stop: float) -> None:
        """Select the rows with start <= t < stop, and the messages between them."""
        kept = np.flatnonzero(self.rows.kept)
        t = self.rows.t[kept]
        wanted = kept[(t >= start) & (t < stop)]
        if len(wanted) == 0:
            self._first, self._last = 0, 0
        else:  # messages before the first table row belong to that row, and later messages to the last row
            self._first = int(wanted[0]) if wanted[0] > kept[0] else 0
            self._last = int(wanted[-1]) + 1 if wanted[-1] < kept[-1] else len(self.rows.t)
        self.inside = self._first == 0 and self._last > 0

    def follow(self, first: SplicedRows, before: SplicedRows) -> None:
        """Convert the rows to the clock of the first recording, and number them after those of the previous one."""
        self.t, self.t0_ns = self.rows.t + (self.rows.t0_ns - first.t0_ns) / 1e9, first.t0_ns
        own, last = self.t[self.rows.kept], before.t[before.rows.kept]
        if len(own) and len(last) and own[0] <= last[-1]:
            raise LogError(
                f"Expected {self.path} of {self.name} to begin after the end of {before.path} at {last[-1]:.6g} s, got "
                f"{own[0]:.6g} s. Cut one of the two recordings, or join them in Python: log.concat and Table.shifted."
            )
        if len(self.rows.sequence) and len(before.rows.sequence):
            highest = int(before.rows.sequence.max()) + before._offset
            self._offset = max(0, highest + 1 - int(self.rows.sequence.min()))

    def number(self, sequence: int) -> int:
        """Return the number of a row in the new file."""
        return (sequence + self._offset) % _NUMBERS

    def arrive(self, sequence: int, log_ns: int) -> bytes | None:
        """Process the start of a row; return the message with its time t, or None if the row is not selected."""
        place = self._place.get(sequence)
        if place is None:
            return None
        self.inside, self.is_over = self._first <= place < self._last, place >= self._last
        if not self.inside:
            return None
        seconds, rest = divmod(log_ns, 10**9)
        return _SECONDS.pack(b"\0\1\0\0", seconds & 0xFFFFFFFF, rest, 1, 0, 1, self.t[place])

    def _wall(self, which: int) -> int:
        t = self.rows.t[self.rows.kept]
        return self.rows.t0_ns + round(float(t[which]) * 1e9) if len(t) else 0


_PARAMETER = "armlab_msgs/msg/Parameter"
_SUMMARY = "summary.json"
Message = tuple[int, int, int, int, bytes]  # channel, sequence, log and publish time, data


@dataclass(slots=True)
class Source:
    """Recording: its bytes, contents and robots, the origins of its rows, and its channels in the new file."""

    path: Path
    view: memoryview
    found: Contents
    arms: list[SplicedRows]
    chain: tuple[str, ...]
    numbers: dict[int, int] = field(default_factory=dict)
    _routes: dict[int, tuple[int | None, SplicedRows | None, bool, bool, bool]] = field(default_factory=dict)

    @property
    def start_ns(self) -> int:
        return min(arm.start_ns for arm in self.arms)

    @property
    def end_ns(self) -> int:
        return max(arm.end_ns for arm in self.arms)

    def keep(self, robot: str) -> None:
        """Select the rows and events of one robot; metadata and attachments of the whole file are kept."""
        topic = self.found.channels[clock_channel(self.found, self.path, robot)].topic
        others = tuple(arm.prefix for arm in self.arms if not topic.startswith(arm.prefix))
        self.arms = [arm for arm in self.arms if arm.prefix not in others]
        channels = self.found.channels.items()
        self.found.channels = {number: one for number, one in channels if not one.topic.startswith(others)}

    def taken(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> tuple[Message, ...]:
        """Return the messages for the new file: the message itself if selected and, for a row, the message that
        contains the row's time.

        Messages between the first and the last selected row, and earlier parameter values, are selected.
        """
        route = self._routes.get(channel)
        if route is None:
            route = self._routes[channel] = self._route(channel)
        number, arm, is_clock, is_row, is_history = route
        if number is None:
            return ()
        if arm is None:
            inside = any(arm.inside for arm in self.arms)
            return ((number, sequence, log_ns, publish_ns, data),) if inside else ()
        seconds = arm.arrive(sequence, log_ns) if is_clock else None
        if not (arm.inside or (is_history and not arm.is_over)):
            return ()
        place = arm.number(sequence) if is_row else sequence
        message = (number, place, log_ns, publish_ns, data)
        return (message,) if seconds is None else (message, (arm.seconds_number, place, log_ns, publish_ns, seconds))

    def _route(self, channel: int) -> tuple[int | None, SplicedRows | None, bool, bool, bool]:
        """Return the new channel, its arm, and whether its messages are rows, parts of rows, or parameters."""
        about = self.found.channels.get(channel)
        if about is None:
            return None, None, False, False, False
        arm = next((arm for arm in self.arms if about.topic.startswith(arm.prefix)), None)
        is_clock = arm is not None and channel == arm.rows.channel
        is_row = any(key.startswith(COLUMN_KEY) for key in about.metadata)
        return self.numbers.get(channel), arm, is_clock, is_row, about.type == _PARAMETER


@contextmanager
def opened_source(path: Path) -> Iterator[Source]:
    check_readable(path)
    with opened(path) as view:
        with undamaged(f"recording in {path}", DAMAGE):
            with naming(path):
                found = contents(view)
            if not clocks(found):
                clock_channel(found, path, None)  # raises an error that lists the topics
            arms = [_arm(path, view, found, topic) for topic in clocks(found).values()]
        if not found.finished:
            warnings.warn(f"{path.name} was not finished: using the readable part", stacklevel=3)
        yield Source(path, view, found, arms, (f"{path.name} sha256 {file_hash(path)}", *earlier(view, found)))


def _arm(path: Path, view: memoryview, found: Contents, topic: str) -> SplicedRows:
    prefix = topic.rpartition("/")[0] + "/"
    name = prefix.strip("/")
    own = {number: channel for number, channel in found.channels.items() if channel.topic.startswith(prefix)}
    seconds = next((number for number, channel in own.items() if f"{COLUMN_KEY}t" in channel.metadata), None)
    about = next((pairs for pairs in found.metadata.values() if topic_name(pairs.get("robot", "")) == name), {})
    return SplicedRows(path, prefix, about.get("robot_hash", ""), rows_of(view, found, path, name), seconds)


def _own_name(name: str, content: Any, known: dict[str, Any]) -> str | None:
    """Return the name, with a number appended if different content already has this name; None if the content is
    already present."""
    stem, dot, ending = name.partition(".")
    number, own = 1, name
    while own in known:
        if known[own] == content:
            return None
        number += 1
        own = f"{stem}-{number}{dot}{ending}"
    known[own] = content
    return own


def _summary(sources: list[Source], operation: str) -> dict[str, Any]:
    """Return the summary of the new file: rows, dropped rows, and origins."""
    holes = [hole for source in sources for hole in _holes(source)]
    originals: dict[str, Any] = {}
    for source in sources:
        counted = summary_of(source.view, source.found)
        originals |= counted.get("originals") or {source.path.name: counted}
    return {
        "rows": sum(arm.rows_left for source in sources for arm in source.arms),
        "dropped": sum(hole[2] for hole in holes),
        "holes": holes,
        "source": [*(entry for source in sources for entry in source.chain), operation],
        "originals": originals,
    }


def _holes(source: Source) -> list[list[Any]]:
    """Return the gaps between selected rows: first and last tick, row count, new number of the first row, robot."""
    found = []
    for first, last, rows, *more in summary_of(source.view, source.found).get("holes", []):
        begin, robot = (more[0] if more else first), (more[1] if len(more) > 1 else None)
        for arm in source.arms:
            own = robot in (None, arm.name) and arm.rows_left
            if own and arm.ticks[0] < begin and begin + last - first < arm.ticks[1]:
                found.append([first, last, rows, arm.number(begin), arm.name])
                break
    return found


def cut(
    path: str | Path,
    to: str | Path,
    start: float = -np.inf,
    stop: float = np.inf,
    *,
    robot: str | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the segment start <= t < stop of a recording to a finished file, and return its path.

    ``log.read(cut(path, to, a, b)).sha256 == log.read(path).between(a, b).sha256``: `t` is not shifted, and no value
    is converted. Metadata, attachments and the events between the rows are kept. The parameter history is kept from the
    beginning, so all parameter values are known.

    Parameters
    ----------
    path : finished or unfinished recording; if it has several robots, each is cut on its own clock.
    to : the new file, with the extension .mcap; an existing file is replaced atomically.
    start, stop : times on the clock of the table [s].
    robot : select the rows and events of one robot; default: all robots.
    progress : called with (bytes done, total bytes, what).

    Raises
    ------
    LogError : the file is not an armlab recording or has no rows in the segment, or the output cannot be written.
    UnknownName : the robot is unknown.
    ConfigError : the extension is not .mcap, or stop <= start.
    """
    path, to = Path(path), recording_path(to)
    if not start < stop:
        raise ConfigError(f"Expected start < stop, got {start:g} s to {stop:g} s.")
    with opened_source(path) as source:
        if robot is not None:
            source.keep(robot)
        for arm in source.arms:
            arm.cut(start, stop)
        if not any(arm.rows_left for arm in source.arms):
            t = np.concatenate([arm.rows.t[arm.rows.kept] for arm in source.arms])
            has = f"rows from {t.min():g} s to {t.max():g} s" if len(t) else "no rows at all"
            raise LogError(f"Expected rows between {start:g} s and {stop:g} s in {path}, got none. It contains {has}.")
        _write(to, [source], f"between({start:g}, {stop:g})", progress)
    return to


def merge(paths: Sequence[str | Path], to: str | Path, *, progress: Progress | None = None) -> Path:
    """Merge several recordings into one, and return its path.

    Recordings of one robot are joined in wall-clock order; gaps between them remain, as in `concat`. Columns absent
    from a recording are filled with missing values in its rows. Recordings of robots that ran simultaneously, such as
    both arms of a bridge, are stored side by side: ``log.read(to, robot="yumi_left")``.

    Parameters
    ----------
    paths : two or more finished or unfinished recordings.
    to : the new file, with the extension .mcap; an existing file is replaced atomically.
    progress : called with (bytes done, total bytes, what).

    Raises
    ------
    LogError : a file is not an armlab recording, or the output cannot be written. Also raised if recordings of one
        robot overlap, or have different robot descriptions or incompatible columns with the same name. Also raised if
        the robots did not run simultaneously.
    ConfigError : fewer than two files are given, or the extension is not .mcap.
    """
    to = recording_path(to)
    if len(paths) < 2:
        raise ConfigError(f"Expected at least two recordings to merge, got {len(paths)}.")
    with contextlib.ExitStack() as stack:
        sources = [stack.enter_context(opened_source(Path(path))) for path in paths]
        sources.sort(key=lambda source: source.start_ns)
        arms: dict[str, list[SplicedRows]] = {}
        for source in sources:
            for arm in source.arms:
                arms.setdefault(arm.name, []).append(arm)
        for pieces_of_one in arms.values():
            _line_up(sorted(pieces_of_one, key=lambda arm: arm.start_ns))
        _check_together(arms)
        names = ", ".join(source.path.name for source in sources)
        _write(to, sources, f"concat({len(sources)} tables)" if len(arms) == 1 else f"merge({names})", progress)
    return to


def _line_up(arms: list[SplicedRows]) -> None:
    """Convert the recordings of one robot to the clock of the first recording, and number the rows consecutively."""
    first, before = arms[0], arms[0]
    for arm in arms[1:]:
        if arm.robot_hash != first.robot_hash:
            raise LogError(
                f"Expected recordings with the same description of {arm.name}, got a different one in {arm.path} than "
                f"in {first.path}: its hash is {arm.robot_hash[:12]}, not {first.robot_hash[:12]}."
            )
        arm.follow(first, before)
        before = arm if len(arm.rows.t) else before


def _check_together(arms: dict[str, list[SplicedRows]]) -> None:
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
            f"Expected robots that ran simultaneously, got {late}, which began "
            f"{(spans[late][0] - spans[early][1]) / 1e9:.3f} s after the end of {early}. Remove one."
        )


def _write(to: Path, sources: list[Source], operation: str, progress: Progress | None) -> None:
    part = to.with_name(f".{to.name}.part")
    with contextlib.suppress(OSError):
        part.unlink()
    with new_file(to, part, replace=True) as file:
        writer = McapWriter(file, sources[0].found.profile, sources[0].found.library)
        known: dict[str, Any] = {}
        for source in sources:
            for name, pairs in source.found.metadata.items():
                if (own := _own_name(name, pairs, known)) is not None:
                    writer.metadata(own, pairs)
        known = {}
        for source in sources:
            for one in source.found.attachments:
                data = bytes(source.view[slice(*one.data)])
                if one.name != _SUMMARY and (own := _own_name(one.name, data, known)) is not None:
                    writer.attach(one.log_ns, own, one.media_type, data)
        _register(writer, sources)
        lost = _copy(writer, sources, progress)
        data = json.dumps(_summary(sources, operation), indent=1).encode()
        writer.attach(max(source.end_ns for source in sources), _SUMMARY, "application/json", data)
        writer.finish()
    if lost:
        warnings.warn(f"{lost} corrupt chunks are missing from {to.name}", stacklevel=3)


def _register(writer: McapWriter, sources: list[Source]) -> None:
    """Write the channels of all sources, one per topic, and the channels of the column t."""
    known = {}
    for source in sources:
        for number, channel in source.found.channels.items():
            if any(number == arm.seconds for arm in source.arms):
                continue
            if channel.topic not in known:
                known[channel.topic] = (channel, copied_channel(writer, channel), source.path)
            first, source.numbers[number], where = known[channel.topic]
            if first != channel:
                raise LogError(
                    f"Expected the same type, units and joint names on {channel.topic} in all recordings, but "
                    f"{source.path} differs from {where}."
                )
        for arm in source.arms:  # column t is stored because its times may differ from the message times
            topic = column_topic("t")
            pairs = topic.metadata({"t": Slot(resolved(Column(), "t"), 0, 8, "<f8")})
            pairs |= clock_metadata(arm.t0_ns, arm.rows.clock)
            name = f"{arm.prefix}{topic.name}"
            channel = Channel(name, topic.type, definition(topic.type), "ros2msg", "cdr", pairs)
            if channel.topic not in known:
                known[channel.topic] = (channel, copied_channel(writer, channel), source.path)
            arm.seconds_number = known[channel.topic][1]


def _copy(writer: McapWriter, sources: list[Source], progress: Progress | None) -> int:
    """Copy the messages chunk by chunk in chronological order; return the number of corrupt chunks."""
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
    """Yield the chunks in chronological order, preserving the order within each file and for each robot."""
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
