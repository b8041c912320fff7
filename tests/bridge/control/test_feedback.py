"""Plausible feedback, and external reasons to end a run: implausible feedback, silence, very short sessions."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.control.feedback import (
    READY_AFTER,
    STOP_AFTER,
    FeedbackCheck,
    Readiness,
    not_ready_reason,
    outside_range,
)
from armlab.bridge.control.limits import Limiter, Limits
from armlab.bridge.control.state_machine import Mode, StateMachine
from armlab.bridge.control.supervision import Settings, Supervisor, check_list
from armlab.bridge.net.sockets import Port
from armlab.errors import ControllerFailed, LinkError, NoRobot, SessionEnded
from armlab.robots import Robot
from armlab.state import Command
from armlab.wire.egm import EgmCodec, Packet

from ..conftest import Feed
from .test_state_machine import Bench

T = 0.004


class Follower(Bench):
    """State machine with the real three-packet rule, and an arm that follows unless feedback is given."""

    def __init__(self, robot: Robot, limits: Limits | None = None) -> None:
        super().__init__(Feed(robot), robot, limits)
        self.q = np.array(robot.q_home)

    def __call__(self, command: Command | None = None, **fields: Any) -> Any:
        self.see(**{"q": self.q, **fields})
        reply = self.machine.answer(command if self.machine.calls else None, T)
        if reply is not None and self.machine.ready and "q" not in fields:
            self.q = reply.q
        return reply

    def moving(self) -> Follower:
        while not self.machine.ready:
            self()
        for _ in range(300):
            self(Command(qd=np.full(self.robot.n, 0.2)))
        assert self.mode is Mode.RUNNING
        return self


@pytest.fixture
def bench(robot: Robot) -> Follower:
    return Follower(robot)


def test_the_third_plausible_packet_makes_the_robot_ready(bench: Follower) -> None:
    ready = []
    for _ in range(READY_AFTER + 1):
        reply = bench()
        np.testing.assert_allclose(reply.q, bench.robot.q_home, rtol=1e-14)
        ready.append(bench.machine.ready)
    assert ready == [False, False, True, True]


@pytest.mark.parametrize("false", [100.0, 1.0, -0.3])
@pytest.mark.parametrize("before", [0, 1, 5])
def test_two_false_packets_at_readiness_are_never_a_reference(bench: Follower, false: float, before: int) -> None:
    for _ in range(before):
        bench(mci=2)
    home = bench.robot.q_home
    replies = [bench(q=home + false), bench(q=home + false), *[bench() for _ in range(100)]]
    sent = [reply.q for reply in replies if reply is not None]
    if before >= 3 or false == 100.0:
        np.testing.assert_allclose(sent, np.broadcast_to(home, np.shape(sent)), rtol=1e-14)
    else:  # the very first packets cannot be contradicted: each is answered with its own feedback
        np.testing.assert_allclose(sent[2:], np.broadcast_to(home, np.shape(sent[2:])), rtol=1e-14)
        np.testing.assert_allclose(bench.machine.q_start, home, rtol=1e-14)
    assert bench.machine.ready
    assert bench.machine.mode is Mode.HOLDING
    assert len(bench.feed.warnings) == 1, "told once"
    assert "joint" in bench.feed.warnings[0]


def test_one_false_packet_in_motion_is_a_hold_and_three_stop_the_run(bench: Follower) -> None:
    bench.moving()
    reply = bench(Command(qd=np.full(7, 0.2)))
    assert bench.machine.answer(None, T) is bench.machine.hold(T) is reply, "a packet has one reply"
    before = bench()
    held = bench(q=bench.q + 0.5)
    assert not bench.machine.calls
    assert np.abs(held.q - before.q).max() < 0.2 * T
    assert "to change no faster than the arm can move" in bench.feed.warnings[0]
    bench(Command(qd=np.zeros(7)))
    assert (bench.machine.mode, bench.machine.calls) == (Mode.RUNNING, True)
    for k in range(int(STOP_AFTER)):
        assert bench.machine.mode is Mode.RUNNING, k
        bench(q=bench.q + 0.5)
    assert bench.machine.mode is Mode.STOPPING
    assert bench.machine.reason == "the feedback is implausible"


def test_an_arm_that_does_not_follow_stops_the_run(robot: Robot) -> None:
    for options, cycles, stops in (({}, 400, True), ({"following_error": 0.3}, 260, False)):  # 260: 0.2 rad
        bench = Follower(robot, Limits.of(robot, **options)).moving()
        stuck = bench.q
        for k in range(cycles):
            bench(Command(qd=np.full(7, 0.2)), q=stuck + 1e-4 * (k % 2))
        assert bench.machine.mode is (Mode.ENDED if stops else Mode.RUNNING)
        told = str(bench.machine.failure)
        assert ("a following error of 0.1" in told and "MaxSpeedDeviation" in told) == stops


def test_an_arm_that_follows_late_at_first_may_catch_up(robot: Robot) -> None:
    """RampInTime: the arm may lag by 0.3 s times its speed until it has caught up once."""
    middle = (robot.q_min + robot.q_max) / 2
    check, sent = FeedbackCheck(robot, Limits.of(robot)), Limiter(Limits.of(robot)).rest(middle)
    moving = sent._replace(qd=np.full(7, 1.0))
    assert check.check(middle, T, None) == ""
    for _ in range(300):
        assert check.check(middle - 0.39, 0.1, moving) == ""
    assert "following error" in check.check(middle - 0.41, T, moving)
    assert check.check(middle, 0.1, moving) == ""
    assert check.check(middle - 0.14, 0.1, moving) == ""
    assert "following error" in check.check(middle - 0.16, T, moving)


@pytest.mark.parametrize("begin", ["new", "begun again", "nothing sent"])
def test_the_larger_lag_ends_a_second_after_guidance_begins(robot: Robot, begin: str) -> None:
    middle = (robot.q_min + robot.q_max) / 2
    check, rest = FeedbackCheck(robot, Limits.of(robot)), Limiter(Limits.of(robot)).rest(middle)
    moving = rest._replace(qd=np.full(7, 1.0))

    def lags() -> bool:
        return check.check(middle - 0.39, 0.1, moving) == ""

    if begin != "new":
        for _ in range(3):
            assert check.check(middle, 0.5, moving) == ""
        assert not lags()
    if begin == "begun again":
        check.begin()
    if begin == "nothing sent":
        assert check.check(middle, 0.0, None) == ""
    assert lags()
    for dt in (0.1, 0.5, 0.3):
        assert check.check(middle, dt, rest) == ""
    assert check.check(middle - 0.39, 0.1, rest) == "", "exactly a second; the speed is not forgotten during this time"
    assert check.check(middle, 0.1, moving) == ""
    assert not lags()


def test_the_lag_allowed_for_speed_decays_when_the_reference_stops(robot: Robot) -> None:
    """Time constant 0.2 s: half of the lag remains after a cycle of 0.1 s."""
    middle = (robot.q_min + robot.q_max) / 2
    for error, words in ((0.1249, ""), (0.1251, f"joint 1 ({robot.joint_names[0]}) within 0.125 of its reference")):
        check, rest = FeedbackCheck(robot, Limits.of(robot)), Limiter(Limits.of(robot)).rest(middle)
        for _ in range(3):
            assert check.check(middle, 0.5, rest._replace(qd=np.full(7, 1.0))) == ""
        found = check.check(middle - error * np.eye(7)[0], 0.1, rest)
        assert words in found
        assert bool(words) == bool(found)


def test_feedback_that_does_not_change_is_called_frozen_after_a_tenth_of_a_second(robot: Robot) -> None:
    middle = (robot.q_min + robot.q_max) / 2
    away = Limiter(Limits.of(robot)).rest(middle + 0.2)
    for steps, words in (
        ([0.1], "Usual causes are a collision"),
        ([0.1, 0.15], "not changed for 0.25 s: it is frozen"),
    ):
        check = FeedbackCheck(robot, Limits.of(robot))
        check.check(middle, 0.1, None)
        assert words in [check.check(np.array(middle), dt, away) for dt in steps][-1]
    check.check(middle + 0.01, T, None)
    assert "Usual causes" in check.check(middle + 0.02, T, away), "it changes"


def test_the_largest_plausible_step(robot: Robot) -> None:
    """0.02 rad plus twice the speed limit, from the last plausible position."""
    middle, axis = (robot.q_min + robot.q_max) / 2, np.eye(7)[2]
    reach = 0.02 + 2.0 * robot.qd_max[2] * 0.012
    for step, is_plausible in ((0.999 * reach, True), (1.001 * reach, False)):
        check = FeedbackCheck(robot, Limits.of(robot))
        for _ in range(READY_AFTER):
            assert not check.confirmed
            assert check.check(middle, T, None) == ""
        assert check.confirmed
        assert check.check(middle - 1.5 * axis, 0.004, None)
        np.testing.assert_array_equal(check.q, middle)
        found = check.check(middle + step * axis, 0.008, None)
        assert (found == "") == is_plausible
        assert check.plausible == is_plausible
        if not is_plausible:
            assert f"joint 3 ({robot.joint_names[2]}) to change no faster" in found
            assert f"from {middle[2]:.4f} to {middle[2] + step:.4f} in 12.0 ms" in found


def test_positions_that_contradict_each_other_at_the_start_are_not_trusted(robot: Robot) -> None:
    middle, first = (robot.q_min + robot.q_max) / 2, np.eye(7)[0]
    check = FeedbackCheck(robot, Limits.of(robot))
    check.check(middle, T, None)
    for q in (middle + 0.5 * first, middle + 1.0 * first):
        assert "to change no faster" in check.check(q, T, None)
        np.testing.assert_array_equal(check.q, q)
    q = check.q
    outside = np.where(first, robot.q_max + 0.2, middle)
    assert "joint 1" in check.check(outside, T, None)
    assert check.q is q, "it is no position of this robot"
    away = Limiter(Limits.of(robot)).rest(middle)
    assert "following error" in check.check(q - 0.01 * first, T, away)
    assert check.q is not q
    assert (check.plausible, check.confirmed) == (0, False)


def test_an_arm_slightly_outside_is_held_at_its_limit_and_led_back(robot: Robot) -> None:
    bench = Follower(robot)
    bench.q = np.array(robot.q_home)
    bench.q[1] = robot.q_max[1] + 0.06
    outside = np.array(bench.q)
    while not bench.machine.ready:
        reply = bench(q=outside)
        assert (reply.q <= robot.q_max).all()
    bench.q = np.minimum(outside, robot.q_max)
    for _ in range(200):
        reply = bench(Command(qd=np.eye(7)[1] * -0.2))
    assert reply.q[1] < robot.q_max[1] - 0.1
    assert bench.machine.mode is Mode.RUNNING


def test_feedback_outside_the_range(robot: Robot) -> None:
    q = np.array(robot.q_max)
    assert outside_range(q + 0.09, robot) == ""
    q[4] += 0.2
    for words in (f"joint 5 ({robot.joint_names[4]})", f"{q[4]:.3f}", "unit"):
        assert words in outside_range(q, robot)


def test_the_following_error_is_that_of_the_axes() -> None:
    """An IRB 2400 measures axis 3 from the base: opposite changes of joints 2 and 3 leave it unchanged."""
    robot = robots.load("irb2400")
    check, sent = FeedbackCheck(robot, Limits.of(robot)), Limiter(Limits.of(robot)).rest(robot.q_home)
    apart = robot.q_home + np.array([0, 0.06, 0.06, 0, 0, 0])
    assert check.check(robot.q_home, T, None) == ""
    assert "joint 3" in FeedbackCheck(robot, Limits.of(robot)).check(apart, T, sent)
    bent = robot.q_home + np.array([0, 0.5, 0.2, 0, 0, 0])
    check = FeedbackCheck(robot, Limits.of(robot))
    assert check.check(bent, T, Limiter(Limits.of(robot)).rest(bent)) == ""
    assert "to change no faster" in check.check(robot.q_home, T, None)


def packet(packets: Any, **fields: Any) -> Packet:
    found = EgmCodec(packets.robot).decode(packets(**fields))
    assert isinstance(found, Packet)
    return found


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({}, ""),
        ({"rapid": 0}, ""),
        ({"rapid": None}, ""),
        ({"motors": 2}, "motors are off"),
        ({"motors": 0}, "the packets contain no motor state"),
        ({"rapid": 1}, "RAPID is stopped"),
        ({"mci": 2}, "EGMRunJoint"),
        ({"mci": 1}, "EGMRunJoint"),
    ],
)
def test_obstacles(packets: Any, fields: dict[str, int], words: str) -> None:
    one = packet(packets, **fields)
    found = not_ready_reason(one.motors, one.rapid, one.mci)
    assert words in found
    assert bool(found) == bool(words)


def test_one_or_two_packets_without_a_state_end_no_motion(packets: Any) -> None:
    readiness = Readiness()
    for fields in ({}, {"motors": None}, {"mci": None}, {}, {"motors": None, "mci": None}, {"motors": None}):
        assert readiness.not_ready_reason(packet(packets, **fields)) == ""
    assert "the packets contain no motor state" in readiness.not_ready_reason(packet(packets, motors=None))
    assert readiness.not_ready_reason(packet(packets)) == ""
    assert "motors are off" in readiness.not_ready_reason(packet(packets, motors=2))
    readiness.begin()  # a new session starts without known states
    assert "the packets contain no motor state" in readiness.not_ready_reason(packet(packets, motors=None))


def test_the_state_becomes_unknown_only_if_the_robot_was_ready(packets: Any) -> None:
    readiness = Readiness()
    for _ in range(4):
        assert readiness.not_ready_reason(packet(packets, motors=None))
        assert not readiness.is_unknown
    assert readiness.not_ready_reason(packet(packets)) == ""
    for is_unknown in (False, False, False, True, True):
        assert readiness.is_unknown == is_unknown
        readiness.not_ready_reason(packet(packets, motors=None))
    readiness.begin()
    assert not readiness.is_unknown


def test_a_robot_that_reports_no_states_for_a_while_comes_to_rest_and_goes_on_from_there(bench: Follower) -> None:
    bench.moving()
    late = bench.q - 0.05
    sent = [bench(q=late), *[bench(q=late, motors=None) for _ in range(30)], *[bench(q=late) for _ in range(3)]]
    q = np.array([reply.q for reply in sent if reply is not None])
    assert len(q) == 34
    assert np.abs(np.diff(q, axis=0)).max() <= 0.2 * T + 1e-12, "no step to the feedback, which lags"
    assert bench.machine.ready
    assert bench.feed.events[-1] == "The robot reports its states again."


@pytest.mark.parametrize("fields", [{"motors": None}, {"q": 0.5}], ids=["no states", "implausible"])
def test_a_fast_arm_brakes_where_nothing_is_known_of_it(robot: Robot, fields: dict[str, Any]) -> None:
    """The arm neither stops immediately nor keeps its last reference."""
    limits = replace(Limits.of(robot), qdd_max=np.full(7, 5.0))
    bench = Follower(robot, limits).moving()
    for _ in range(100):
        before = bench(Command(qd=np.full(7, 0.5)))
    if "q" in fields:
        fields = {"q": bench.q + fields["q"]}
    for _ in range(5 if "motors" in fields else 1):  # from the third packet on, the robot states are unknown
        held = bench(**fields)
        assert (held.q > before.q).all()
        np.testing.assert_allclose(held.qd, before.qd - 5.0 * T, rtol=1e-6)
        before = held


class Supervised:
    """Supervisor of a session to which tests can pass packets."""

    def __init__(self, feed: Any, robot: Robot, commands: bool = True, **settings: Any) -> None:
        self.port = Port("127.0.0.1", 0)
        self.machine = StateMachine(robot, Limits.of(robot), commands=commands)
        self.told: list[tuple[str, bool]] = []
        self.feed, feed.now = feed, time.monotonic_ns()
        self.supervisor = Supervisor(self.port, feed.session, self.machine, Settings(**settings), self.tell)

    def tell(self, text: str, warn: bool = False, each: bool = False) -> None:
        self.told.append((text, warn))

    def packet(self) -> None:
        self.machine.observe(self.feed.sample(after=0))

    def check_silence(self, silent_for: float) -> None:
        """Check as if the last packet had arrived `silent_for` seconds ago."""
        heard = time.monotonic_ns() - int(1e9 * silent_for)
        if self.feed.session._last is not None:
            self.feed.session._last.arrival_ns = heard
        self.supervisor.check_silence(heard)
        self.port.close()


def test_patience_ends_with_no_robot_and_a_check_list(feed: Any, robot: Robot) -> None:
    bench = Supervised(feed, robot, patience=7.0)
    feed.raw(b"noise", after=0)
    bench.check_silence(7.1)
    assert bench.machine.mode is Mode.ENDED
    failure = bench.machine.failure
    assert isinstance(failure, NoRobot)
    place = f"127.0.0.1:{bench.port.port}"
    for words in ("within 7 s", "1 unparsable", place, "packets only from this computer", "firewall"):
        assert words in str(failure)
    bench = Supervised(Feed(robot), robot, patience=7.0)
    bench.check_silence(7.1)
    assert f"got no packet. Listening on 127.0.0.1:{bench.port.port}. This" in str(bench.machine.failure)


def test_a_port_open_to_other_computers_is_not_called_local() -> None:
    port: Any = SimpleNamespace(host="192.168.125.9", port=6510)
    assert check_list(port).startswith("Listening on 192.168.125.9:6510. Check that")


def test_lost_descriptors_stop_the_arm(feed: Any, robot: Robot) -> None:
    bench = Supervised(feed, robot)
    bench.packet()
    bench.port.on_lost()
    bench.port.close()
    assert bench.machine.mode is Mode.STOPPING
    assert isinstance(bench.machine.failure, ControllerFailed)


def test_exactly_the_patience_is_not_too_long(feed: Any, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Supervised(feed, robot, patience=8.0)
    bench.port.close()
    now = iter([5_000_000_000, 5_000_000_001, 8_000_000_000, 8_000_000_100])
    monkeypatch.setattr("armlab.bridge.control.supervision.time", SimpleNamespace(monotonic_ns=lambda: next(now)))
    told, ended = [], []
    for _ in range(4):
        bench.supervisor.check_silence(0)
        told.append(len(bench.told))
        ended.append(bench.machine.mode is Mode.ENDED)
    assert told == [0, 1, 1, 1]
    assert bench.told[0] == (f"No packet yet. {check_list(bench.port)}", True)
    assert ended == [False, False, False, True]


def died() -> str:
    raise LinkError("Expected the simulator to go on, but it ended with status 2.")


@pytest.mark.parametrize(
    ("settings", "silent_for", "mode", "reason", "failure"),
    [
        ({}, 0.4, Mode.HOLDING, "", None),
        ({}, 0.6, Mode.WAITING, "", None),
        ({"resume": False}, 0.6, Mode.ENDED, "the controller stopped sending", None),
        ({"patience": 3.0}, 3.5, Mode.ENDED, "no packet arrived", SessionEnded),
        ({"alive": lambda: "the simulated robot ended"}, 0.0, Mode.ENDED, "the simulated robot ended", None),
        ({"alive": died}, 0.0, Mode.ENDED, "the robot is lost", LinkError),
    ],
)
def test_silence_and_a_robot_that_is_gone(
    feed: Any, robot: Robot, settings: dict[str, Any], silent_for: float, mode: Mode, reason: str, failure: Any
) -> None:
    bench = Supervised(feed, robot, **settings)
    bench.packet()
    bench.check_silence(silent_for)
    assert feed.session.active == (mode is Mode.HOLDING)
    assert (bench.machine.mode, bench.machine.reason) == (mode, reason)
    assert type(bench.machine.failure) is (failure or type(None))
    words = {SessionEnded: "the controller stopped sending", LinkError: "status 2"}
    assert words.get(failure, "") in str(bench.machine.failure)


def sessions(bench: Supervised, count: int, packets: int, **fields: Any) -> None:
    """Run `count` sessions of `packets` packets each, in immediate succession."""
    for _ in range(count):
        bench.feed.packets.seq = 0
        for k in range(packets):
            sample = bench.feed.sample(**fields)
            if k == 0 and sample.session > 1:
                bench.supervisor.judge()
            bench.machine.observe(sample)
    bench.port.close()


@pytest.mark.parametrize(
    ("packets", "fields", "settings", "ends"),
    [
        (2, {}, {}, True),
        (25, {}, {}, True),  # 24 periods: 0.096 s
        (27, {}, {}, False),
        (1, {"mci": 1}, {}, True),
        (1, {"mci": 2}, {}, False),  # the robot waits for its operator
        (1, {"mci": 2}, {"clock": "robot"}, True),
    ],
)
def test_ten_sessions_in_a_row_that_end_at_once_end_the_run(
    feed: Any, robot: Robot, packets: int, fields: dict[str, Any], settings: dict[str, Any], ends: bool
) -> None:
    bench = Supervised(feed, robot, **settings)
    sessions(bench, 10, packets, **fields)
    assert bench.machine.failure is None
    sessions(bench, 1, 1)
    assert ("a session with guidance for" in str(bench.machine.failure)) == ends


def test_a_session_that_moves_on_starts_the_count_again(feed: Any, robot: Robot) -> None:
    bench = Supervised(feed, robot)
    sessions(bench, 1, 30)
    for _ in range(3):
        sessions(bench, 9, 2)
        sessions(bench, 1, 30)
    assert bench.machine.failure is None
    sessions(bench, 11, 2)
    assert bench.machine.reason == "sessions ended immediately"


def test_sessions_of_a_listener_need_packets_only(feed: Any, robot: Robot) -> None:
    bench = Supervised(feed, robot, commands=False)
    sessions(bench, 11, 2)
    assert "a session with packets for 0.1 s" in str(bench.machine.failure)
