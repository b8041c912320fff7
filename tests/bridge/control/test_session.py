"""Sources, begin and end of sessions; the order of packets is in test_session_order.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.bridge.control.session import EGM_ERROR, Sample, Session
from armlab.bridge.net.sockets import Arrival
from armlab.robots import Robot
from armlab.wire.egm import Drop, EgmCodec, Packet, RobotMessage, RobotSideCodec

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
    sample = feed.sample(after=3 * PERIOD_NS)
    assert (sample.missed, feed.session.missed) == (2, 2)
    assert sample.dt == pytest.approx(0.012)
    assert feed.session.period.seconds == pytest.approx(0.004)
    feed.packets()
    assert feed.sample(after=2 * PERIOD_NS).missed == 1
    assert feed.session.missed == 3


def test_the_period_is_measured(feed: Any) -> None:
    for _ in range(20):
        feed(after=2 * PERIOD_NS)
        feed.packets.cycle += 1
    assert feed.session.period.seconds == pytest.approx(0.008)
    assert not feed.warnings
    feed(after=2 * PERIOD_NS)
    for _ in range(20):
        feed()
    assert feed.session.period.seconds == pytest.approx(0.004)
    assert feed.warnings == ["The cycle time of the robot changed from 8.00 to 4.00 ms."]


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


def test_silence_begins_a_new_session(feed: Any) -> None:
    feed(seqno=10)
    sample = feed.sample(seqno=11, after=SILENCE)
    assert sample.session == 2
    assert feed.session.reason == "the controller stopped sending"


def test_a_session_ends_once_after_half_a_second(feed: Any) -> None:
    assert feed.session.end() == ""
    assert feed.session.period.seconds == 0.004
    feed()
    assert not feed.session.silent(feed.now + 499_999_999)
    assert feed.session.silent(feed.now + 500_000_000)
    for _ in range(2):
        assert feed.session.end() == "the controller stopped sending"
        assert feed.warnings == ["Session 1 ended: the controller stopped sending."]
    assert len(feed.events) == 2
    assert not feed.session.silent(feed.now + 10**12)


def test_a_robot_in_lockstep_may_be_silent(robot: Robot) -> None:
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
    assert "did not answer for 0.24 s (event 41822" in feed.session.end()
    feed(seqno=0)
    for _ in range(60):
        feed()
        feed.session.replied(feed.now)
    assert "stopped sending" in feed.session.end()


def test_our_own_silence_is_longer_than_150_ms(feed: Any) -> None:
    feed()
    feed(after=150_000_000)
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
    assert feed.warnings == feed.events[begun:]
    feed.session.end()
    feed()
    feed.raw(bytes([255] * 40))
    assert feed.events[-1].endswith(" It begins " + " ".join(["ff"] * 32) + "."), "not more than 32 bytes of it"
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
        assert not sample.qd.flags.writeable
        if k == 1:
            np.testing.assert_allclose(sample.qd, speed * (1.0 - np.exp(-2.0 * np.pi * 30.0 * 0.004)))
    np.testing.assert_allclose(sample.qd, speed, rtol=1e-6)
    assert sample.qd_source == "difference"


def test_velocity_that_was_measured_is_taken(robot: Robot, feed: Any) -> None:
    feed.packets.codec = RobotSideCodec(robot, extension=True)
    sample = feed.sample(qd=np.arange(7.0))
    np.testing.assert_allclose(sample.qd, np.arange(7.0), atol=1e-12)
    assert sample.qd_source == "measured"


class Forgetful(EgmCodec):
    """Refuses the first packet after each reset."""

    def reset(self) -> None:
        super().reset()
        self.is_new = True

    def decode(self, data: bytes) -> Packet | Drop:
        is_new, self.is_new = self.is_new, False
        return Drop("stale", "of the flavour before") if is_new else super().decode(data)


def test_a_packet_refused_by_the_codec_of_its_new_session_begins_none(robot: Robot) -> None:
    codec, side = Forgetful(robot), RobotSideCodec(robot)
    codec.is_new = False
    session = Session(codec)
    assert session.accept(Arrival(side.encode_robot(RobotMessage(0, 0, robot.q_home)), ("127.0.0.1", 1), 0)) is None
    assert (session.number, session.active, session.drops) == (0, False, {"stale": 1})


def test_the_flavour_is_decided_anew_in_each_session(robot: Robot, feed: Any) -> None:
    feed()
    feed.packets.codec = RobotSideCodec(robot, "6.06")
    sample = feed.sample(seqno=0)
    assert sample.packet.robotware == "6.06"
    np.testing.assert_allclose(sample.packet.q, robot.q_home)
