"""What waits for a client that does not read: a second of it, and not for ever."""

from __future__ import annotations

from armlab.bridge.servers.rosbridge.session import Outbox

MS = 1_000_000


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
