"""Garbage collection, thread switches, priority."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import pytest

from armlab.bridge.control.realtime import (
    GUARD_PRIORITY,
    LOOP_PRIORITY,
    Guard,
    Lateness,
    Prediction,
    Wait,
    Waiting,
    collect_if_due,
    interrupts,
    priority,
    quiet_memory,
    short_switches,
)
from armlab.bridge.net.sockets import Port


def test_the_collector_sleeps_and_wakes_and_switches_are_short() -> None:
    before = sys.getswitchinterval()
    assert gc.isenabled()

    def fail() -> None:
        with short_switches(), quiet_memory():
            assert sys.getswitchinterval() == pytest.approx(5e-4)
            assert not gc.isenabled()
            assert gc.get_freeze_count() > 0
            raise RuntimeError("anything")

    with pytest.raises(RuntimeError, match="anything"):
        fail()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    assert sys.getswitchinterval() == before
    gc.disable()
    try:
        with quiet_memory():
            pass
        assert not gc.isenabled(), "a disabled collector stays disabled"
    finally:
        gc.enable()


def test_young_garbage_is_collected_when_there_is_much() -> None:
    with quiet_memory():
        kept = [[] for _ in range(2000)]
        assert gc.get_count()[0] > 700
        collect_if_due()
        assert gc.get_count()[0] < 700
        assert len(kept) == 2000


def test_the_collector_is_called_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[object, ...]] = []
    for name in ("collect", "freeze", "disable", "unfreeze", "enable"):
        monkeypatch.setattr(gc, name, lambda *given, name=name: calls.append((name, *given)))
    with quiet_memory():
        assert calls == [("collect",), ("freeze",), ("disable",)]
    assert calls[3:] == [("collect",), ("unfreeze",), ("enable",)]
    calls.clear()
    for count in (700, 701):
        monkeypatch.setattr(gc, "get_count", lambda count=count: (count, 0, 0))
        collect_if_due()
    assert calls == [("collect", 0)], "only above 700 new objects"


def test_a_longer_switch_interval_is_restored() -> None:
    before = sys.getswitchinterval()
    try:
        for interval in (0.02, 1e-4):
            sys.setswitchinterval(interval)
            with short_switches():
                assert sys.getswitchinterval() == pytest.approx(min(interval, 5e-4), rel=0.02)
            assert sys.getswitchinterval() == pytest.approx(interval, rel=0.02)
    finally:
        sys.setswitchinterval(before)


def test_priority_is_that_of_the_calling_thread_and_not_inherited(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[object, ...]] = []
    monkeypatch.setattr(os, "sched_getscheduler", lambda pid: os.SCHED_BATCH)
    monkeypatch.setattr(os, "sched_getparam", lambda pid: ("parameters", pid))
    monkeypatch.setattr(os, "sched_setscheduler", lambda *given: calls.append(given))
    with priority(50, pytest.fail) as raised:
        assert raised
    assert calls == [
        (0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(50)),
        (0, os.SCHED_BATCH | os.SCHED_RESET_ON_FORK, ("parameters", 0)),
    ], "a user with an rtprio limit but without CAP_SYS_NICE may not clear the flag, and would keep the priority"


def test_a_priority_that_is_not_permitted_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("not today")

    told: list[str] = []
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with priority(50, lambda text, warn=False: told.append(text)) as raised:
        assert not raised
    assert len(told) == 1
    assert "not permitted (not today)" in told[0]


def test_priority_is_raised_or_told_and_given_back() -> None:
    before, told, inherited = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, [], []
    assert GUARD_PRIORITY > LOOP_PRIORITY
    with priority(LOOP_PRIORITY, lambda text, warn=False: told.append(text)) as raised:
        assert raised == (not told)
        if raised:
            assert os.sched_getparam(0).sched_priority == LOOP_PRIORITY
        thread = threading.Thread(target=lambda: inherited.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == before
    assert inherited == [before]
    assert all("rtprio" in sentence for sentence in told)


def test_signals_call_and_their_handlers_come_back() -> None:
    calls: list[int] = []
    before = signal.getsignal(signal.SIGTERM)
    with interrupts(lambda: calls.append(1)):
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
    assert calls == [1, 1]
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_closed_terminal_counts_once_and_never_as_a_second_signal_and_may_be_ignored() -> None:
    before = signal.getsignal(signal.SIGHUP)
    for first in (signal.SIGHUP, signal.SIGINT):
        calls: list[int] = []
        with interrupts(lambda calls=calls: calls.append(1)):
            for number in (first, signal.SIGHUP, signal.SIGHUP):
                signal.raise_signal(number)
        assert calls == [1]
    assert signal.getsignal(signal.SIGHUP) is before
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts(lambda: pytest.fail("called")):
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_leaves_signals_alone() -> None:
    before = signal.getsignal(signal.SIGTERM)
    seen: list[bool] = []

    def work() -> None:
        with interrupts(lambda: None):
            seen.append(signal.getsignal(signal.SIGTERM) is before)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [True]


MS = 1_000_000


@pytest.mark.parametrize(
    "packets",  # arrival, periods since the previous packet, resulting prediction [ms]
    [
        [(100, 1, 104), (103, 1, 107), (108, 1, 111.02)],  # early arrivals count fully, late ones by 2 %
        [(0, 1, 4), (12, 3, 16), (500, 1, 504)],  # lost packets, and a stall
    ],
)
def test_predictions(packets: list[tuple[int, int, float]]) -> None:
    prediction = Prediction()
    assert prediction.next_ns is None
    for arrival, periods, expected in packets:
        prediction.add(arrival * MS, periods, 0.004)
        assert prediction.next_ns == pytest.approx(expected * MS, rel=1e-12)


@pytest.mark.parametrize(("late", "next_ms"), [(20, 8.0 + 0.4), (21, 4.0 + 21.0 + 4.0)])
def test_an_arrival_more_than_five_periods_from_the_prediction_restarts_it(late: int, next_ms: float) -> None:
    prediction = Prediction()
    prediction.add(0, 1, 0.004)
    prediction.add((4 + late) * MS, 1, 0.004)
    assert prediction.next_ns == pytest.approx(next_ms * MS)


@pytest.fixture
def port() -> Iterator[Port]:
    port = Port("127.0.0.1", 0)
    yield port
    port.close()


other = port


@pytest.mark.parametrize("mode", get_args(Wait))
def test_what_is_there_is_returned_at_once(port: Port, mode: Wait) -> None:
    waiting = Waiting([port], [Prediction()], mode)
    port.send(b"x", (port.host, port.port))
    found = waiting.next(5.0)
    assert (found[0], found[1].data) == (0, b"x")
    assert waiting.next(0.001) is None


@pytest.mark.parametrize("mode", get_args(Wait))
def test_a_cycle_runs_dry_once_before_each_predicted_packet(
    port: Port, mode: Wait, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, prediction, runs, waits = [0], Prediction(), list[int](), list[tuple[int, int]]()

    def wait(sockets: list[int], poll_ns: int, end_ns: int) -> None:
        waits.append((poll_ns, end_ns))
        now[0] = end_ns

    monkeypatch.setattr("armlab.bridge.control.realtime.time", SimpleNamespace(monotonic_ns=lambda: now[0]))
    monkeypatch.setattr("armlab.kernels.await_datagram", wait)
    waiting = Waiting([port], [prediction], mode, lambda: runs.append(now[0]))
    assert waiting.next(0.001) is None
    assert not runs, "no packet is expected"
    for _ in range(2):
        waits.clear()
        begun, prediction.next_ns = now[0], now[0] + 10.0 * MS
        assert waiting.next(0.03) is None
        before, after, end = begun + int(9.6 * MS), begun + int(10.6 * MS), begun + 30 * MS
        assert (
            waits
            == {
                "block": [(end, end)],
                "ahead": [(before, before), (before, after), (end, end)],
                "spin": [(begun, before), (before, after), (after, end)],
            }[mode]
        )
        assert runs == ([] if mode == "block" else [before])
        runs.clear()


@pytest.mark.parametrize("mode", get_args(Wait))
@pytest.mark.parametrize("is_permitted", [True, False])
def test_a_loop_that_always_polls_has_real_time_priority_only_near_packets(
    port: Port, mode: Wait, is_permitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, it would block the other threads of its core; without the priority, they would delay replies."""
    now, prediction, levels = [0], Prediction(), list[tuple[int, int]]()

    def wait(sockets: list[int], poll_ns: int, end_ns: int) -> None:
        now[0] = end_ns

    monkeypatch.setattr("armlab.bridge.control.realtime.time", SimpleNamespace(monotonic_ns=lambda: now[0]))
    monkeypatch.setattr("armlab.bridge.control.realtime.set_priority", lambda level: levels.append((now[0], level)))
    monkeypatch.setattr("armlab.kernels.await_datagram", wait)
    waiting = Waiting([port], [prediction], mode)
    waiting.is_permitted = is_permitted
    for _ in range(2):
        assert waiting.next(0.001) is None
    prediction.next_ns = now[0] + 10.0 * MS
    begin, end = int(prediction.next_ns - 0.4 * MS), int(prediction.next_ns + 0.6 * MS)
    assert waiting.next(0.02) is None
    assert levels == ([(0, 0), (begin, LOOP_PRIORITY), (end, 0)] if mode == "spin" and is_permitted else [])


