"""The state machine when a command is refused, or a reply does not go out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.bridge.control.state_machine import Mode
from armlab.errors import CommandRefused, LinkError
from armlab.robots import Robot
from armlab.state import Command

from .test_state_machine import Bench, T

BAD = Command(np.full(7, np.nan))


@pytest.fixture
def bench(feed: Any, robot: Robot) -> Bench:
    return Bench(feed, robot)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_three_commands_that_are_not_finite_end_the_run(bench: Bench, bad: float) -> None:
    bench.run()
    for k in range(3):
        assert bench.mode is Mode.RUNNING, k
        reply = bench.reply(Command(np.full(7, bad)))
        assert np.isfinite(reply.q).all()
        assert np.isfinite(reply.qd).all()
        assert sum("finite" in text for text in bench.feed.warnings) == 1, "the first of those in a row"
    assert bench.mode is Mode.STOPPING
    assert isinstance(bench.guide.failure, CommandRefused)
    assert "finite" in str(bench.guide.failure)


def test_a_hold_between_bad_ones_goes_on(bench: Bench) -> None:
    bench.run()
    for command in (*[Command(np.full(7, np.nan))] * 2, None, *[Command(np.full(7, np.nan))] * 2):
        bench.reply(command)
    assert bench.guide.calls


def test_a_good_command_between_bad_ones_goes_on(bench: Bench) -> None:
    bench.run()
    for _ in range(4):
        for _ in range(2):
            bench.reply(Command(bench.guide._limiter.q + 0.5))
        bench.reply(Command(qd=np.zeros(7)))
    assert bench.mode is Mode.RUNNING
    assert bench.guide.refused == 8


@pytest.mark.parametrize("command", [Command(np.zeros(6)), "up", Command(tau=np.zeros(7))])
def test_commands_of_the_wrong_kind_stop_at_once(bench: Bench, command: Any) -> None:
    bench.run()
    bench.reply(command)
    assert bench.mode is Mode.STOPPING
    assert isinstance(bench.guide.failure, CommandRefused)


@pytest.mark.parametrize("fields", [{"motors": 2}, {"seqno": 0}])
def test_refusals_before_the_robot_was_ready_anew_do_not_count(bench: Bench, fields: dict[str, Any]) -> None:
    bench.run()
    bench.reply(BAD)
    bench.reply(BAD)
    bench.reply(BAD, **fields)
    bench.reply(BAD)
    assert bench.mode is Mode.HOLDING
    for _ in range(2):
        bench.reply(BAD)
    assert bench.mode is Mode.STOPPING


@pytest.mark.parametrize("late", [False, True])
def test_a_reply_that_did_not_go_out_is_no_step(bench: Bench, late: bool) -> None:
    """The next one is a step of the time that has passed, as far as a gap allows: three periods of the fastest."""
    fast = Command(qd=np.full(7, 1.0))
    sent = [bench.reply(fast) for _ in range(30)][-1]
    for _ in range(20):
        bench.see()
        unsent = bench.guide.hold(T) if late else bench.guide.answer(fast, T)
        assert unsent is not None
        assert np.abs(unsent.q - sent.q).max() > 1e-3 or not unsent.qd.any()
        bench.guide.take_back()
        np.testing.assert_array_equal(bench.see().q_sent, sent.q)
    following = bench.reply(fast)
    gap = 41 * T  # each of the twenty was seen twice
    np.testing.assert_allclose(following.q - sent.q, 3 * T * bench.robot.qd_max.min(), rtol=1e-9)
    np.testing.assert_allclose(following.qd, 3 * T * bench.robot.qd_max.min() / gap, rtol=1e-9)


def test_a_stop_of_which_nothing_goes_out_ends(bench: Bench) -> None:
    """The reference stays at its speed, so that it would never rest; what was lost before does not count."""
    bench.run()
    for _ in range(600):
        bench.reply(Command(qd=np.full(7, 0.8)))
        bench.guide.take_back()
    bench.guide.stop("the time is up")
    for _ in range(500):
        assert bench.mode is Mode.STOPPING
        bench.reply()
        bench.guide.take_back()
    assert (bench.mode, bench.guide.reason) == (Mode.ENDED, "the time is up")
    assert bench() is None, "nothing is known of where the arm is"
    assert isinstance(bench.guide.failure, LinkError)
    assert str(bench.guide.failure) == bench.feed.warnings[-1]
    assert "500 of them did not go out" in bench.feed.warnings[-1]


def test_a_stop_of_which_some_goes_out_rests(bench: Bench) -> None:
    bench.run()
    bench.guide.stop("the time is up")
    for k in range(1000):
        bench.reply()
        if k % 3 and bench.mode is Mode.STOPPING:
            bench.guide.take_back()
    assert bench.mode is Mode.ENDED
    assert bench() is not None
    assert bench.guide.failure is None


def test_the_first_failure_stays_when_nothing_goes_out(bench: Bench) -> None:
    bench.run()
    for _ in range(3):
        bench.reply(BAD)
    for _ in range(499):
        bench.reply()
        bench.guide.take_back()
    assert bench.mode is Mode.STOPPING
    bench.reply()
    bench.guide.take_back()
    assert bench.mode is Mode.ENDED
    assert isinstance(bench.guide.failure, CommandRefused)
    assert len(bench.feed.warnings) == 2
