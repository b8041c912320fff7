"""The guard thread and the count of late cycles."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from armlab.bridge.control.realtime import Guard, Lateness

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


def test_what_was_late_a_second_ago_counts_no_more_and_what_is_late_now_does() -> None:
    lateness = Lateness()
    assert not any(lateness.add(k * PERIOD, k % 25 == 0, 0) for k in range(1000))
    assert any(lateness.add(k * PERIOD, k % 10 == 0, 0) for k in range(1000, 1250))


def test_exactly_five_percent_is_not_too_much() -> None:
    """A hundred cycles, the oldest of them exactly a second ago."""
    for share, words in ((20, ""), (19, "6 of 100 cycles within one second were late")):
        lateness = Lateness()
        found = [lateness.add((k + 1) * 10**7 if k else 0, k % share == 0, 0) for k in range(100)]
        assert found[-1] == words


@pytest.mark.parametrize("pause", [500, 930, 970, 1100])
def test_one_late_cycle_after_a_pause_is_not_too_much(pause: int) -> None:
    lateness = Lateness()
    times = [k * PERIOD + (pause * 10**6 if k >= 300 else 0) for k in range(600)]
    assert not any(lateness.add(now, k == 300, PERIOD) for k, now in enumerate(times))


@pytest.mark.parametrize(("pause", "call", "forgets"), [(1, 0, True), (0, 0, False), (0, 1000, False)])
def test_a_quarter_of_a_second_without_a_call_forgets_what_was_late(pause: int, call: int, forgets: bool) -> None:
    """Eleven late cycles before it and eleven behind it are too many in one second; a call that lasts is no pause."""
    lateness = Lateness()
    late = [k >= 300 - 33 and k < 300 + 33 and k % 3 == 0 for k in range(600)]
    times = [k * PERIOD + (k >= 300) * (250_000_000 - PERIOD + pause + call) for k in range(600)]
    told = [lateness.add(now, late[k], call * (k == 300)) for k, now in enumerate(times)]
    assert any(told) != forgets


def test_one_long_call() -> None:
    lateness = Lateness()
    assert lateness.add(0, True, 250_000_000) == ""
    assert lateness.add(0, True, 249_000_000) == ""
    assert "one call took 0.26 s, allowed are 0.25 s" in lateness.add(PERIOD, True, 260_000_000)


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


def test_the_guard_sleeps_until_the_deadline_at_most_two_milliseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    left = iter([1.0, 0.5e-3, 0.0])
    done = threading.Event()

    def overdue() -> float:
        return next(left, 1.0)

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        done.wait(1e-3)

    monkeypatch.setattr("armlab.bridge.control.realtime.time", SimpleNamespace(sleep=sleep))
    with Guard(overdue, done.set) as guard:
        assert done.wait(5.0)
        assert guard._thread.daemon, "a program that ends does not wait for it"
        assert guard._thread.name == "armlab guard"
    assert not guard._thread.is_alive()
    assert slept[:2] == [2e-3, 0.5e-3]
