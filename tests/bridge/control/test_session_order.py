"""Which packets count, by number and tm, and which begin a session of `Session`."""

from __future__ import annotations

from typing import Any

import pytest

PERIOD_NS = 4_000_000


@pytest.mark.parametrize(
    ("seqno", "reason"),
    [(7, "duplicate"), (6, "old"), ((7 - 2**31 + 1) % 2**32, "old"), (7 + 2**31, "old"), (7 + 2**30, "old")],
)
def test_duplicates_and_old_packets_are_dropped(feed: Any, seqno: int, reason: str) -> None:
    feed(seqno=7)
    assert feed(seqno=seqno) is None
    assert feed.session.drops == {reason: 1}
    assert feed.sample(seqno=8).missed == 0


@pytest.mark.parametrize(("ahead", "counts"), [(2**16, True), (2**16 + 1, False)])
def test_how_many_packets_may_be_lost(feed: Any, ahead: int, counts: bool) -> None:
    feed(seqno=7)
    sample = feed(seqno=7 + ahead)
    assert (sample is not None) == counts
    assert feed.session.missed == (ahead - 1 if counts else 0)


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
    assert feed.session.received == 6
    assert feed.warnings == ["Session 1 ended: the controller stopped sending."]


def test_a_late_duplicate_of_the_first_packet_is_none(feed: Any) -> None:
    feed(seqno=0, tm_ms=77)
    feed()
    assert feed(seqno=0, tm_ms=77) is None
    assert feed.session.drops == {"duplicate": 1}
    assert feed.session.number == 1


def test_without_a_tm_the_number_tells(feed: Any) -> None:
    """Number 0 twice in a row is a duplicate, after another number a session; numbers that go on begin one too."""
    for seqno in (0, 1):
        feed(seqno=seqno, tm_ms=None)
    assert feed.sample(seqno=0, tm_ms=None).session == 2
    assert feed(seqno=0, tm_ms=None) is None
    feed(seqno=50, tm_ms=None)
    found = [feed(seqno=7 + k, tm_ms=None, after=3 * PERIOD_NS) for k in range(3)]
    assert (found[:2], found[2].session) == ([None, None], 3)


def test_a_tm_half_a_turn_ahead_is_one_of_the_past(feed: Any) -> None:
    feed(seqno=5, tm_ms=0)
    assert feed(seqno=6, tm_ms=2**31) is None
    assert feed.sample(seqno=6, tm_ms=2**31 - 1).missed == 0


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


def test_the_first_packets_of_eight_sessions_are_remembered(feed: Any) -> None:
    for k in range(1, 11):
        assert feed.sample(seqno=0, tm_ms=1000 * k).session == k
    feed(seqno=1, tm_ms=10_004)
    assert feed(seqno=0, tm_ms=2000) is None
    assert feed.sample(seqno=0, tm_ms=1000).session == 11


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


def test_the_third_packet_that_goes_on_begins_a_session(feed: Any) -> None:
    for k in range(50):
        feed(seqno=k, tm_ms=60_000 + 4 * k)
    found = [feed(seqno=1 + k, tm_ms=200 + 4 * k, after=3 * PERIOD_NS) for k in range(3)]
    assert found[:2] == [None, None]
    assert found[2].session == 2


@pytest.mark.parametrize(("step", "begins"), [(0, False), (-4, False), (1, True), (2**31 - 1, True), (2**31, False)])
def test_packets_go_on_from_each_other_by_number_and_tm(feed: Any, step: int, begins: bool) -> None:
    for k in range(50):
        feed(seqno=k, tm_ms=60_000 + 4 * k)
    tm = 2**32 - 2 if step == 1 else 100
    found = [feed(seqno=1 + k, tm_ms=(tm + k * step) % 2**32, after=3 * PERIOD_NS) for k in range(3)]
    assert (found[2] is not None) == begins


def test_packets_that_were_delayed_together_begin_no_session(feed: Any) -> None:
    """Three within less than a period are none yet."""
    for k in range(50):
        feed(seqno=k, tm_ms=60_000 + 4 * k)
    found = [feed(seqno=1 + k, tm_ms=200 + 4 * k, after=8 * PERIOD_NS if k == 0 else 1_500_000) for k in range(4)]
    assert found[:3] == [None] * 3
    assert found[3].session == 2


def test_packets_out_of_order_between_others_do_not_add_up(feed: Any) -> None:
    for k in range(50):
        feed(seqno=k, tm_ms=60_000 + 4 * k)
    assert [feed(seqno=1 + k, tm_ms=60_004 + 4 * k) for k in range(2)] == [None, None]
    feed(seqno=50, tm_ms=60_200)
    assert feed(seqno=3, tm_ms=60_012, after=8 * PERIOD_NS) is None


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


def test_tm_wraps(feed: Any) -> None:
    feed(seqno=5, tm_ms=2**32 - 2)
    assert feed.sample(seqno=6, tm_ms=2).missed == 0


def test_a_first_packet_that_was_overtaken_begins_no_session(feed: Any) -> None:
    assert feed(seqno=1, tm_ms=10_004) is not None
    assert feed(seqno=0, tm_ms=10_000) is None
    assert feed(seqno=2, tm_ms=10_008) is not None
    for before in (1, 99):
        assert feed(seqno=0, tm_ms=10_004 - before) is None
    assert feed.session.number == 1
    assert feed(seqno=0, tm_ms=500) is not None
    assert feed.session.number == 2


def test_a_first_packet_that_is_older_by_a_tenth_of_a_second_begins_one(feed: Any) -> None:
    feed(seqno=1, tm_ms=10_004)
    assert feed.sample(seqno=0, tm_ms=10_004 - 100).session == 2