def test_the_end_is_kept_and_a_wait_that_returns_early_goes_on(port: Port, monkeypatch: pytest.MonkeyPatch) -> None:
    now, prediction, runs, waits = [0], Prediction(), list[int](), list[tuple[int, int]]()

    def wait(sockets: list[int], poll_ns: int, end_ns: int) -> None:
        waits.append((poll_ns, end_ns))
        now[0] = now[0] + MS // 4 if now[0] >= 9.6 * MS else end_ns

    monkeypatch.setattr("armlab.bridge.control.realtime.time", SimpleNamespace(monotonic_ns=lambda: now[0]))
    monkeypatch.setattr("armlab.kernels.await_datagram", wait)
    waiting = Waiting([port], [prediction], "ahead", lambda: runs.append(now[0]))
    assert waiting.next() is None
    assert not waits, "by default it does not wait"
    prediction.next_ns = 10.0 * MS
    assert waiting.next(0.009) is None
    assert waits == [(9 * MS, 9 * MS)], "the packet is due later"
    for end in (int(10.3 * MS), int(10.6 * MS)):
        now[0] = 0
        waits.clear()
        assert waiting.next(1e-9 * end) is None
        assert waits == [(end, end)], "the end is within the packet's window"
    now[0] = 0
    assert waiting.next(0.011) is None
    assert runs == [int(9.6 * MS)], "once, however often the wait returns"


