"""How often a topic comes at most, and what waits."""

from __future__ import annotations

from armlab.bridge.servers.rosbridge.session import Outbox, Subscription

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
