"""The queue of the controller and the three ways to match a reply with its packet."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.sim.controller.inbox import QUEUE_LENGTH, ReplyQueue, Sent
from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.controller.statistics import Statistics
from armlab.wire.egm import Drop, EgmCodec, Reference, RobotSideCodec, SensorMessage

ROBOT = robots.load("yumi_right")
LATE = 2.0  # s, after the first second


def inbox(**changes: Any) -> tuple[ReplyQueue, Statistics]:
    statistics = Statistics()
    box = ReplyQueue(RobotSideCodec(ROBOT), statistics, ControllerSettings(**changes))
    return box, statistics


def send(box: ReplyQueue, count: int, same_tm: int = 1) -> None:
    for k in range(count):
        box.note(Sent(k, 10_000 + 4 * (k // same_tm), 100 + k, True))
        box.stamp(10**9 + 4_000_000 * k, LATE)


def matched(box: ReplyQueue, message: SensorMessage, arrival_ns: int = 0) -> int | None:
    sent = box.match(message, arrival_ns, LATE)
    return sent and sent.seq


def test_the_echo_of_the_extension_decides() -> None:
    box, statistics = inbox()
    send(box, 5)
    assert matched(box, SensorMessage(7, 10_000, 3, echo_mono_ns=1, echo_seq=3), 10**9 + 12_100_000) == 3
    assert matched(box, SensorMessage(8, 10_000, 3, echo_mono_ns=1, echo_seq=99)) is None
    assert statistics.counts["matched by echo"] == 1
    assert statistics.as_dict()["round_trip_us"]["p50"] == pytest.approx(100.0)


def test_packets_of_one_millisecond_share_their_tm_and_are_told_apart() -> None:
    """A period of 0.25 ms: each reply means the oldest packet with that tm which nobody has answered."""
    box, _ = inbox(period=0.00025)
    send(box, 8, same_tm=4)
    assert [matched(box, SensorMessage(k, 10_000, 3)) for k in range(5)] == [0, 1, 2, 3, 3]
    assert matched(box, SensorMessage(9, 10_004, 3)) == 4


def test_a_packet_that_was_built_but_has_not_left_is_not_answered() -> None:
    """Replies are read just before the next packet leaves; the round trip is that of the one before."""
    box, statistics = inbox()
    send(box, 1)
    box.note(Sent(1, 10_004, 101, True))
    assert matched(box, SensorMessage(1, None, 3), 10**9 + 150_000) == 0
    assert statistics.as_dict()["round_trip_us"]["p50"] == pytest.approx(150.0)


@pytest.mark.parametrize("tm", [None, 0])
def test_by_order_where_nothing_is_echoed(tm: int | None) -> None:
    box, statistics = inbox()
    send(box, 3)  # the peer was not there for the first packets
    assert matched(box, SensorMessage(1, tm, 3)) == 2
    box.note(Sent(3, 10_012, 103, True))
    assert matched(box, SensorMessage(3, tm, 3)) == 3
    assert statistics.counts["matched by order"] == 2


def test_duplicates_count_and_do_not_measure() -> None:
    box, statistics = inbox()
    send(box, 2)
    for _ in range(3):
        assert matched(box, SensorMessage(5, 10_004, 3), 10**9 + 4_050_000) == 1
    assert statistics.counts["duplicates"] == 2
    assert statistics.counts["matched by tm"] == 1


def test_a_packet_without_a_reply_within_its_period_is_missed() -> None:
    box, statistics = inbox()
    for k in range(4):
        box.note(Sent(k, 10_000 + 4 * k, k, guiding=k != 2))
        box.stamp(10**9 + 4_000_000 * k, LATE)
        if k == 0:
            matched(box, SensorMessage(0, 10_000, 3), 10**9 + 200_000)
    assert statistics.counts["missed"] == 1, "packet 0 was answered, 2 did not guide, 3 has time left"


def test_first_in_first_out_of_64_with_ages() -> None:
    box, statistics = inbox()
    assert QUEUE_LENGTH == 64
    assert all(box.put(SensorMessage(k, None, 3), k) for k in range(QUEUE_LENGTH))
    assert not box.put(SensorMessage(99, None, 3), None)
    assert len(box) == QUEUE_LENGTH
    taken = [box.take(10) for _ in range(3)]
    assert [message and message.seqno for message in taken] == [0, 1, 2]
    assert dict(statistics.age) == {10: 1, 9: 1, 8: 1}
    assert statistics.last_age == 8
    assert statistics.queue[QUEUE_LENGTH] == 1
    box.begin()
    assert box.take(11) is None


@pytest.mark.parametrize(("mode", "reason"), [("joint", None), ("pose", "no pose"), ("path", "no path correction")])
def test_messages_must_hold_what_the_mode_needs(mode: str, reason: str | None) -> None:
    box, statistics = inbox(mode=mode)
    found = box.read(EgmCodec(ROBOT).encode(Reference(np.zeros(7), None, None, 0, 0)))
    assert isinstance(found, Drop if reason else SensorMessage)
    assert reason is None or (isinstance(found, Drop) and found.reason == reason)
    assert dict(statistics.mtypes) == {3: 1}


def test_a_queue_that_is_never_empty_is_reported_after_a_second() -> None:
    """A client that was stalled for 44 cycles and answered all packets then lags by 44 cycles from then on."""
    box, _ = inbox()
    sentences = []
    for cycle in range(600):
        for _ in range(45 if cycle == 0 else 1):
            box.put(SensorMessage(cycle, None, 3), None)
        box.take(cycle)
        sentences.append(box.standing())
    assert [cycle for cycle, text in enumerate(sentences) if text] == [248]
    assert "44 messages have waited" in sentences[248]
    assert "177 ms late" in sentences[248]
    box.begin()
    assert not any(box.standing() for _ in range(600)), "a new session has an empty queue"


def test_the_newest_message_replaces_all_that_wait() -> None:
    box, statistics = inbox(queue="newest")
    for number in range(5):
        box.put(SensorMessage(number, None, 3), number)
    message = box.take(5)
    assert message is not None
    assert message.seqno == 4
    assert len(box) == 0
    assert box.take(6) is None
    assert statistics.counts["overtaken"] == 4
    assert statistics.age == {1: 1}
