"""Events go out once, drops once per kind and session."""

from __future__ import annotations

from armlab.sim.controller.statistics import ControllerEvent, EventLog, Statistics
from armlab.wire.egm import Drop


def test_drops_are_told_once_per_kind_and_session() -> None:
    statistics, heard = Statistics(), list[ControllerEvent]()
    journal = EventLog("yumi_left", statistics, heard.append)
    for session in range(2):
        for _ in range(3):
            journal.drop(1.0 + session, Drop("no header", "4 bytes"), b"\1\2\3\4")
        journal.drop(1.0, Drop("old", "late"), b"")
        journal.begin()
    assert statistics.drops == {"no header": 6, "old": 2}
    assert [str(event) for event in heard[:1]] == [
        "1.000 s yumi_left - dropped a datagram, no header: 4 bytes; first bytes 01 02 03 04"
    ]
    assert len(heard) == len(statistics.events) == 4


def test_events_are_kept_without_a_listener() -> None:
    statistics = Statistics()
    EventLog("yumi_left", statistics, None).tell(0.5, 41822, "No data")
    assert list(statistics.events) == [ControllerEvent(0.5, "yumi_left", 41822, "No data")]
