"""Sequence numbers, sources, begin and end of sessions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.bridge.session import EGM_ERROR, Sample, Session
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec

SILENCE = 600_000_000  # ns
PERIOD_NS = 4_000_000


def test_the_first_packet_of_all_begins_a_session(feed: Any) -> None:
    sample = feed(seqno=500)
    assert isinstance(sample, Sample)
    assert (sample.session, sample.fresh, sample.missed, sample.dt) == (1, True, 0, 0.004)
    assert (feed.session.active, feed.session.source) == (True, ("127.0.0.1", 5000))
    assert "RobotWare 6.10, 7 joints" in feed.events[0]


def test_lost_packets_are_counted_and_dt_grows(feed: Any) -> None:
    feed()
    feed.packets()
    feed.packets()
    sample = feed.sample()
    assert (sample.missed, feed.session.missed) == (2, 2)
    assert sample.dt == pytest.approx(0.012)
    assert feed.session.period.seconds == pytest.approx(0.004)


@pytest.mark.parametrize(
    ("seqno", "reason"),
    [(7, "duplicate"), (6, "old"), ((7 - 2**31 + 1) % 2**32, "old"), (7 + 2**31, "old"), (7 + 2**30, "old")],
)
def test_duplicates_and_old_packets_are_dropped(feed: Any, seqno: int, reason: str) -> None:
    feed(seqno=7)
    assert feed(seqno=seqno) is None
    assert feed.session.drops == {reason: 1}
    assert feed.sample(seqno=8).missed == 0


def test_numbers_wrap(feed: Any) -> None:
    feed(seqno=2**32 - 1)
    sample = feed.sample(seqno=0)
    assert (sample.session, sample.missed) == (1, 0)
    assert feed.sample(seqno=3).missed == 2


def test_number_zero_is_a_new_session(feed: Any) -> None:
    for _ in range(5):
        feed()
    feed.session.replied(feed.now)
    sample = feed.sample(seqno=0)
    assert (sample.session, sample.fresh, sample.dt, feed.session.seq) == (2, True, 0.004, 0)


def test_a_late_duplicate_of_the_first_packet_is_none(feed: Any) -> None:
    feed(seqno=0, tm_ms=77)
    feed()
    assert feed(seqno=0, tm_ms=77) is None
    assert feed.session.drops == {"duplicate": 1}
    assert feed.session.number == 1


@pytest.mark.parametrize("seqno", [3, 40])
def test_a_late_packet_of_the_session_before_is_old(feed: Any, seqno: int) -> None:
    """Its number may be ahead of ours: only its tm tells."""
    feed(seqno=0, tm_ms=1000)
    feed(seqno=0, tm_ms=3000)
    feed(seqno=1, tm_ms=3004)
    assert feed(seqno=seqno, tm_ms=2000) is None
    assert feed.session.drops == {"old": 1}
    assert feed.sample(seqno=2, tm_ms=3008).missed == 0
    assert feed.session.number == 2


def test_the_first_packet_of_the_session_before_is_old(feed: Any) -> None:
    feed(seqno=0, tm_ms=1000)
    feed(seqno=0, tm_ms=3000)
    feed(seqno=1, tm_ms=3004)
    assert feed(seqno=0, tm_ms=1000) is None
    assert feed.session.drops == {"old": 1}
    assert feed.session.number == 2


@pytest.mark.parametrize("tm", [12, 50_000, 2**32 - 9])
def test_number_zero_with_a_clock_that_went_back_is_a_robot_that_restarted(feed: Any, tm: int) -> None:
    """Without waiting for half a second of silence, in which the controller would time out."""
    for k in range(5):
        feed(seqno=k, tm_ms=60_000 + 4 * k)
    sample = feed.sample(seqno=0, tm_ms=tm)
    assert (sample.session, sample.fresh, feed.session.seq) == (2, True, 0)
    assert feed.sample(seqno=1, tm_ms=(tm + 4) % 2**32).missed == 0
    assert not feed.session.drops


@pytest.mark.parametrize(("seqno", "tm"), [(1, 200), (1, 60_050), (70, 200)])
def test_a_session_whose_first_packet_was_lost_begins_after_five_periods(feed: Any, seqno: int, tm: int) -> None:
    """Number or clock went back, and the packets go on from each other while nothing else comes."""
    for k in range(50):
        feed(seqno=k, tm_ms=60_000 + 4 * k)
    found = [feed(seqno=seqno + k, tm_ms=tm + 4 * k) for k in range(7)]
    assert found[:5] == [None] * 5
    assert found[5].fresh
    assert (found[6].missed, found[6].session) == (0, 2)
    assert feed.session.drops == {"old": 5}


def test_old_packets_in_a_row_do_not_take_over_from_a_session_that_goes_on(feed: Any) -> None:
    """A stall that delayed many packets behind newer ones; and single packets after a pause."""
    for k in range(50):
        feed(seqno=k, tm_ms=60_000 + 4 * k)
    for k in range(20):
        assert feed(seqno=k, tm_ms=60_000 + 4 * k, after=1000) is None
    assert feed.sample(seqno=50, tm_ms=60_200).session == 1
    assert feed(seqno=1, tm_ms=60_004, after=8 * PERIOD_NS) is None
    for k in range(2, 20):
        assert feed(seqno=k, tm_ms=60_000 + 4 * k, after=1000) is None
    for k in (7, 3, 9, 11):
        assert feed(seqno=k, tm_ms=60_000 + 4 * k, after=12 * PERIOD_NS) is None
    assert feed.sample(seqno=51, tm_ms=60_204).session == 1


def test_replies_to_another_port_that_took_over_begin_at_zero(feed: Any) -> None:
    """Each session has its own sequence of replies; what still comes from the old port is foreign."""
    for _ in range(5):
        feed()
        feed.session.replied(feed.now)
    assert feed.session.seq == 5
    sample = feed(port=5001, after=6 * PERIOD_NS, seqno=0, tm_ms=4)
    assert sample is not None
    assert (sample.session, feed.session.seq) == (2, 0)
    assert feed(port=5001, seqno=0, tm_ms=4) is None
    feed.session.replied(feed.now)
    assert feed(port=5000, seqno=5, tm_ms=10_020) is None
    assert feed(port=5000, seqno=0, tm_ms=90_000) is None
    assert feed.sample(port=5001, seqno=1, tm_ms=8).missed == 0
    assert feed.session.seq == 1
    assert feed.session.drops == {"duplicate": 1, "foreign source": 2}


def test_tm_wraps(feed: Any) -> None:
    feed(seqno=5, tm_ms=2**32 - 2)
    assert feed.sample(seqno=6, tm_ms=2).missed == 0


def test_silence_begins_a_new_session(feed: Any) -> None:
    feed(seqno=10)
    sample = feed.sample(seqno=11, after=SILENCE)
    assert sample.session == 2
    assert feed.session.reason == "the controller stopped sending"


def test_a_robot_in_lockstep_may_be_silent(robot: Robot) -> None:
    from armlab.bridge.port import Arrival
    from armlab.wire.egm import RobotMessage, RobotSideCodec

    session, side = Session(EgmCodec(robot), timeout=float("inf")), RobotSideCodec(robot)
    for k in range(2):
        data = side.encode_robot(RobotMessage(k, k, robot.q_home))
        sample = session.accept(Arrival(data, ("127.0.0.1", 1), k * 10**12))
    assert sample is not None
    assert sample.session == 1
    assert not session.silent(10**15)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"converged": True, "motors": 2}, "convergence"),
        ({"motors": 2, "rapid": 1}, "motors"),
        ({"rapid": 1, "mci": 1}, "RAPID was stopped"),
        ({"mci": 1}, EGM_ERROR),
        ({"mci": 2}, "stopped sending"),
    ],
)
def test_why_a_session_ended(feed: Any, fields: dict[str, int], words: str) -> None:
    feed()
    feed(**fields)
    assert feed.session.silent(feed.now + SILENCE)
    assert words in feed.session.end()
    assert not feed.session.active


def test_our_own_silence_is_named(feed: Any) -> None:
    for _ in range(60):
        feed()
    assert "41822" in feed.session.end()
    feed(seqno=0)
    for _ in range(60):
        feed()
        feed.session.replied(feed.now)
    assert "stopped sending" in feed.session.end()


def test_other_senders_are_foreign(feed: Any) -> None:
    feed()
    assert feed(port=5001) is None
    assert feed.raw(b"noise", host="10.0.0.9") is None
    assert feed.session.drops == {"foreign source": 2}
    assert feed.session.source == ("127.0.0.1", 5000)


def test_rapid_restarts_fast_from_another_port(feed: Any) -> None:
    feed()
    assert feed(port=5001, seqno=0, after=16_000_000) is None
    sample = feed.sample(port=5001, seqno=0, after=10_000_000)
    assert sample.session == 2
    assert feed.session.source == ("127.0.0.1", 5001)


def test_another_port_without_number_zero_stays_foreign(feed: Any) -> None:
    feed()
    assert feed(port=5001, seqno=9, after=30_000_000) is None
    assert feed.session.drops == {"foreign source": 1}


def test_a_session_that_ended_takes_any_sender(feed: Any) -> None:
    feed()
    feed.session.end()
    assert feed.sample(port=6000, seqno=40).session == 2


def test_each_kind_of_drop_is_told_once_per_session(feed: Any) -> None:
    feed()
    begun = len(feed.events)
    for _ in range(3):
        feed.raw(b"\xff\xfe")
        feed.raw(b"")
    assert feed.session.drops == {"unparsable": 3, "no header": 3}
    assert feed.session.total_drops == 6
    assert len(feed.events) == begun + 2
    assert "ff fe" in feed.events[begun]
    feed(seqno=0)
    feed.raw(b"\xff")
    assert "unparsable" in feed.events[-1]


def test_garbage_begins_no_session(feed: Any) -> None:
    for data in (b"", b"\x0a", b"\xff" * 100):
        assert feed.raw(data) is None
    assert not feed.session.active
    assert feed.session.received == 0


def test_velocity_from_differences_is_filtered_and_converges(feed: Any) -> None:
    speed = 0.5
    q = feed.packets.q
    for k in range(200):
        sample = feed.sample(q=q + speed * 0.004 * k)
        if k == 0:
            assert not sample.qd.any()
    np.testing.assert_allclose(sample.qd, speed, rtol=1e-6)
    assert sample.qd_source == "difference"


def test_the_flavour_is_decided_anew_in_each_session(robot: Robot, feed: Any) -> None:
    feed()
    from armlab.wire.egm import RobotSideCodec

    feed.packets.codec = RobotSideCodec(robot, "6.06")
    sample = feed.sample(seqno=0)
    assert sample.packet.robotware == "6.06"
    np.testing.assert_allclose(sample.packet.q, robot.q_home)


def test_a_first_packet_that_was_overtaken_begins_no_session(feed: Any) -> None:
    assert feed(seqno=1, tm_ms=10_004) is not None
    assert feed(seqno=0, tm_ms=10_000) is None
    assert feed(seqno=2, tm_ms=10_008) is not None
    assert feed.session.number == 1
    assert feed(seqno=0, tm_ms=500) is not None
    assert feed.session.number == 2
