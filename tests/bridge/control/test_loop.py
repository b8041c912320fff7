"""The loop, packet by packet: controller calls, checks, lateness reports, the guard, and the packets sent."""

from __future__ import annotations

import errno
import math
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import Limits
from armlab.bridge.control.arm import End
from armlab.bridge.control.loop import DryRun
from armlab.bridge.control.state_machine import Mode
from armlab.bridge.net.sockets import Arrival
from armlab.errors import CommandRefused, ControllerFailed, ControllerLate, LinkError
from armlab.log import Column
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Drop, EgmCodec, Reference
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage

from .conftest import CONTROLLER, MS, Make, drift


def test_an_interrupt_stops_at_the_next_packet_and_the_second_at_once(one: Make) -> None:
    hands = one(drift)
    hands.cycle()
    hands.loop.interrupt()
    assert hands.loop.reason == ""
    hands.cycle()
    assert hands.loop.reason == "interrupted"
    assert hands.arms[0].machine.mode is Mode.STOPPING
    with pytest.raises(KeyboardInterrupt):
        hands.loop.interrupt()
    hands = one(drift)  # a run that has ended does not wait
    hands.loop.interrupt()
    hands.loop.cycle()
    assert hands.arms[0].machine.mode is Mode.ENDED
    hands.loop.run()
    assert len(hands.waits) == 1


@pytest.mark.parametrize("before", [0, 1])
@pytest.mark.parametrize("clock", ["wall", "robot"])
def test_an_interrupt_breaks_off_a_call_that_hangs_and_the_arm_comes_to_rest(
    one: Make, clock: str, before: int
) -> None:
    raised: list[int] = []

    def controller(state: State) -> Command:
        if state.seq == 10:
            for _ in range(before):
                hands.loop.interrupt()
            hands.clock.now += 1000 * MS
            if not before:
                assert not hands.loop._hangs
            hands.clock.now += 1
            if clock == "wall":
                hands.loop.answer_for_controller()
            raised.append(len(hands.ports[0].sent))
            hands.loop.interrupt()
            pytest.fail("it goes on")
        return drift(state)

    hands = one(controller, clock=clock)
    for _ in range(10):
        hands.cycle()
    assert hands.speed() == pytest.approx(0.1)
    hands.run()
    assert raised == [11 if clock == "wall" else 10]
    assert hands.speed() == 0.0
    assert hands.arms[0].machine.mode is Mode.ENDED
    assert hands.loop.interrupted
    if clock == "wall":
        assert isinstance(hands.loop.failure, ControllerLate)
        assert "one call took 1.00 s" in str(hands.loop.failure)
    else:
        assert (hands.loop.failure, hands.loop.reason) == (None, "interrupted")


def test_a_call_that_hangs_is_told_once_after_a_second(one: Make) -> None:
    def controller(state: State) -> Command:
        if state.seq == 5:
            start = hands.clock.now
            for wait in (400, 800, 1000, 1000 + 1e-6, 1400, 1800, 2200, 2600):  # ms
                hands.put(after=start + int(wait * MS) - hands.clock.now)
                hands.loop._hold_for_controller()
                assert len(hands.warned) == (wait > 1000)
                assert all(text.startswith("The controller has not returned for 1 s; ") for text in hands.warned)
        return drift(state)

    hands = one(controller)
    for _ in range(6):
        hands.cycle()
    assert isinstance(hands.loop.failure, ControllerLate)


def test_the_controller_of_one_arm_gets_the_state_that_is_recorded(one: Make) -> None:
    seen: list[State] = []
    hands = one(seen.append)
    for _ in range(3):
        hands.cycle(T_frame_tool=np.eye(4))
    assert all(state is row[0] for state, row in zip(seen, hands.rows, strict=True))
    assert [state.arms for state in seen] == [()] * 3
    np.testing.assert_allclose(seen[0].T_frame_tool, np.eye(4))


