"""What a client hears of, by its level."""

from __future__ import annotations

import json

from armlab.bridge.servers.rosbridge.session import Outbox, Session, Setting, Subscription


def heard(session: Session) -> list[dict[str, object]]:
    return [json.loads(one) for one in session.outbox.take(10**6)]


def test_errors_by_default_and_the_rest_as_asked() -> None:
    session = Session("me", may_ask=True)

    def levels() -> list[object]:
        for level in ("info", "warning", "error"):
            session.status(level, "text", 0)
        return [one["level"] for one in heard(session)]

    assert levels() == ["error"]
    session.level = "info"
    assert levels() == ["info", "warning", "error"]
    session.level = "none"
    assert levels() == []


def test_ids_come_back_when_there_were_any() -> None:
    session = Session("me", may_ask=True)
    session.status("error", "why", 0, "7")
    session.response("/s", None, {"a": 1}, True, 0)
    session.response("/s", 8, "why", False, 0)
    assert heard(session) == [
        {"op": "status", "id": "7", "level": "error", "msg": "why"},
        {"op": "service_response", "service": "/s", "values": {"a": 1}, "result": True},
        {"op": "service_response", "id": 8, "service": "/s", "values": "why", "result": False},
    ]


def test_settings_that_wait_are_told_apart_by_their_call() -> None:
    assert Setting("/s", "a", "gain", 1.0, 5) != Setting("/s", "b", "gain", 1.0, 5)


MS = 1_000_000


def played(subscription: Subscription, outbox: Outbox, count: int) -> list[tuple[int, int]]:
    """Offer a message every 4 ms; return the time [ms] and the number of those that were sent."""
    found = []
    for k in range(count):
        now = 4 * k * MS
        if subscription.is_due(now):
            subscription.offer(b"%d" % k, now)
        found += [(4 * k, int(one)) for one in outbox.take(1000)]
    return found


def made(throttle_ms: float, queue_length: int) -> tuple[Subscription, Outbox]:
    outbox = Outbox()
    subscription = Subscription("/a", outbox, "ros2")
    subscription.add("", throttle_ms, queue_length)
    return subscription, outbox


def test_everything_without_a_throttle() -> None:
    assert played(*made(0.0, 0), 5) == [(4 * k, k) for k in range(5)]


def test_a_throttle_is_the_least_time_between_two_and_the_newest_is_sent() -> None:
    assert played(*made(10.0, 0), 10) == [(0, 0), (12, 3), (24, 6), (36, 9)]


def test_a_queue_keeps_what_came_too_early_and_drops_the_oldest() -> None:
    subscription, outbox = made(12.0, 2)
    assert played(subscription, outbox, 10) == [(0, 0), (12, 1), (24, 4), (36, 7)]
    assert outbox.dropped == 4  # 2, 3, 5 and 6; 8 and 9 wait


def test_of_several_ids_the_most_eager_counts() -> None:
    subscription, outbox = made(1000.0, 0)
    subscription.add("fast", 0.0, 0)
    assert len(played(subscription, outbox, 5)) == 5
    assert not subscription.remove("fast")
    assert not subscription.remove("unknown")
    assert [number for _, number in played(subscription, outbox, 500)] == [4, 254]
    assert subscription.remove(None)


def test_a_queue_without_a_throttle_bounds_what_waits_for_a_slow_client() -> None:
    subscription, outbox = made(0.0, 2)
    for k in range(5):
        subscription.offer(b"%d" % k, 0)
    assert outbox.take(1000) == [b"3", b"4"]


def test_in_order_and_counted() -> None:
    box = Outbox()
    for k in range(4):
        box.put(b"%d" % k, k * MS)
    assert box.take(2) == [b"0", b"1"]
    assert box.take(100) == [b"2", b"3"]
    assert box.take(100) == []
    assert (box.sent, box.dropped) == (4, 0)


def test_the_oldest_goes_after_a_second() -> None:
    box = Outbox()
    for k in range(500):
        box.put(b"%d" % k, 4 * k * MS)
    assert box.dropped == 249
    assert box.take(2**20) == [b"%d" % k for k in range(249, 500)]


def test_four_megabytes_wait_at_most() -> None:
    box = Outbox()
    for _ in range(100):
        box.put(bytes(2**16), 0)
    assert len(box.take(2**30)) == 64
    assert box.dropped == 36


def test_a_topic_with_a_queue_of_its_own_keeps_its_newest() -> None:
    box = Outbox()
    for k in range(5):
        box.put(b"a%d" % k, 0, "/a", 2)
        box.put(b"b%d" % k, 0, "/b")
    assert box.take(1000) == [b"b0", b"b1", b"b2", b"a3", b"b3", b"a4", b"b4"]
    assert box.dropped == 3


def test_a_client_is_stuck_when_it_takes_nothing_for_ten_seconds() -> None:
    box = Outbox()
    assert not box.is_stuck(10**15)
    for k in range(2501):
        box.put(b"", 4 * k * MS)
        assert not box.is_stuck(4 * k * MS)
    box.put(b"", 10_004 * MS)
    assert box.is_stuck(10_004 * MS)
    box.take(1)
    assert not box.is_stuck(10_004 * MS)
