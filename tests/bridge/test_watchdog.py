"""The guard thread and the count of late cycles."""

from __future__ import annotations

import threading

from armlab.bridge.watchdog import Guard, Lateness

PERIOD = 4_000_000


def test_five_in_a_row() -> None:
    lateness = Lateness()
    now = 0
    for _ in range(3):
        for late in (True, True, True, True, False):
            now += PERIOD
            assert lateness.add(now, late, 0) == ""
        now += 10 * 10**9
    verdicts = [lateness.add(now + k * PERIOD, True, 0) for k in range(5)]
    assert verdicts[:4] == [""] * 4
    assert "5 cycles in a row" in verdicts[4]


def test_five_percent_in_one_second() -> None:
    lateness = Lateness()
    verdicts = [lateness.add(k * PERIOD, k % 19 == 0, 0) for k in range(300)]
    first = next(k for k, verdict in enumerate(verdicts) if verdict)
    assert 225 <= first < 300
    assert "within one second" in verdicts[first]
    rarely = Lateness()
    assert not any(rarely.add(k * PERIOD, k % 25 == 0, 0) for k in range(1000))


def test_one_long_call() -> None:
    lateness = Lateness()
    assert lateness.add(0, True, 249_000_000) == ""
    assert "one call took 0.26 s" in lateness.add(PERIOD, True, 260_000_000)


def test_the_guard_acts_only_when_overdue() -> None:
    left, acted, looked = [1.0], threading.Event(), threading.Event()

    def overdue() -> float:
        looked.set()
        return left[0]

    with Guard(overdue, acted.set):
        assert looked.wait(5.0)
        assert not acted.is_set()
        left[0] = -0.001
        assert acted.wait(5.0)