def test_looks_come_when_nothing_came_and_twenty_times_a_second(one: Make) -> None:
    looks: list[int] = []

    def alive() -> str:
        looks.append(hands.clock.now)
        return ""

    hands = one(drift, alive=alive)
    for _ in range(26):
        hands.cycle()
    assert len(looks) == 2
    begun = hands.clock.now - 26 * 4 * MS
    assert [(ns - begun) // MS for ns in looks] == [52, 104]
    hands.loop.cycle()
    hands.loop.cycle()
    assert len(looks) == 4
    assert hands.waits == [0.05] * 28
    for _ in range(12):
        hands.cycle()
    assert len(looks) == 4
    hands.cycle(after=2 * MS)  # exactly 50 ms after the last check
    assert len(looks) == 4
    hands.cycle(after=1)
    assert len(looks) == 5


@pytest.mark.parametrize(("waited", "left"), [(0, 3.0), (1, 2.0), (2, 1.0), (3, 1.0), (10, 1.0)])
def test_the_controller_has_until_three_quarters_of_the_period_and_a_quarter_in_any_case(
    one: Make, waited: int, left: float
) -> None:
    seen: list[float] = []

    def controller(state: State) -> Command:
        seen.append(1e3 * hands.loop.overdue())
        hands.clock.now += 500_000
        seen.append(1e3 * hands.loop.overdue())
        return drift(state)

    hands = one(controller)
    hands.cycle(mci=2)
    assert hands.loop.overdue() == 1.0
    hands.put()
    hands.clock.now += waited * MS
    hands.loop.cycle()
    assert hands.loop.overdue() == 1.0
    np.testing.assert_allclose(seen, [left, left - 0.5], atol=1e-6)


def test_the_guard_answers_for_a_controller_that_is_overdue(one: Make) -> None:
    called: list[int] = []

    def controller(state: State) -> Command:
        called.append(state.seq)
        if state.seq == 10:
            loop.answer_for_controller()  # too early: nothing
            assert len(port.sent) == 10
            assert not clock.slept
            clock.now += 4 * MS
            loop.answer_for_controller()
            assert (len(port.sent), loop.overdue()) == (11, 0.0)
            loop.answer_for_controller()  # nothing came since
            assert (len(port.sent), clock.slept) == (11, [2e-3])
            hands.put()
            loop.answer_for_controller()
            assert (len(port.sent), clock.slept) == (12, [2e-3] * 2)
            assert len(hands.table()) == 12
        return drift(state)

    hands = one(controller)
    loop, port, clock = hands.loop, hands.ports[0], hands.clock
    for _ in range(11):
        hands.cycle()
    assert len(port.sent) == 12
    loop.answer_for_controller()
    assert len(port.sent) == 12
    for _ in range(3):
        hands.cycle()
    assert called == [*range(11), 12, 13, 14]
    table = hands.table()
    np.testing.assert_array_equal(np.flatnonzero(table["late"]), [10, 11])
    np.testing.assert_array_equal(table["seq_sent"], np.arange(15))
    assert np.isnan(table["qd_ref"][10:12].astype(float)).all()
    assert "step_ns" not in table.values  # only the discarded call took time
    np.testing.assert_allclose(np.abs(table["qd_sent"][9:13]).max(axis=1), [0.1, 0.0, 0.0, 0.1], atol=1e-12)
    assert (loop.reason, loop.failure) == ("", None)


@pytest.mark.parametrize(
    ("waited", "took", "late", "stops"),
    [
        (0, 3.01, 5, True),
        (0, 2.9, 0, False),
        (2.5, 1.0, 5, False),  # late, but not because of the controller
        (1.5, 2.0, 5, False),
        (1.5, 2.01, 5, True),
    ],
)
def test_the_controller_is_blamed_for_late_replies_when_it_took_more_than_half_a_period(
    one: Make, waited: float, took: float, late: int, stops: bool
) -> None:
    def controller(state: State) -> Command:
        hands.clock.now += int(took * MS)
        return Command(state.q_start)

    hands = one(controller)
    hands.cycle(mci=2)
    for count in range(5):
        assert hands.loop.reason == "", count
        hands.put()
        hands.clock.now += int(waited * MS)
        hands.loop.cycle()
    assert hands.table()["late"].sum() == late
    np.testing.assert_array_equal(hands.table()["step_ns"][1:], int(took * MS))
    assert (hands.loop.reason == "the controller was late") == stops
    assert isinstance(hands.loop.failure, ControllerLate) == stops


@pytest.mark.parametrize(
    ("clock", "took", "collects"),
    [("wall", 2.9, True), ("wall", 3.0, True), ("wall", 3.1, False), ("robot", 3.1, True)],
)
def test_garbage_is_collected_with_a_millisecond_to_spare(
    one: Make, monkeypatch: pytest.MonkeyPatch, clock: str, took: float, collects: bool
) -> None:
    collected: list[bool] = []
    monkeypatch.setattr("armlab.bridge.control.loop.collect_if_due", lambda: collected.append(True))

    def controller(state: State) -> None:
        hands.clock.now += int(took * MS)

    hands = one(controller, clock=clock)
    hands.loop.cycle()
    assert collected == [True]  # nobody is there
    hands.cycle()
    assert len(collected) == 1 + collects


def test_progress_is_told_ten_times_a_second(one: Make) -> None:
    told: list[float] = []
    hands = one(drift, progress=told.append)
    for _ in range(76):
        hands.cycle()
    np.testing.assert_allclose(told, [0.0, 0.1, 0.2, 0.3], atol=1e-9)


@pytest.mark.parametrize(("seconds", "cycles"), [(0.008, 3), (0.1, 26)])
def test_the_time_is_up(one: Make, seconds: float, cycles: int) -> None:
    hands = one(drift, seconds=seconds)
    for count in range(1, cycles + 1):
        hands.cycle()
        assert hands.loop.reason == ("the time is up" if count == cycles else "")


def test_an_interrupt_in_a_call_that_does_not_hang_is_the_controllers_or_the_second_one(one: Make) -> None:
    def controller(state: State) -> Command:
        raise KeyboardInterrupt

    hands = one(controller)
    hands.cycle()
    assert isinstance(hands.loop.failure, ControllerFailed)
    assert isinstance(hands.loop.failure.__cause__, KeyboardInterrupt)
    hands = one(controller)
    hands.cycle(mci=2)
    hands.loop.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        hands.cycle()


@pytest.mark.parametrize("method", ["decode", "encode"])
def test_an_error_while_the_guard_answers_ends_the_run_and_the_guard_goes_on(
    one: Make, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    def controller(state: State) -> Command:
        if state.seq == 5:
            hands.put()
            with monkeypatch.context() as patch:
                patch.setattr(hands.arms[0].codec, method, lambda data: 1 / 0)
                hands.loop.answer_for_controller()
        return drift(state)

    hands = one(controller)
    for _ in range(6):
        hands.cycle()
    assert len(hands.ports[0].sent) == 5  # the packet has been taken: the controller's reply would be late
    assert hands.loop.reason == "the bridge failed"
    assert isinstance(hands.loop.failure, LinkError)
    assert isinstance(hands.loop.failure.__cause__, ZeroDivisionError)


def test_a_run_ends_when_an_error_comes_again(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    hands = one(drift)
    for _ in range(5):
        hands.cycle()
    errors: list[Exception] = [ZeroDivisionError("division by zero"), ValueError("another")]

    def raises(reference: Any) -> bytes:
        raise errors.pop(0)

    monkeypatch.setattr(hands.arms[0].codec, "encode", raises)
    for _ in range(2):
        hands.put()
    coming = list(hands.ports[0].waiting)
    hands.ports[0].waiting.clear()
    monkeypatch.setattr(hands, "next", lambda seconds: (0, coming.pop(0)) if coming else None)
    hands.loop.run()
    assert not coming
    assert "ZeroDivisionError: division by zero" in str(hands.loop.failure)
    assert isinstance(hands.loop.failure, LinkError)
    assert hands.warned == [str(hands.loop.failure)]


@pytest.mark.parametrize("fails", [1, 1000])
def test_a_run_that_stops_already_ends_with_the_error(one: Make, fails: int) -> None:
    hands, failed = one(drift), []
    hands.cycle()
    hands.loop.interrupt()
    hands.loop.cycle()
    encode = hands.arms[0].codec.encode

    def fails_at_first(reference: Any) -> bytes:
        failed.append(reference)
        return encode(reference) if len(failed) > fails else 1 / 0  # type: ignore[return-value]

    hands.arms[0].codec.encode = fails_at_first  # type: ignore[method-assign]
    hands.run()
    assert hands.loop.reason == "interrupted"
    assert "ZeroDivisionError" in str(hands.loop.failure)
    assert len(failed) >= min(fails, 2)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError("of whatever"), "raised MemoryError: out of memory. The arm"),
        (ValueError("bad luck"), "raised ValueError: bad luck. The arm"),
        (ValueError(), "raised ValueError. The arm"),
    ],
)
def test_what_fails_is_named_and_memory_is_given_back(one: Make, error: Exception, words: str) -> None:
    def raises(_: Any) -> None:
        raise error

    for hands in (one(raises), one(drift, progress=raises)):
        hands.cycle()
        assert isinstance(hands.loop.failure, ControllerFailed)
        assert hands.loop.failure.__cause__ is error
        assert words in str(hands.loop.failure)


