"""The state machine, state by state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.bridge.control.limits import Limits, Reply
from armlab.bridge.control.state_machine import STOP_TIME, Mode, StateMachine
from armlab.errors import CommandRefused, LinkError
from armlab.robots import Robot
from armlab.state import Command
from armlab.wire.egm.robot_side import RobotSideCodec

T = 0.004
NOT_READY = [{"motors": 2}, {"motors": None}, {"mci": 2}, {"mci": None}, {"rapid": 1}]


class Bench:
    """State machine fed with packets."""

    def __init__(self, feed: Any, robot: Robot, limits: Limits | None = None, **options: Any) -> None:
        self.feed, self.robot, self.events = feed, robot, feed.events
        self.machine = StateMachine(robot, limits or Limits.of(robot), on_event=feed.tell, **options)

    def see(self, **fields: Any) -> Any:
        sample = self.feed.sample(**fields)
        self.machine.observe(sample)
        return self.machine.state(sample, 0, {})

    def __call__(self, command: Command | None = None, **fields: Any) -> Reply | None:
        self.see(**fields)
        return self.machine.answer(command, T)

    def reply(self, command: Any = None, **fields: Any) -> Reply:
        reply = self(command, **fields)
        assert reply is not None
        return reply

    @property
    def mode(self) -> Mode:
        return self.machine.mode

    @property
    def home(self) -> np.ndarray:
        return self.robot.q_home

    def run(self) -> None:
        self.reply(None)
        for _ in range(10):
            self.reply(Command(qd=np.full(7, 0.8)))


@pytest.fixture
def bench(feed: Any, robot: Robot) -> Bench:
    return Bench(feed, robot)


def test_waiting_sends_nothing(bench: Bench) -> None:
    assert bench.mode is Mode.WAITING
    machine = bench.machine
    assert (machine.ready, machine.guided, machine.reason, machine.worst_ratio) == (False, False, "", 1)
    assert np.isnan(bench.machine.q_start).all()
    assert not bench.machine.calls
    assert bench.machine.answer(Command(bench.home), T) is None


def test_listening_sends_nothing_ever_and_a_stream_may_stay_unanswered(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot, commands=False)
    for fields in [{}, {"mci": 2}, {}, {"motors": 2}]:
        assert bench(Command(robot.q_home), **fields) is None
        assert bench.mode is Mode.LISTENING
    assert bench.machine.elapsed == pytest.approx(3 * T)
    assert bench.machine.t == pytest.approx(3 * T)
    bench.machine.lose("the motors were switched off", resume=True)
    assert bench.mode is Mode.LISTENING
    bench.machine.stop("the time is up")
    assert bench.mode is Mode.ENDED
    assert bench.events[-1] == "Stopping: the time is up."
    bench = Bench(feed, robot, answer_stream=False)
    assert bench(mci=2) is None
    assert bench(mci=3) is not None


@pytest.mark.parametrize("fields", NOT_READY)
def test_not_ready_sends_back_the_feedback_of_this_packet(bench: Bench, fields: dict[str, Any]) -> None:
    for k in range(20):
        q = bench.home + 1e-2 * k
        reply = bench.reply(Command(bench.home), q=q, **fields)
        np.testing.assert_allclose(bench.machine.state(bench.feed.session._last, 0, {}).q_start, q, rtol=1e-14)
        np.testing.assert_allclose(reply.q, q, rtol=1e-14)
        assert not reply.qd.any()
        assert not bench.machine.calls
    assert bench.mode is Mode.HOLDING
    assert not bench.feed.warnings, "it was not ready before"


def test_ready_freezes_the_position(bench: Bench) -> None:
    bench.reply(None, mci=2, q=bench.home - 0.03)
    state = bench.see(rapid=0)  # RAPID stays undefined after a restart of the controller
    assert bench.machine.calls
    first = bench.machine.answer(None, T)
    moved = bench.reply(None, q=bench.home + 0.01)
    np.testing.assert_allclose(first.q, bench.home, rtol=1e-14)
    np.testing.assert_array_equal(moved.q, first.q)
    assert not moved.qd.any()
    np.testing.assert_allclose(state.q_start, bench.home, rtol=1e-14)
    np.testing.assert_allclose(bench.see(q=bench.home + 0.04).q_start, bench.home, rtol=1e-14)
    assert state.t == 0.0
    assert bench.events[-1] == "The robot is ready and holds its position."


def test_time_counts_from_readiness(bench: Bench) -> None:
    assert bench.see(mci=2).t == 0.0
    assert bench.see(mci=2).t == 0.0
    assert bench.see().t == 0.0
    assert bench.see().t == pytest.approx(T)
    assert bench.see(motors=2).t == pytest.approx(2 * T)
    assert bench.see().t == pytest.approx(3 * T)
    assert bench.machine.elapsed == pytest.approx(T)
    bench.see()
    assert bench.machine.elapsed == pytest.approx(2 * T)


def test_entry_far_from_the_hold_is_refused_and_told_after_a_second(bench: Bench) -> None:
    bench.reply(None)
    assert bench.machine.refusing == ""
    for _ in range(249):
        reply = bench.reply(Command(bench.home + 0.051))
        np.testing.assert_allclose(reply.q, bench.home, rtol=1e-14)
    assert bench.mode is Mode.HOLDING
    assert not any("the first position within" in event for event in bench.events)
    bench.reply(Command(bench.home + 0.051))
    bench.reply(Command(bench.home + 0.051))
    assert sum("the first position within" in event for event in bench.feed.warnings) == 1
    assert bench.machine.refused == 251
    assert "the first position within" in bench.machine.refusing
    bench.reply(None)
    assert bench.machine.refusing == ""
    assert np.all(bench.reply(Command(bench.home + 0.049)).q > bench.home)
    assert (bench.mode, bench.machine.refusing) == (Mode.RUNNING, "")
    bench.reply(Command(bench.home + 1.0))
    assert "a jump of" in bench.machine.refusing


def test_velocities_need_no_entry_and_are_integrated(bench: Bench) -> None:
    bench.reply(None)
    for k in range(1, 4):
        reply = bench.reply(Command(qd=np.full(7, 0.05)))
        np.testing.assert_allclose(reply.q, bench.home + 0.05 * T * k)
        np.testing.assert_allclose(reply.qd, 0.05)
    assert bench.mode is Mode.RUNNING


def test_speed_follows_position_unless_given_and_the_state_shows_the_previous_reply(bench: Bench) -> None:
    bench.reply(None)
    reply = bench.reply(Command(bench.home + 1e-4))
    np.testing.assert_allclose(reply.qd, 1e-4 / T)
    bench.feed.packets.codec = RobotSideCodec(bench.robot, extension=True)
    state = bench.see(tau=np.arange(7.0))
    np.testing.assert_allclose(state.tau, np.arange(7.0))
    bench.feed.packets.codec = RobotSideCodec(bench.robot)
    np.testing.assert_array_equal(state.q_sent, reply.q)
    np.testing.assert_array_equal(state.qd_sent, reply.qd)
    assert state.pos0 is state.q_start
    bench.machine.answer(Command(bench.home + 1e-4, np.zeros(7)), T)
    both = bench.reply(Command(bench.home + 2e-4, np.full(7, 0.03)))
    np.testing.assert_allclose(both.q, bench.home + 2e-4)
    np.testing.assert_allclose(both.qd, 0.03)


def test_none_holds_with_a_ramp_and_returns_to_holding(bench: Bench) -> None:
    bench.run()
    speeds = [bench.reply(None).qd.max() for _ in range(30)]
    assert bench.mode is Mode.HOLDING
    assert np.all(np.diff(speeds) <= 0.0)
    assert speeds[-1] == 0.0
    rest = bench.reply(None)
    np.testing.assert_array_equal(rest.q, bench.reply(None).q)


@pytest.mark.parametrize("fields", NOT_READY)
def test_losing_readiness_holds_and_needs_entry_again(bench: Bench, fields: dict[str, Any]) -> None:
    bench.run()
    for _ in range(3):
        reply = bench.reply(Command(bench.home), **fields)
    assert [text.partition(":")[0] for text in bench.feed.warnings] == ["The robot is not ready"]
    assert bench.mode is Mode.HOLDING
    if None in fields.values():  # the arm may still be guided, so it comes to rest
        assert 0.0 < reply.qd.max() < 0.8
    else:
        np.testing.assert_allclose(reply.q, bench.home, rtol=1e-14)
    bench.reply(Command(bench.home + 0.08), q=bench.home)
    assert bench.mode is Mode.HOLDING
    bench.reply(Command(bench.home + 0.01), q=bench.home)
    assert bench.mode is Mode.RUNNING


def test_stopping_ramps_rests_and_ends(bench: Bench) -> None:
    bench.run()
    bench.machine.stop("the time is up")
    assert not bench.machine.calls
    speeds, cycles = [], 0
    while bench.mode is Mode.STOPPING:
        speeds.append(bench.reply(Command(bench.home + 1.0)).qd.max())
        cycles += 1
    moving = int(np.count_nonzero(speeds))
    assert moving > 0
    assert cycles - moving == pytest.approx(STOP_TIME / T, abs=2)
    assert bench.mode is Mode.ENDED
    last = bench.reply(Command(bench.home))  # the other arm of a link may still be stopping
    assert bench.mode is Mode.ENDED
    assert not last.qd.any()
    assert (bench.machine.reason, bench.machine.failure) == ("the time is up", None)


def test_an_arm_that_is_not_ready_while_it_stops_ends_after_the_same_time(bench: Bench) -> None:
    bench.run()
    bench.machine.stop("the time is up")
    cycles = 0
    while bench.mode is Mode.STOPPING:
        bench.reply(None, mci=2)
        cycles += 1
    assert cycles == pytest.approx(STOP_TIME / T, abs=1)
    bench.machine.lose("the controller stopped sending", resume=False)
    assert bench.machine.answer(None, T) is None, "no reply to a packet of the previous session"


def test_a_lost_session_is_waited_for_or_ends(bench: Bench) -> None:
    bench.run()
    begun: list[str] = []
    bench.machine._external.begin = lambda: begun.append("again")  # type: ignore[method-assign]
    bench.machine.lose("the motors were switched off", resume=True)
    assert (bench.mode, bench.machine.ready, begun) == (Mode.WAITING, False, [])
    assert bench.machine.answer(Command(bench.home), T) is None
    bench.reply(None, seqno=0, q=bench.home + 0.2)
    assert bench.machine.t == 0.0
    assert begun == ["again"], "external axes keep no reference of the previous session"
    np.testing.assert_allclose(bench.machine.q_start, bench.home + 0.2, rtol=1e-14)
    assert bench.machine.ready
    bench.reply(None, seqno=0, motors=None, mci=None)
    assert not bench.machine.ready, "states of the previous session do not apply to this one"
    bench.machine.lose("the motors were switched off", resume=False)
    assert bench.mode is Mode.ENDED
    assert bench.machine.reason == "the motors were switched off"


def test_the_controller_ends_the_run_and_a_session_lost_while_stopping_ends(bench: Bench) -> None:
    bench.run()
    bench.reply(Command.stop())
    assert bench.mode is Mode.STOPPING
    bench.machine.stop("second", LinkError("Expected the first reason to stay, it did not."))
    assert bench.machine.failure is None
    bench.machine.lose("the controller stopped sending", resume=True)
    assert (bench.mode, bench.machine.reason) == (Mode.ENDED, "the controller ended the run")


def test_implausible_feedback_never_moves(bench: Bench) -> None:
    for _ in range(3):
        assert bench.mode is not Mode.ENDED
        assert bench(None, q=np.degrees(bench.home) + 100.0) is None
        assert not bench.machine.calls
    assert bench.mode is Mode.ENDED
    assert "or unit" in str(bench.machine.failure)
    assert bench(None) is None, "the run has ended, regardless of the feedback"


def test_the_overdue_hold_stays_in_its_mode(bench: Bench) -> None:
    bench.run()
    bench.see()
    reply = bench.machine.hold(T)
    assert 0.0 < reply.qd.max() < 0.8
    assert bench.mode is Mode.RUNNING
    bench.see(motors=2, q=bench.home + 0.03)
    feedback = bench.machine.hold(T)
    np.testing.assert_allclose(feedback.q, bench.home + 0.03, rtol=1e-14)


def test_the_first_step_of_a_ready_robot_is_one_period_however_long_nothing_was_sent(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot, answer_stream=False)
    for _ in range(250):
        assert bench(mci=2) is None
    moved = bench.reply(Command(bench.home + 0.04)).q - bench.home
    assert (moved > 0.0).all()
    assert (moved <= robot.qdd_max * T**2 * (1 + 1e-6)).all()


def test_times_of_rest_and_of_refusal_are_over_when_they_are_reached(bench: Bench) -> None:
    """Steps of 0.125 s add up exactly to 0.5 s at rest and to 1 s of refusals."""
    take = bench.feed.sample

    def sample(**fields: Any) -> Any:
        found = take(**fields)
        found.step = 0.125
        return found

    bench.feed.sample, told = sample, []
    bench.reply(None)
    for _ in range(9):
        bench.reply(Command(bench.home + 0.06))
        told.append(len(bench.feed.warnings))
    assert told == [0, 0, 0, 0, 0, 0, 0, 1, 1]
    bench.machine.stop("the time is up")
    for _ in range(4):
        assert bench.mode is Mode.STOPPING
        bench.reply(None)
    assert bench.mode is Mode.ENDED
    assert bench(None) is not None, "other arms may still stop"


def test_clamps_are_counted_per_joint(bench: Bench) -> None:
    bench.reply(None)
    qd = np.zeros(7)
    qd[3] = 100.0
    bench.reply(Command(qd=qd))
    assert bench.machine.clamps[:, 3].tolist() == [0, 1, 1, 0, 0, 0]
    assert bench.machine.clamps.sum() == 2
    assert 0.0 < bench.machine.worst_ratio < 0.1
    bench.machine.clamps[:] = 0  # then each limit in its row
    still = bench.machine._limiter.hold(T)
    for k, bit in enumerate((1, 2, 4, 8, 16, 32)):
        clamped = still._replace(clamped=bit * np.eye(7, dtype=np.uint8)[k])
        bench.machine._limiter.step = lambda *_, reply=clamped: reply  # type: ignore[method-assign]
        bench.reply(Command(bench.home))
    np.testing.assert_array_equal(bench.machine.clamps, np.eye(6, 7))


def test_implausible_feedback_after_the_end_is_not_sent_back(bench: Bench) -> None:
    bench.run()
    bench.machine.stop("another arm failed")
    while bench.mode is not Mode.ENDED:
        bench.reply()
    assert bench() is not None
    assert bench(seqno=0, tm_ms=99_000, q=np.degrees(bench.home) + 100.0) is None


BAD = Command(np.full(7, np.nan))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_three_commands_that_are_not_finite_end_the_run(bench: Bench, bad: float) -> None:
    bench.run()
    for k in range(3):
        assert bench.mode is Mode.RUNNING, k
        reply = bench.reply(Command(np.full(7, bad)))
        assert np.isfinite(reply.q).all()
        assert np.isfinite(reply.qd).all()
        assert sum("finite" in text for text in bench.feed.warnings) == 1, "only the first in a row is reported"
    assert bench.mode is Mode.STOPPING
    assert isinstance(bench.machine.failure, CommandRefused)
    assert "finite" in str(bench.machine.failure)


def test_a_hold_or_a_good_command_between_bad_ones_goes_on(bench: Bench) -> None:
    bench.run()
    for command in (BAD, BAD, None, BAD, BAD, Command(qd=np.zeros(7)), BAD, BAD):
        bench.reply(command)
    assert bench.machine.calls
    assert bench.machine.refused == 6


TWO = np.zeros(2)  # one array used twice


@pytest.mark.parametrize(
    "command",
    [
        *(Command(np.zeros(6)), "up", Command(tau=np.zeros(7)), Command(q_ext=TWO, rapid_data=TWO)),
        Command(q_ext=True, rapid_data=True, rapid_digital=True),
    ],
)
def test_commands_of_the_wrong_kind_stop_at_once(bench: Bench, command: Any) -> None:
    bench.run()
    bench.reply(command)
    assert bench.mode is Mode.STOPPING
    assert isinstance(bench.machine.failure, CommandRefused)


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
    fast = Command(qd=np.full(7, 1.0))
    sent = [bench.reply(fast) for _ in range(30)][-1]
    for _ in range(20):
        bench.see()
        unsent = bench.machine.hold(T) if late else bench.machine.answer(fast, T)
        assert np.abs(unsent.q - sent.q).max() > 1e-3 or not unsent.qd.any()
        bench.machine.take_back()
        np.testing.assert_array_equal(bench.see().q_sent, sent.q)
    following = bench.reply(fast)
    gap = 41 * T  # two packets in each of the twenty cycles
    np.testing.assert_allclose(following.q - sent.q, 3 * T * bench.robot.qd_max.min(), rtol=1e-9)
    np.testing.assert_allclose(following.qd, 3 * T * bench.robot.qd_max.min() / gap, rtol=1e-9)


def test_a_stop_of_which_nothing_goes_out_ends(bench: Bench) -> None:
    bench.run()
    for _ in range(600):
        bench.reply(Command(qd=np.full(7, 0.8)))
        bench.machine.take_back()
    bench.machine.stop("the time is up")
    for _ in range(500):
        assert bench.mode is Mode.STOPPING
        bench.reply()
        bench.machine.take_back()
    assert (bench.mode, bench.machine.reason) == (Mode.ENDED, "the time is up")
    assert bench() is None, "the position of the arm is unknown"
    assert isinstance(bench.machine.failure, LinkError)
    assert str(bench.machine.failure) == bench.feed.warnings[-1]
    assert "got 500 unsent replies" in bench.feed.warnings[-1]


def test_a_stop_of_which_some_goes_out_rests(bench: Bench) -> None:
    bench.run()
    bench.machine.stop("the time is up")
    for k in range(1000):
        bench.reply()
        if k % 3 and bench.mode is Mode.STOPPING:
            bench.machine.take_back()
    assert bench.mode is Mode.ENDED
    assert bench() is not None
    assert bench.machine.failure is None


def test_the_first_failure_stays_when_nothing_goes_out(bench: Bench) -> None:
    bench.run()
    for _ in range(3):
        bench.reply(BAD)
    for _ in range(499):
        bench.reply()
        bench.machine.take_back()
    assert bench.mode is Mode.STOPPING
    bench.reply()
    bench.machine.take_back()
    assert bench.mode is Mode.ENDED
    assert isinstance(bench.machine.failure, CommandRefused)
    assert len(bench.feed.warnings) == 2
