"""Garbage collection, thread switches, priority."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading

import pytest

from armlab.bridge.control.realtime import (
    GUARD_PRIORITY,
    LOOP_PRIORITY,
    collect_if_due,
    interrupts,
    priority,
    quiet_memory,
    short_switches,
)


def test_the_collector_sleeps_and_wakes() -> None:
    assert gc.isenabled()

    def fail() -> None:
        with quiet_memory():
            assert not gc.isenabled()
            assert gc.get_freeze_count() > 0
            raise RuntimeError("anything")

    with pytest.raises(RuntimeError, match="anything"):
        fail()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_a_collector_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        with quiet_memory():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_young_garbage_is_collected_when_there_is_much() -> None:
    with quiet_memory():
        kept = [[] for _ in range(2000)]
        assert gc.get_count()[0] > 700
        collect_if_due()
        assert gc.get_count()[0] < 700
        assert len(kept) == 2000


def test_switches_are_short_inside() -> None:
    before = sys.getswitchinterval()
    with short_switches():
        assert sys.getswitchinterval() == pytest.approx(5e-4)
    assert sys.getswitchinterval() == before


def test_priority_is_raised_or_told_and_given_back() -> None:
    before, told, inherited = os.sched_getscheduler(0), [], []
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


def test_a_closed_terminal_counts_once_and_never_as_a_second_signal() -> None:
    before = signal.getsignal(signal.SIGHUP)
    for first in (signal.SIGHUP, signal.SIGINT):
        calls: list[int] = []
        with interrupts(lambda calls=calls: calls.append(1)):
            for number in (first, signal.SIGHUP, signal.SIGHUP):
                signal.raise_signal(number)
        assert calls == [1]
    assert signal.getsignal(signal.SIGHUP) is before


def test_a_closed_terminal_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
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
