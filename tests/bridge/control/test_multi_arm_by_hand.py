"""Two arms in one loop on a clock of its own: what each is answered when the other is silent, not ready or anew."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.control.state_machine import Mode
from armlab.errors import CommandRefused
from armlab.state import Command, State
from armlab.wire.egm.robot_side import RobotSideCodec

from .by_hand import MS, Hands, Make, drift

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Make:
    """Return what makes a loop of two arms."""
    return lambda controller, **options: Hands(monkeypatch, [LEFT, RIGHT], controller, **options)


@pytest.mark.parametrize(("period", "longest"), [(4, 20), (8, 24)])
def test_an_arm_unheard_for_three_periods_and_20_ms_holds_the_one_that_paces(
    two: Make, period: int, longest: int
) -> None:
    called: list[int] = []

    def controller(state: State) -> None:
        called.append(hands.clock.now)

    hands = two(controller, period_ns=period * MS)
    for _ in range(20):
        hands.cycle(1, 0)
    before = len(called)
    for _ in range(longest // period):
        hands.cycle(0)
    assert len(called) == before + longest // period
    hands.cycle(0, after=1)
    assert len(called) == before + longest // period
    hands.cycle(1, 0)
    assert len(called) == before + longest // period + 1


def test_a_session_that_begins_while_the_controller_computes_is_not_sent_its_command(two: Make) -> None:
    def controller(state: State) -> Command:
        if state.seq == 20:
            hands.robots[0].seq = 0
            hands.put(0, q=hands.robots[0].q + 0.3)
        return drift(state)

    hands = two(controller)
    for _ in range(20):
        hands.cycle(0, 1)
    assert hands.speed(1) == pytest.approx(0.1)
    assert min(row[1] is not None for row in hands.rows[-2:])
    hands.cycle(0)
    first = hands.reply(0)
    assert first is not None
    assert (first.seqno, hands.speed(0)) == (0, 0.0)
    assert hands.rows[-1][1] is None
    hands.cycle(1)
    assert hands.speed(1) < 0.05


def test_a_command_that_is_none_for_two_arms_holds_both_and_is_the_reason(two: Make) -> None:
    hands = two(lambda state: Command(np.zeros(7)))
    hands.cycle(1, 0)
    hands.cycle(1, 0)
    assert hands.loop.reason == "a command was refused"
    assert isinstance(hands.loop.failure, CommandRefused)
    assert [len(port.sent) for port in hands.ports] == [2, 2]
    assert [arm.guide.mode for arm in hands.arms] == [Mode.STOPPING] * 2


def test_an_arm_that_stops_stops_the_other(two: Make) -> None:
    hands = two(drift)
    for _ in range(20):
        hands.cycle(0, 1)
    hands.arms[1].guide.stop("enough of this arm")
    hands.run(0, 1)
    assert (hands.loop.reason, hands.loop.failure) == ("enough of this arm", None)
    assert [arm.guide.mode for arm in hands.arms] == [Mode.ENDED] * 2
    assert hands.speed(0) == hands.speed(1) == 0.0


def test_the_guard_answers_the_other_arm_too(two: Make) -> None:
    def controller(state: State) -> Command:
        if state.seq == 5:
            hands.put(1, after=4 * MS)
            hands.loop.answer_for_controller()
            assert [len(port.sent) for port in hands.ports] == [6, 6]
        return drift(state)

    hands = two(controller)
    for _ in range(5):
        hands.cycle(0, 1)
    hands.cycle(0)
    assert [len(port.sent) for port in hands.ports] == [6, 6]


def test_in_lockstep_no_arm_is_stale(two: Make) -> None:
    called: list[int] = []
    hands = two(lambda state: called.append(state.seq), clock="robot")
    hands.cycle(1, 0)
    for _ in range(20):
        hands.cycle(0)
    assert len(called) == 21


def test_nobody_is_asked_before_all_arms_have_been_heard(two: Make) -> None:
    called: list[int] = []
    hands = two(lambda state: called.append(state.seq))
    hands.cycle(0)
    hands.cycle(0)
    assert not called
    hands.cycle(1)
    hands.cycle(0)
    assert called == [2]


def test_a_command_serves_another_arm_for_two_and_a_half_periods(two: Make) -> None:
    hands = two(drift)
    for _ in range(20):
        hands.cycle(0, 1)
    assert hands.speed(1) == pytest.approx(0.1)
    speeds = []
    for _ in range(2):  # the second is the third packet of this command
        hands.cycle(1)
        speeds.append(hands.speed(1))
    assert speeds[0] == pytest.approx(0.1)
    assert speeds[1] < 0.05


def test_a_command_of_a_session_serves_in_no_later_one(two: Make) -> None:
    """Both arms begin anew after 0.3 s of silence, the one that does not pace first."""
    hands = two(drift)
    for _ in range(20):
        hands.cycle(0, 1)
    assert hands.speed(1) == pytest.approx(0.1)
    hands.clock.now += 300 * MS
    for packets in hands.robots:
        packets.seq, packets.cycle = 0, packets.cycle + 75
    hands.cycle(1)
    np.testing.assert_allclose(hands.table(1)["q_sent"][-1], hands.robots[1].q, atol=1e-9)
    assert (hands.arms[1].session.number, hands.speed(1), hands.rows[-1][1]) == (2, 0.0, None)


def test_values_for_rapid_go_out_once(two: Make) -> None:
    """With the first reply to their command that goes out; the rest of the command serves on."""

    def controller(state: State) -> tuple[None, Command]:
        return None, Command(qd=np.full(7, 0.1), rapid_data=[float(state.seq)], rapid_digital=True)

    hands = two(controller)
    hands.robots[1].codec = RobotSideCodec(RIGHT, "7")
    for _ in range(20):
        hands.cycle(0, 1)
    hands.cycle(1)
    hands.cycle(0)
    hands.ports[1].works = False
    hands.cycle(1)
    hands.ports[1].works = True
    hands.cycle(1)
    hands.cycle(1)
    table = hands.table(1)
    np.testing.assert_array_equal(table["rapid_data_sent"][-6:, 0], [18.0, 19.0, np.nan, np.nan, 20.0, np.nan])
    np.testing.assert_array_equal(np.isfinite(table["rapid_digital_sent"][-4:].astype(float)), [0, 0, 1, 0])
    np.testing.assert_allclose(table["qd_sent"][[-4, -2], 0], 0.1)


def test_the_pacing_arm_that_holds_takes_its_command_from_the_others(two: Make) -> None:
    hands = two(drift)
    for _ in range(20):
        hands.cycle(0, 1)
    hands.cycle(0, mci=2)
    hands.cycle(1)
    assert hands.speed(1) < 0.0999
    assert np.isnan(hands.table(1)["qd_ref"][-1].astype(float)).all()


def test_an_arm_that_is_not_ready_or_unheard_holds_the_third(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, not when the command that was given has served its time."""
    for unready in (True, False):
        hands = Hands(monkeypatch, [LEFT, RIGHT, RIGHT], drift)
        for _ in range(20):
            hands.cycle(0, 1, 2)
        assert hands.speed(2) == pytest.approx(0.1)
        if unready:
            hands.cycle(1, mci=2)
        else:
            for _ in range(5):
                hands.cycle(0, 2)
            assert hands.speed(2) == pytest.approx(0.1)
            hands.cycle(0)
        hands.cycle(2)
        assert hands.speed(2) < 0.05


def test_others_that_wait_are_answered_before_the_controller_is_called(two: Make) -> None:
    sent: list[int] = []

    def controller(state: State) -> Command:
        sent.append(len(hands.ports[1].sent))
        return drift(state)

    hands = two(controller)
    for _ in range(3):
        hands.cycle(1, 0)
    hands.put(0)
    hands.put(1, after=0)
    hands.loop.cycle()
    assert sent == [1, 2, 3, 4]


def test_time_begins_with_the_newest_session_of_all_arms_and_ages_are_told(two: Make) -> None:
    seen: list[State] = []
    hands = two(lambda state: seen.append(state))
    for _ in range(5):
        hands.cycle(0)
    hands.cycle(1)
    for _ in range(3):
        hands.cycle(0)
    np.testing.assert_allclose([state.t for state in seen], [0.0, 0.004, 0.008], atol=1e-12)
    np.testing.assert_allclose(
        [[arm.age for arm in state.arms] for state in seen], [[0, 0.004], [0, 0.008], [0, 0.012]]
    )
    hands.robots[1].seq = 0
    hands.cycle(1, 0)
    hands.cycle(1, 0)
    np.testing.assert_allclose([state.t for state in seen[3:]], [0.0, 0.004], atol=1e-12)