def test_a_socket_that_was_bound_again_is_waited_for(port: Port, other: Port, tmp_path: Path) -> None:
    waiting = Waiting([port], [Prediction()], "block")
    assert waiting.next(0.0) is None
    number = port.fileno()
    os.close(number)
    taken = os.open(tmp_path / "other", os.O_CREAT | os.O_RDONLY)
    assert taken == number
    before = time.monotonic()
    assert waiting.next(0.2) is None
    assert time.monotonic() - before > 0.19
    other.send(b"x", (port.host, port.port))
    assert waiting.next(5.0) is not None
    os.close(taken)


@pytest.mark.parametrize("mode", get_args(Wait))
def test_two_ports_take_turns(port: Port, other: Port, mode: Wait) -> None:
    waiting = Waiting([port, other], [Prediction(), Prediction()], mode)
    for _ in range(20):
        port.send(b"flood", (port.host, port.port))
    other.send(b"packet", (other.host, other.port))
    found = [waiting.next(5.0) for _ in range(3)]
    assert [(one[0], one[1].data) for one in found if one is not None][:2] in (
        [(0, b"flood"), (1, b"packet")],
        [(1, b"packet"), (0, b"flood")],
    )
    rest = [waiting.next(5.0) for _ in range(18)]
    assert [one[0] for one in rest if one is not None] == [0] * 18
    assert waiting.next() is None


@pytest.mark.parametrize("mode", ["ahead", "spin"])
def test_a_packet_of_another_arm_ends_the_sleep(port: Port, other: Port, mode: Wait) -> None:
    prediction = Prediction()
    prediction.add(time.monotonic_ns(), 1, 0.4)
    waiting = Waiting([port, other], [prediction, Prediction()], mode)
    threading.Timer(0.02, lambda: port.send(b"x", (other.host, other.port))).start()
    began = time.monotonic()
    found = waiting.next(5.0)
    assert found[0] == 1
    assert time.monotonic() - began < 0.3


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
    assert "5 consecutive cycles" in verdicts[4]


def test_five_percent_in_one_second() -> None:
    lateness = Lateness()
    verdicts = [lateness.add(k * PERIOD, k % 19 == 0, 0) for k in range(300)]
    first = next(k for k, verdict in enumerate(verdicts) if verdict)
    assert 225 <= first < 300
    assert "within one second" in verdicts[first]
    rarely = Lateness()
    assert not any(rarely.add(k * PERIOD, k % 25 == 0, 0) for k in range(1000))
    assert any(rarely.add(k * PERIOD, k % 10 == 0, 0) for k in range(1000, 1250)), "current lateness counts"
    for share, words in ((20, ""), (19, "6 of 100 cycles within one second were late")):  # the oldest was 1 s ago
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
    """Eleven late cycles before the pause and eleven after it are too many in 1 s; a long call is not a pause."""
    lateness = Lateness()
    late = [k >= 300 - 33 and k < 300 + 33 and k % 3 == 0 for k in range(600)]
    times = [k * PERIOD + (k >= 300) * (250_000_000 - PERIOD + pause + call) for k in range(600)]
    told = [lateness.add(now, late[k], call * (k == 300)) for k, now in enumerate(times)]
    assert any(told) != forgets


def test_one_long_call() -> None:
    lateness = Lateness()
    assert lateness.add(0, True, 250_000_000) == ""
    assert lateness.add(0, True, 249_000_000) == ""
    assert "one call took 0.26 s, more than 0.25 s" in lateness.add(PERIOD, True, 260_000_000)


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
        assert guard._thread.daemon, "an ending program does not wait for the guard"
        assert guard._thread.name == "armlab guard"
    assert not guard._thread.is_alive()
    assert slept[:2] == [2e-3, 0.5e-3]