@pytest.mark.parametrize("where", ["controller", "progress", "bridge"])
def test_memory_is_given_back_before_words_are_made(one: Make, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    reserve = SimpleNamespace(close=lambda: told.append("given back"))
    told: list[str] = []
    monkeypatch.setattr("armlab.bridge.control.loop.mmap", lambda file, size: told.append(f"{size} bytes") or reserve)

    class Looks(Exception):
        def __str__(self) -> str:
            return ", ".join(told)

    def raises(_: Any) -> None:
        assert told == ["16777216 bytes"]
        raise Looks

    hands = one(raises if where == "controller" else drift, **({"progress": raises} if where == "progress" else {}))
    if where == "bridge":
        encode, left = hands.arms[0].codec.encode, [1]
        hands.arms[0].codec.encode = lambda reference: raises(left.pop()) if left else encode(reference)
    hands.run()
    assert "16777216 bytes, given back" in str(hands.loop.failure)


def test_a_run_takes_memory_for_its_end_and_gives_it_back(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(*_: Any) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    told: list[str] = []
    reserve = SimpleNamespace(close=lambda: told.append("given back"))
    monkeypatch.setattr("armlab.bridge.control.loop.mmap", lambda file, size: told.append(f"{size} bytes") or reserve)
    hands = one(drift, seconds=0.02)
    hands.run()
    assert (told, hands.loop.failure) == (["16777216 bytes", "given back"], None)
    monkeypatch.setattr("armlab.bridge.control.loop.mmap", none_left)
    hands = one(drift)
    with pytest.raises(LinkError, match=r"^Expected 16 MiB of free memory for the end of the run: Cannot allocate"):
        hands.run()
    assert hands.loop.reason == "not enough memory to end the run"
    assert not hands.ports[0].sent


def test_an_error_that_cannot_be_told_brings_the_arm_to_rest(one: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    class Mute(Exception):
        def __str__(self) -> str:
            raise MemoryError

    def raises(*_: Any, **__: Any) -> None:
        raise MemoryError

    hands = one(drift)
    for _ in range(10):
        hands.cycle()
    encode, left = hands.arms[0].codec.encode, [Mute()]

    def fails_once(reference: Any) -> bytes:
        if left:
            monkeypatch.setattr(hands.arms[0].recording, "event", raises)
            raise left.pop()
        monkeypatch.undo()
        return encode(reference)

    hands.arms[0].codec.encode = fails_once  # type: ignore[method-assign]
    hands.run()
    assert hands.speed() == 0.0
    assert hands.loop.reason == "the bridge failed"
    assert str(hands.loop.failure) == "Expected the cycle to run without errors, got Mute: unreadable text."


def test_a_stop_of_which_the_system_sends_nothing_ends_the_run(one: Make) -> None:
    hands = one(drift)
    for _ in range(10):
        hands.cycle()
    hands.ports[0].works = False
    hands.loop.interrupt()
    count = 0
    while not hands.loop._have_ended():
        assert count < 1000
        hands.cycle()
        count += 1
    assert count == 501  # the first is the packet after which the interrupt is noticed
    assert isinstance(hands.loop.failure, LinkError)
    assert any("Expected to send the replies that bring the arm to rest" in text for text in hands.warned)


def sway(state: State) -> Command:
    return Command(state.q_start + 0.05 * math.sin(3.0 * state.t) * np.ones(7))


def test_a_flood_of_garbage_changes_no_reference(one: Make) -> None:
    rng, tables = np.random.default_rng(5), list[Any]()
    for noisy in (True, False):
        hands = one(sway)
        packets, port = hands.robots[0], hands.ports[0]
        hands.cycle()
        for _ in range(100 * noisy):
            good = packets()
            packets.seq, packets.cycle = packets.seq - 1, packets.cycle - 1
            garbage = [
                rng.bytes(int(rng.integers(0, 1500))),
                good[: rng.integers(60)],
                b"\x0a\x06\x08\x05\x10\x01\x18\x03" + good[11:],
                EgmCodec(packets.robot).encode(Reference(packets.q, None, None, 5, 5)),
            ]
            for _ in range(20):
                port.waiting.append(Arrival(garbage[rng.integers(4)], CONTROLLER, hands.clock.now))
                data = [good, good[: rng.integers(len(good))]][rng.integers(2)]
                port.waiting.append(Arrival(data, ("10.0.0.9", 5000), hands.clock.now))
            hands.cycle()
        for _ in range(100 * (not noisy)):
            hands.cycle()
        assert len(port.sent) == 101
        assert any("Dropped a datagram from " in text for text in hands.warned) == noisy
        tables.append(hands.table())
    np.testing.assert_array_equal(tables[0]["q_sent"], tables[1]["q_sent"])


def test_what_is_not_finite_never_reaches_the_wire(play: Any) -> None:
    def controller(state: State) -> Command:
        return Command(np.full(7, math.nan)) if state.seq >= 20 else sway(state)

    def script(peer: Any) -> None:
        peer.rest()
        for reply in peer.replies:
            assert np.isfinite(reply.q).all()
            assert np.isfinite(reply.qd).all()

    with pytest.raises(CommandRefused, match="finite") as caught:
        play(script, controller)
    table = caught.value.table
    assert len(table) > 100
    assert np.isfinite(table["q_sent"]).all()
    np.testing.assert_array_equal(table["qd_sent"][-1], 0.0)
    assert table["q_sent"][22:].max() <= table["q_sent"][19].max() + 0.01


def test_listening_writes_nothing(play: Any) -> None:
    def script(peer: Any) -> None:
        while not peer.over.is_set():
            peer.send()
            time.sleep(0.001)

    run = play(script, None, play.link(clock="wall"), wait="spin", seconds=0.004 * 40)
    assert play.peer.surplus() == 0
    assert run.statistics["replies"] == 0
    assert len(run.table) >= 40
    assert "q_sent" not in run.table


def test_a_busy_controller_is_answered_for_by_the_guard(play: Any) -> None:
    asleep, done = threading.Event(), threading.Event()

    def controller(state: State) -> Command:
        if state.t > 0.1 and not asleep.is_set():
            asleep.set()
            done.wait(5.0)
        return Command(qd=np.full(7, 0.2))

    def script(peer: Any) -> None:
        peer.begin()
        while not asleep.is_set():
            peer.cycle()
            time.sleep(0.004)
        held = []
        until = time.monotonic() + 0.3
        while time.monotonic() < until or len(held) <= 10:
            held += [peer.cycle()]
            time.sleep(0.004)
        assert np.abs(held[-1].qd).max() == 0.0
        done.set()
        peer.rest(pause=0.004)

    with pytest.raises(ControllerLate, match=r"^The controller was too slow: one call took 0\.\d+ s") as caught:
        play(script, controller, play.link(clock="wall"), wait="block")
    table = caught.value.table
    assert play.peer.surplus() == 0
    assert table["late"].sum() > 10
    answered = np.asarray(table["seq_sent"], dtype=float)
    np.testing.assert_array_equal(answered[np.isfinite(answered)], np.arange(np.isfinite(answered).sum()))


def test_progress_extra_columns_and_own_limits(play: Any, robot: Robot) -> None:
    told: list[tuple[float, float, str]] = []
    run = play(
        lambda peer: peer.rest(),
        lambda state: Command(sway(state).q, record={"mine": state.t}),
        seconds=0.2,
        progress=lambda *what: told.append(what),
        extra={"mine": Column(unit="s")},
        limits=Limits.of(robot, speed=0.01),
    )
    assert told == sorted(told)
    assert 2 <= len(told) <= 8
    np.testing.assert_allclose(run.table["mine"][2:50], run.table["session_t"][2:50])
    assert np.abs(run.table["qd_sent"]).max() <= 0.01 * robot.qd_max.max() + 1e-9


@pytest.mark.parametrize("name", ["yumi_right", "irb2400", "ur5e"])
def test_a_dry_run_replies_as_a_cycle_does_and_leaves_no_trace(name: str, caplog: pytest.LogCaptureFixture) -> None:
    robot = robots.load(name)
    codec = EgmCodec(robot, extension=True)
    codec.robotware = "6.06"  # from the previous run
    with caplog.at_level(0):
        dry_run = DryRun(End(robot, None, codec), Limits.of(robot))  # type: ignore[arg-type]
        arm, sent = dry_run._loop._arms[0], list[bytes]()
        before = arm.replies
        dry_run()
        assert arm.replies == before + 1
        assert (arm.session.missed, arm.newest.state.robotware) == (0, "6.10")
        dry_run.send = lambda data, to: not sent.append(data)  # type: ignore[method-assign]
        dry_run()
    assert len(sent) == 1
    reply = RobotSideCodec(robot).decode_sensor(sent[0])
    assert isinstance(reply, SensorMessage)
    np.testing.assert_allclose(reply.q, robot.q_home, atol=1e-12)
    assert arm.machine.mode is Mode.RUNNING
    assert not arm.rows
    assert (codec.robotware, caplog.records) == ("6.06", [])


def test_a_dry_run_of_which_the_codec_drops_the_packet_sends_nothing() -> None:
    class Deaf(EgmCodec):
        def decode(self, data: bytes) -> Drop:
            return Drop("unparsable", "of no use")

    robot = robots.load("yumi_right")
    dry_run = DryRun(End(robot, None, Deaf(robot)), Limits.of(robot))  # type: ignore[arg-type]
    dry_run()
    assert dry_run._loop._arms[0].replies == 0
