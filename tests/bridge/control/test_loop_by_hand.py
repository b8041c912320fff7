"""The loop packet by packet, on a clock of its own: when it asks, looks, blames, and what the guard does meanwhile."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.control.state_machine import Mode
from armlab.errors import ControllerLate
from armlab.state import Command, State

from .by_hand import MS, Hands, Make, drift

RIGHT = robots.load("yumi_right")


@pytest.fixture
def one(monkeypatch: pytest.MonkeyPatch) -> Make:
    """Return what makes a loop of one arm."""
    return lambda controller, **options: Hands(monkeypatch, [RIGHT], controller, **options)


def test_an_interrupt_stops_at_the_next_packet_and_the_second_at_once(one: Make) -> None:
    hands = one(drift)
    hands.cycle()
    hands.loop.interrupt()
    assert hands.loop.reason == ""
    hands.cycle()
    assert hands.loop.reason == "interrupted"
    assert hands.arms[0].guide.mode is Mode.STOPPING
    with pytest.raises(KeyboardInterrupt):
        hands.loop.interrupt()


@pytest.mark.parametrize("before", [0, 1])
@pytest.mark.parametrize("clock", ["wall", "robot"])
def test_an_interrupt_breaks_off_a_call_that_hangs_and_the_arm_comes_to_rest(
    one: Make, clock: str, before: int
) -> None:
    """After more than a second in the call; a first one that came before did not, nor is it the second one then."""
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
    assert hands.arms[0].guide.mode is Mode.ENDED
    assert hands.loop.interrupted
    if clock == "wall":
        assert isinstance(hands.loop.failure, ControllerLate)
        assert "one call took 1.00 s" in str(hands.loop.failure)
    else:
        assert (hands.loop.failure, hands.loop.reason) == (None, "interrupted")


def test_a_call_that_hangs_is_told_once_after_a_second(one: Make) -> None:
    sentence = (
        "The controller has not returned for 1 s; the arm is held meanwhile. Ctrl-C breaks it off and ends the run."
    )

    def controller(state: State) -> Command:
        if state.seq == 5:
            start = hands.clock.now
            for wait in (400, 800, 1000, 1000 + 1e-6, 1400, 1800, 2200, 2600):  # ms
                hands.put(after=start + int(wait * MS) - hands.clock.now)
                hands.loop._hold_for_controller()
                assert hands.warned == [sentence] * (wait > 1000)
        return drift(state)

    hands = one(controller)
    for _ in range(6):
        hands.cycle()
    assert isinstance(hands.loop.failure, ControllerLate)


def test_an_interrupt_is_seen_while_nothing_comes(one: Make) -> None:
    hands = one(drift)
    hands.cycle()
    hands.loop.interrupt()
    hands.loop.cycle()
    assert hands.loop.reason == "interrupted"


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
    hands.cycle(after=2 * MS)  # exactly 50 ms after the last one
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
    """Held and late, a reply for each packet; what the controller returns at last is thrown away."""
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
    assert "step_ns" not in table.values  # none of the calls took time but the one that was thrown away
    np.testing.assert_allclose(np.abs(table["qd_sent"][9:13]).max(axis=1), [0.1, 0.0, 0.0, 0.1], atol=1e-12)
    assert (loop.reason, loop.failure) == ("", None)


@pytest.mark.parametrize(
    ("waited", "took", "late", "stops"),
    [
        (0, 3.01, 5, True),
        (0, 2.9, 0, False),
        (2.5, 1.0, 5, False),  # late, and not by the controller's fault
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


def test_in_lockstep_a_controller_takes_what_time_it_likes(one: Make) -> None:
    def controller(state: State) -> Command:
        hands.clock.now += 10**9
        return drift(state)

    hands = one(controller, clock="robot")
    for _ in range(10):
        hands.cycle()
    assert hands.loop.reason == ""
    assert not hands.table()["late"].any()


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


def test_the_time_is_up(one: Make) -> None:
    exactly = one(drift, seconds=0.008)
    for reason in ("", "", "the time is up"):
        exactly.cycle()
        assert exactly.loop.reason == reason
    hands = one(drift, seconds=0.1)
    for _ in range(25):
        hands.cycle()
    assert hands.loop.reason == ""
    hands.cycle()
    assert hands.loop.reason == "the time is up"


def test_what_is_no_packet_gets_no_answer(one: Make) -> None:
    hands = one(drift)
    hands.cycle()
    hands.ports[0].waiting.append(hands.garbage())
    hands.loop.cycle()
    assert len(hands.ports[0].sent) == 1


def test_one_arm_is_seen_as_it_is(one: Make) -> None:
    seen: list[State] = []
    hands = one(seen.append)
    hands.cycle()
    assert hands.arms[0].newest is not None
    assert seen[0] is hands.arms[0].newest.state


def test_a_run_that_has_ended_waits_for_nothing(one: Make) -> None:
    hands = one(drift)
    hands.loop.interrupt()
    hands.loop.cycle()
    assert hands.arms[0].guide.mode is Mode.ENDED
    hands.loop.run()
    assert len(hands.waits) == 1
