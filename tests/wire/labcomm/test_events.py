"""Events are plain tuples that compare and print."""

from __future__ import annotations

from armlab.wire.labcomm import PRIMS
from armlab.wire.labcomm.types import Binding, Definition, Event, Other, Pragma, Sample, Unknown, Version


def test_events_compare_by_value() -> None:
    events: list[Event] = [
        Version("LabComm2014.v1"),
        Definition("sample", 0x40, "a", PRIMS["int"]),
        Binding(0x40, 0),
        Pragma("kind", b"x"),
        Other(6, b""),
        Sample(0x40, "a", 1, PRIMS["int"]),
        Unknown(0x41, b""),
    ]
    assert len(set(events)) == 7
    assert Sample(0x40, "a", 1, PRIMS["int"]) in events
    assert "'a'" in repr(events[5])
