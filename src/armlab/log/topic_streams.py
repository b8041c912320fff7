"""What one topic of another program's log becomes: streams of columns, each with stamps of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab.log.column import Column
from armlab.log.mcap_decode import Decoded
from armlab.log.topic_fields import JOINTS, TopicFields, columns_of_fields

__all__ = ["Stream", "rate_text", "stem", "streams_of"]

_NAMELESS = ("data", "value")  # fields of std_msgs; the only field of another type may say what it is
_WALL = 10**18  # ns, 2001: later stamps are those of a wall clock
_PAIR = re.compile(r"^(?P<list>[^\[]*)\[(?P<parent>[^\]>]*)>(?P<child>[^\]]*)\]\.transform$")


@dataclass(frozen=True, slots=True)
class Stream:
    """Columns whose values came together.

    Attributes
    ----------
    topic : where they came. type : of its messages.
    log_ns : (N,) when each message was recorded. stamp_ns : (N,) when it was made, by its header; None without.
    values, columns : by name; those of a JointState are q, qd and tau.
    """

    topic: str
    type: str
    log_ns: np.ndarray
    stamp_ns: np.ndarray | None
    values: Mapping[str, np.ndarray]
    columns: Mapping[str, Column]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints of a JointState; empty for others."""
        return next((one.labels for one in self.columns.values()), ()) if self.type == JOINTS else ()

    @property
    def rate(self) -> float:
        """Messages per second [Hz]; 0 for fewer than two."""
        stamps = self.log_ns if self.stamp_ns is None else self.stamp_ns
        length = (int(stamps.max()) - int(stamps.min())) / 1e9 if len(stamps) > 1 else 0.0
        return (len(stamps) - 1) / length if length > 0 else 0.0

    def rows(self, which: np.ndarray) -> Stream:
        """Return some of its rows, by mask or index."""
        stamps = None if self.stamp_ns is None else self.stamp_ns[which]
        values = {name: array[which] for name, array in self.values.items()}
        return replace(self, log_ns=self.log_ns[which], stamp_ns=stamps, values=values)

    def ordered(self, joints: Sequence[str]) -> Stream:
        """Return the JointState with these of its joints in this order."""
        places = [self.joints.index(name) for name in joints]
        values = {name: array[:, places] for name, array in self.values.items()}
        columns = {name: replace(column, labels=tuple(joints)) for name, column in self.columns.items()}
        return replace(self, values=values, columns=columns)


def stem(topic: str) -> str:
    """Return the name of a topic in front of the names of columns: "/ft/wrench" is "ft.wrench"."""
    return topic.strip("/").replace("/", ".")


def rate_text(streams: Sequence[Stream]) -> str:
    """Return topics with their rates, fastest first, for an error."""
    lines = {}
    for one in sorted(streams, key=lambda one: -one.rate):
        rate = f"{one.rate:.4g} Hz" if one.rate else f"{len(one.log_ns)} message"
        frames = f" ({', '.join(list(one.values)[:2])})" if one.type == "tf2_msgs/msg/TFMessage" else ""
        lines[f"{one.topic}{frames} {rate}"] = None
    return ", ".join(lines)


def streams_of(topic: str, fields: TopicFields, decoded: Decoded) -> tuple[list[Stream], list[str]]:
    """Return the streams of a topic, and what was wrong with some values.

    Most topics are one stream. Transforms of one topic are one per publisher, as are joints that never come together.
    """
    values, columns, notes = columns_of_fields(fields, decoded.fields)
    notes = [f"{topic}: {note}" for note in notes]
    if not values:
        return [], notes
    stamps = _stamps(decoded.fields, "header")
    whole = Stream(topic, fields.type, decoded.log_ns, stamps, values, columns)
    order = np.argsort(decoded.log_ns, kind="stable")
    if not np.array_equal(order, np.arange(len(order))):
        whole = whole.rows(order)
    if fields.type == JOINTS:
        return _by_joints(whole, list(fields.joints.get("", ()))), notes
    if any(_PAIR.match(name) for name in values):
        return _by_frames(whole, decoded.fields, order), notes
    if len(values) == 1 and (columns[next(iter(values))].unit != "1" or next(iter(values)) in _NAMELESS):
        values, columns = {stem(topic): whole.values[n] for n in values}, {stem(topic): columns[n] for n in values}
        return [replace(whole, values=values, columns=columns)], notes
    named = {name: f"{stem(topic)}.{name}" for name in values}
    values = {own: whole.values[name] for name, own in named.items()}
    return [replace(whole, values=values, columns={own: columns[name] for name, own in named.items()})], notes


def _stamps(fields: Mapping[str, np.ndarray], header: str) -> np.ndarray | None:
    """Return the stamps (N,) [ns] of a header; None without, or where some are not set."""
    seconds, rest = fields.get(f"{header}.stamp.sec"), fields.get(f"{header}.stamp.nanosec")
    if seconds is None or rest is None or not np.isfinite(seconds).all() or not np.isfinite(rest).all():
        return None
    stamps = seconds[:, 0].astype(np.int64) * 10**9 + rest[:, 0].astype(np.int64)
    if not stamps.any() or (stamps[1:] <= 0).any():
        return None
    return stamps if stamps[0] > 0 or stamps.max() < _WALL else None  # simulated time begins with 0


def _by_joints(whole: Stream, lists: Sequence[tuple[str, ...]]) -> list[Stream]:
    """Return a stream per set of joints that come together: an arm and its gripper may share a topic."""
    groups: list[set[str]] = []
    for names in lists:
        meeting = [group for group in groups if group & set(names)]
        groups = [group for group in groups if group not in meeting] + [set(names).union(*meeting)]
    if len(groups) < 2:
        return [whole]
    streams = []
    for group in sorted(groups, key=len, reverse=True):
        part = whole.ordered([name for name in whole.joints if name in group])
        there = np.any([np.isfinite(array).any(axis=1) for array in part.values.values()], axis=0)
        streams.append(_without_empty(part.rows(there)))
    return streams


def _without_empty(stream: Stream) -> Stream:
    kept = {name: array for name, array in stream.values.items() if np.isfinite(array).any()}
    return replace(stream, values=kept, columns={name: stream.columns[name] for name in kept})


def _by_frames(whole: Stream, fields: Mapping[str, np.ndarray], order: np.ndarray) -> list[Stream]:
    """Return a stream per set of transforms that come together."""
    groups: dict[bytes, list[str]] = {}
    for name, array in whole.values.items():
        if _PAIR.match(name):
            there = np.isfinite(array).reshape(len(array), -1).all(axis=1)
            groups.setdefault(np.packbits(there).tobytes(), []).append(name)
    streams = []
    for names in sorted(groups.values(), key=len, reverse=True):
        first = whole.values[names[0]]
        there = np.isfinite(first).reshape(len(first), -1).all(axis=1)
        header = names[0].removesuffix(".transform") + ".header"
        stamps = _stamps({key: a[order][there] for key, a in fields.items() if key.startswith(header)}, header)
        values, columns = {}, {}
        for name in names:
            found = _PAIR.match(name)
            parent, child = (found[key].strip("/") for key in ("parent", "child")) if found else ("", "")
            values[f"{stem(whole.topic)}.{parent}.{child}"] = whole.values[name][there]
            columns[f"{stem(whole.topic)}.{parent}.{child}"] = replace(whole.columns[name], frame=parent)
        streams.append(Stream(whole.topic, whole.type, whole.log_ns[there], stamps, values, columns))
    return streams
