"""Several arms in one loop: states, commands, and replies while one arm is silent, not ready or restarting."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import bridge, log
from armlab.bridge.control.loop import merge_states, split_command
from armlab.bridge.control.state_machine import Mode
from armlab.errors import CommandRefused, NoRobot, UnknownName
from armlab.state import Command, State
from armlab.wire.egm.robot_side import RobotSideCodec

from .conftest import LEFT, MS, RIGHT, Hands, Make, drift


def moving(hands: Hands) -> Hands:
    """Deliver twenty packets to each of two arms; the second then moves at full speed."""
    for _ in range(20):
        hands.cycle(0, 1)
    assert hands.speed(1) == pytest.approx(0.1)
    return hands


def test_merged_states() -> None:
    def state(robot: str, k: int) -> State:
        return State(k, 0.004, *(np.full(7, j * k) for j in (1.0, 2.0, 3.0)), robot=robot, t_receive=k, seq=k)

    paced = state("b", 2)
    both = merge_states([state("a", 1), paced], [0.003, 0.0], 1, 5.0)
    assert (both.t, both.dt, both.seq, both.robot, both.t_receive, both.age) == (5.0, 0.004, 2, "a+b", 2, 0.0)
    np.testing.assert_array_equal(both.q, [1.0] * 7 + [2.0] * 7)
    np.testing.assert_array_equal(both.tau, [3.0] * 7 + [6.0] * 7)
    assert [arm.age for arm in both.arms] == [0.003, 0.0]
    assert both.arms[1] is paced
    newer = merge_states([state("a", 1), paced], [-0.001, 0.0], 1, 5.0)  # its packet came after the other arm's
    assert [arm.age for arm in newer.arms] == [0.0, 0.0]
    np.testing.assert_array_equal(both.arms[0].q, np.ones(7))
    assert not both.q.flags.writeable
    assert not both.clamped.flags.writeable
    assert np.isnan(both.T_frame_tool).all()


def test_shares_of_a_common_command() -> None:
    q = np.arange(14.0)
    left, right = split_command(Command(q, record={"x": 1.0}), [LEFT, RIGHT])
    np.testing.assert_array_equal(left.q, q[:7])
    np.testing.assert_array_equal(right.q, q[7:])
    assert (left.qd, right.qd) == (None, None)
    assert (left.record, right.record) == ({"x": 1.0}, {})
    paced = split_command(Command(q, record={"x": 1.0}), [LEFT, RIGHT], 1)
    assert [one.record for one in paced] == [{}, {"x": 1.0}]
    assert all(one.ends for one in split_command(Command.stop(), [LEFT, RIGHT]))
    one = Command(np.zeros(7))
    assert split_command((one, None), [LEFT, RIGHT]) == (one, None)
    assert split_command(None, [LEFT, RIGHT]) == (None, None)
    assert split_command(one, [LEFT]) == (one,)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (Command(np.zeros(7)), r"Command.q of shape \(14,\), 7 of yumi_left and 7 of yumi_right, got \(7,\)"),
        (Command(qd=np.zeros((2, 7))), r"Command.qd of shape \(14,\)"),
        *(
            (Command(np.arange(14.0), **{name: np.zeros(1)}), f"no {name} in a single Command for all arms")
            for name in ("q_ext", "rapid_data", "rapid_digital")
        ),
        ((Command(),) * 3, r"got tuple of 3\. Write"),
        (np.zeros(14), r"got ndarray\. Write"),
    ],
)
def test_wrong_shares(asked: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        split_command(asked, [LEFT, RIGHT])


def test_wrong_shares_of_three() -> None:
    with pytest.raises(CommandRefused, match=r"shape \(21,\), 7 of yumi_left and 7 of .* and 7 of .*, got \(14,\)"):
        split_command(Command(np.zeros(14)), [LEFT, RIGHT, LEFT])


def sway(now: State) -> Command:
    return Command(now.q_start + 0.05 * np.sin(3.0 * now.t))


@pytest.mark.slow
def test_two_simulated_arms(tmp_path: Path) -> None:
    class Feed:
        def __init__(self, fails_at: int) -> None:
            self.rows: list[str] = []
            self.events: list[str] = []
            self.fails_at = fails_at

        def row(self, now: State, command: Command | None, tick: log.Tick) -> None:
            self.rows.append(now.robot)
            if len(self.rows) == self.fails_at:
                raise OSError("nobody reads")

        def event(self, text: str, warn: bool = False) -> None:
            self.events.append(text)

    def controller(now: State) -> Command:
        seen.append(now)
        return Command(now.q_start + 1e-4 * np.repeat([1.0, -1.0], 7) * len(seen))

    seen, good, bad = list[State](), Feed(-1), Feed(10)
    options: dict[str, Any] = {"seconds": 0.3, "record": tmp_path / "log.mcap", "feeds": [bad, good]}
    with bridge.connect("sim://yumi_left+yumi_right?lockstep=true", [LEFT, RIGHT]) as link:
        with pytest.raises(UnknownName, match="arm of this link"):
            link.run(controller, pace="yumi_middle")
        run = link.run(controller, pace="yumi_right", **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logleft.mcap", "logright.mcap"]
    assert [arm.statistics["robot"] for arm in run.arms] == ["yumi_right", "yumi_left"], "the pacing arm comes first"
    assert all(len(now.q) == 14 and len(now.arms) == 2 for now in seen)
    assert seen[0].t == 0.0
    for arm, sign in zip(run.arms, (-1.0, 1.0), strict=True):
        name, table = arm.statistics["robot"], log.read(arm.path)
        assert arm.statistics["replies"] == arm.statistics["packets"] == len(table) == good.rows.count(name)
        np.testing.assert_array_equal(arm.table["q_sent"], table["q_sent"])
        asked = np.flatnonzero(np.isfinite(table["q_ref"]).all(axis=1))[4:]
        np.testing.assert_allclose(table["q_sent"][asked], table["q_ref"][asked])
        np.testing.assert_allclose(np.diff(table["q_sent"][asked], axis=0), sign * 1e-4, atol=2e-5)
        assert f"{name}, RobotWare" in run.report()
        assert f"Log: {arm.path}." in run.report()
    assert len(bad.rows) == 10
    assert any(text.endswith(": A feed was dropped: it raised OSError: nobody reads.") for text in good.events)
    assert run.table["yumi_left.q"].shape == (len(run.table), 7)
    assert np.nanmax(run.table["yumi_left.age"]) < 0.0081


def test_the_controller_is_called_on_packets_of_the_arm_that_paces(two: Make) -> None:
    called: list[int] = []
    hands = two(lambda state: called.append(state.seq), pace=(1,))
    for k in range(5):
        hands.cycle(0)
        assert len(called) == k
        hands.cycle(1)
        assert len(called) == k + 1


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
    for _ in range(150):
        hands.cycle(0)
    assert any("Session 1 ended: the controller stopped sending" in text for text in hands.warned)
    held = len(called)
    hands.robots[1].seq = 0
    hands.cycle(1, 0)
    assert len(called) == held + 1, "the run continues once both arms are present"


def test_a_session_that_begins_while_the_controller_computes_is_not_sent_its_command(two: Make) -> None:
    def controller(state: State) -> Command:
        if state.seq == 20:
            hands.robots[0].seq = 0
            hands.put(0, q=hands.robots[0].q + 0.3)
        return drift(state)

    hands = moving(two(controller))
    assert min(row[1] is not None for row in hands.rows[-2:])
    hands.cycle(0)
    first = hands.reply(0)
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
    assert [arm.machine.mode for arm in hands.arms] == [Mode.STOPPING] * 2


def test_an_arm_that_stops_stops_the_other(two: Make) -> None:
    hands = moving(two(drift))
    hands.arms[1].machine.stop("enough of this arm")
    hands.cycle(1)  # so the first arm comes to rest last, and its reply is the last of the run
    hands.run(0, 1)
    assert (hands.loop.reason, hands.loop.failure) == ("enough of this arm", None)
    assert [arm.machine.mode for arm in hands.arms] == [Mode.ENDED] * 2
    assert hands.speed(0) == hands.speed(1) == 0.0


def test_the_guard_answers_the_other_arm_too(two: Make) -> None:
    def controller(state: State) -> Command:
        if state.seq == 5:
            hands.put(1, after=4 * MS)
            hands.loop.answer_for_controller()
            sent.append([len(port.sent) for port in hands.ports])
        return drift(state)

    hands, sent = two(controller), []
    for _ in range(5):
        hands.cycle(0, 1)
    hands.cycle(0)
    assert sent == [[6, 6]]
    assert [len(port.sent) for port in hands.ports] == [6, 6]


@pytest.mark.parametrize("bad", [0, 1])
def test_garbage_for_one_arm_is_not_answered_and_is_no_silence(two: Make, bad: int) -> None:
    looks: list[int] = []
    hands = two(drift, alive=lambda: "" if looks.append(hands.clock.now) is None else "lost")
    hands.cycle(0, 1)
    hands.put(1 - bad)
    hands.ports[bad].waiting.append(hands.garbage())
    hands.loop.cycle()
    assert [len(port.sent) for port in hands.ports] == [1 + bad, 2 - bad]
    assert hands.arms[bad].session.total_drops == 1
    assert not looks
    hands.loop.cycle()
    assert len(looks) == 2  # no packet arrived: one check of each arm


def test_in_lockstep_no_arm_is_stale(two: Make) -> None:
    called: list[int] = []
    hands = two(lambda state: called.append(state.seq), clock="robot")
    hands.cycle(1, 0)
    for _ in range(20):
        hands.cycle(0)
    assert len(called) == 21


def test_an_arm_that_never_comes_ends_the_run(two: Make) -> None:
    hands = two(drift, patience=1.0)
    for _ in range(270):
        hands.cycle(0)
    hands.loop._have_ended()
    assert isinstance(hands.loop.failure, NoRobot)
    assert hands.arms[0].machine.mode is Mode.STOPPING


def test_a_command_serves_another_arm_for_two_and_a_half_periods(two: Make) -> None:
    hands = moving(two(drift))
    speeds = []
    for _ in range(2):  # the second one is the third packet of this command
        hands.cycle(1)
        speeds.append(hands.speed(1))
    assert speeds[0] == pytest.approx(0.1)
    assert speeds[1] < 0.05


def test_a_command_of_a_session_serves_in_no_later_one(two: Make) -> None:
    hands = moving(two(drift))
    hands.clock.now += 300 * MS
    for packets in hands.robots:
        packets.seq, packets.cycle = 0, packets.cycle + 75
    hands.cycle(1)
    np.testing.assert_allclose(hands.table(1)["q_sent"][-1], hands.robots[1].q, atol=1e-9)
    assert (hands.arms[1].session.number, hands.speed(1), hands.rows[-1][1]) == (2, 0.0, None)


@pytest.mark.parametrize(("data", "digital"), [(True, True), (True, None), (None, True)])
def test_values_for_rapid_go_out_once(two: Make, data: bool | None, digital: bool | None) -> None:
    def controller(state: State) -> tuple[None, Command]:
        values = None if data is None else [float(state.seq)]
        return None, Command(qd=np.full(7, 0.1), rapid_data=values, rapid_digital=digital)

    hands = two(controller)
    hands.robots[1].codec = RobotSideCodec(RIGHT, "7")
    moving(hands)
    hands.cycle(1)
    hands.cycle(0)
    hands.ports[1].works = False
    hands.cycle(1)
    hands.ports[1].works = True
    hands.cycle(1)
    hands.cycle(1)
    table = hands.table(1)
    if data:
        np.testing.assert_array_equal(table["rapid_data_sent"][-6:, 0], [18.0, 19.0, np.nan, np.nan, 20.0, np.nan])
    if digital:
        np.testing.assert_array_equal(np.isfinite(table["rapid_digital_sent"][-4:].astype(float)), [0, 0, 1, 0])
    np.testing.assert_allclose(table["qd_sent"][[-4, -2], 0], 0.1)


def test_the_pacing_arm_that_holds_takes_its_command_from_the_others(two: Make) -> None:
    hands = moving(two(drift))
    hands.cycle(0, mci=2)
    hands.cycle(1)
    assert hands.speed(1) < 0.0999
    assert np.isnan(hands.table(1)["qd_ref"][-1].astype(float)).all()


def test_an_arm_that_is_not_ready_or_unheard_holds_the_third(monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize("pace", [0, 1])
def test_all_that_wait_are_answered_before_a_row_is_recorded(two: Make, pace: int) -> None:
    recorded: list[list[int]] = []
    hands = two(drift, pace=(pace,))
    for _ in range(3):
        hands.cycle(1, 0)
    hands.put(0)
    hands.put(1, after=0)
    hands.row = lambda *row: recorded.append([len(port.sent) for port in hands.ports])  # type: ignore[method-assign]
    hands.loop.cycle()
    assert recorded == [[4, 4], [4, 4]]


def test_an_arm_that_stops_stops_the_other_before_its_waiting_packet_is_answered(two: Make) -> None:
    def controller(state: State) -> Command:
        if not coming:
            return drift(state)
        hands.ports[1].waiting.append(coming.pop())  # just now
        return Command.stop()

    coming: list[Any] = []
    hands = two(controller)
    for _ in range(30):
        hands.cycle(1, 0)
    hands.put(1)
    hands.put(0, after=0)
    coming.append(hands.ports[1].waiting.pop())
    hands.loop.cycle()
    assert len(hands.ports[1].sent) == 31
    assert [arm.machine.mode for arm in hands.arms] == [Mode.STOPPING] * 2


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


_PROGRAM = """
import sys
import numpy as np
from armlab import bridge, robots
from armlab.state import Command
pair = [robots.load("yumi_left"), robots.load("yumi_right")]
told = []
def controller(state):
    if state.t > 1.2 and not told:
        told.append(print("running", flush=True))
    return Command(state.q_start + 0.05 * np.sin(state.t))
with bridge.connect("sim://yumi_left+yumi_right", pair) as link:
    link.run(controller, record=sys.argv[1])
"""


@pytest.mark.slow  # 3 s
def test_both_files_survive_a_kill(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _PROGRAM, str(tmp_path / "run.mcap")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as program:
        assert program.stdout.readline() == "running\n"
        program.kill()
    for name in ("runleft.mcap", "runright.mcap"):
        with pytest.warns(UserWarning, match="was not finished"):
            table = log.read(tmp_path / name)
        assert table.t[-1] > 0.2
        assert np.isfinite(table["q"]).all()
        np.testing.assert_array_equal(np.diff(table["tick"]), 1)


@pytest.mark.slow  # 3 s; examples/19_teleoperation.py runs both in the default run
def test_two_arms_of_the_simulator_are_repeatable_and_have_their_own_seeds() -> None:
    tables = []
    for url in (
        "sim://yumi_left+yumi_right?lockstep=true&seed=4",
        ["sim://yumi_left?lockstep=true&seed=4", "sim://yumi_right?lockstep=true&seed=4"],
        ["sim://yumi_left?lockstep=true&seed=4", "sim://yumi_right?lockstep=true&seed=5"],
    ):
        with bridge.connect(url, [LEFT, RIGHT]) as link:
            tables.append(link.run(sway, seconds=0.3).table)
    one, two, other = tables
    for name in ("q", "tau", "q_sent", "robot_ns"):
        for robot in ("yumi_left", "yumi_right"):  # until the stop, whose row depends on which simulator is ahead
            np.testing.assert_array_equal(one[f"{robot}.{name}"][:70], two[f"{robot}.{name}"][:70])
    assert np.ptp(one["yumi_right.q"], axis=0).min() > 0.01
    np.testing.assert_array_equal(one["yumi_left.tau"][:5], other["yumi_left.tau"][:5])
    assert (one["yumi_right.tau"][:5] != other["yumi_right.tau"][:5]).any(axis=1).all()
