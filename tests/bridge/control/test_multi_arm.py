"""What the controller of two arms sees, and which part of its command is whose."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import bridge, log, robots
from armlab.bridge.control.multi_arm import merge_states, split_command
from armlab.errors import CommandRefused, ConfigError, ControllerFailed, ControllerLate, NoRobot, UnknownName
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def state(robot: str, k: float) -> State:
    return State(
        k, 0.004, np.full(7, k), np.full(7, 2 * k), np.full(7, 3 * k), robot=robot, t_receive=int(k), seq=int(k)
    )


def test_fuse() -> None:
    both = merge_states([state("a", 1.0), state("b", 2.0)], [0.003, 0.0], 1, 5.0)
    assert (both.t, both.dt, both.seq, both.robot, both.t_receive) == (5.0, 0.004, 2, "a+b", 2)
    np.testing.assert_array_equal(both.q, [1.0] * 7 + [2.0] * 7)
    np.testing.assert_array_equal(both.tau, [3.0] * 7 + [6.0] * 7)
    assert [arm.age for arm in both.arms] == [0.003, 0.0]
    np.testing.assert_array_equal(both.arms[0].q, np.ones(7))
    assert not both.q.flags.writeable
    assert not both.clamped.flags.writeable
    assert np.isnan(both.T_frame_tool).all()


def test_an_arm_heard_after_the_one_that_paces_has_no_age() -> None:
    both = state("a", 1.0), state("b", 2.0)
    found = merge_states(both, [-0.001, 0.0], 1, 5.0)
    assert found.arms[0] is both[0]
    assert found.arms[1] is both[1]


def test_shares_of_a_common_command() -> None:
    q = np.arange(14.0)
    left, right = split_command(Command(q, record={"x": 1.0}), [LEFT, RIGHT])
    assert left is not None
    assert right is not None
    np.testing.assert_array_equal(left.q, q[:7])
    np.testing.assert_array_equal(right.q, q[7:])
    assert (left.qd, right.qd) == (None, None)
    assert (left.record, right.record) == ({"x": 1.0}, {})
    assert [one.record for one in split_command(Command(q, record={"x": 1.0}), [LEFT, RIGHT], 1) if one] == [
        {},
        {"x": 1.0},
    ]
    assert all(one is not None and one.ends for one in split_command(Command.stop(), [LEFT, RIGHT]))


def test_shares_of_three() -> None:
    parts = split_command(Command(np.arange(21.0)), [LEFT, RIGHT, LEFT])
    np.testing.assert_array_equal([one.q for one in parts if one is not None], np.arange(21.0).reshape(3, 7))


@pytest.mark.parametrize("name", ["q_ext", "rapid_data", "rapid_digital"])
def test_what_is_for_one_arm_is_not_shared(name: str) -> None:
    with pytest.raises(CommandRefused, match=f"no {name} in a Command of all joints"):
        split_command(Command(np.arange(14.0), **{name: np.zeros(1)}), [LEFT, RIGHT])  # type: ignore[arg-type]


def test_shares_of_each() -> None:
    one = Command(np.zeros(7))
    assert split_command((one, None), [LEFT, RIGHT]) == (one, None)
    assert split_command(None, [LEFT, RIGHT]) == (None, None)
    assert split_command(one, [LEFT]) == (one,)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (Command(np.zeros(7)), r"Command.q of shape \(14,\), 7 of yumi_left and 7 of yumi_right, got \(7,\)"),
        (Command(qd=np.zeros((2, 7))), r"Command.qd of shape \(14,\)"),
        ((Command(),) * 3, r"got tuple of 3\. Write"),
        (np.zeros(14), r"got ndarray\. Write"),
    ],
)
def test_wrong_shares(asked: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        split_command(asked, [LEFT, RIGHT])


def sway(now: State) -> Command:
    return Command(now.q_start + 0.05 * np.sin(3.0 * now.t))


def test_each_packet_is_answered_in_its_own_tick(pair: Any) -> None:
    """The controller is called on the left arm's packets only; each arm follows its own part."""
    seen: list[State] = []

    def controller(now: State) -> Command:
        seen.append(now)
        return Command(now.q_start + 1e-4 * np.repeat([1.0, -1.0], 7) * len(seen))

    def script(left: Any, right: Any) -> None:
        for peer in (left, right) * 3:
            peer.cycle(mci=2)
        for _ in range(50):
            left.cycle()
            right.cycle()
        pair.rest(left, right)

    run = pair(script, controller, seconds=0.3)
    assert [peer.surplus() for peer in pair.peers] == [0, 0]
    assert all(len(now.q) == 14 and len(now.arms) == 2 for now in seen)
    left, right = run.arms
    for arm in run.arms:
        assert arm.statistics["replies"] == arm.statistics["packets"] == len(arm.table)
    asked = np.isfinite(left.table["q_ref"]).all(axis=1)
    np.testing.assert_allclose(left.table["q_sent"][asked], left.table["q_ref"][asked])
    np.testing.assert_allclose(right.table["q_sent"][8:50], right.table["q_ref"][8:50])
    np.testing.assert_allclose(
        left.table["q_sent"][50] - LEFT.q_home, LEFT.q_home - LEFT.q_home + 1e-4 * (50 - 3), atol=2e-4
    )
    np.testing.assert_allclose(RIGHT.q_home - right.table["q_sent"][50], 1e-4 * (50 - 3), atol=2e-4)
    assert seen[0].t == 0.0
    assert "yumi_left, RobotWare" in run.report()
    assert "yumi_right, RobotWare" in run.report()


def test_the_arm_that_paces_is_named(pair: Any) -> None:
    robots_seen = set()

    def controller(now: State) -> Command:
        robots_seen.add([arm.age == 0.0 for arm in now.arms].index(True))
        return sway(now)

    link = pair.link()
    with pytest.raises(UnknownName, match="arm of this link"):
        link.run(controller, pace="yumi_middle")

    def script(left: Any, right: Any) -> None:
        right.packets.cycle += 1  # its clock runs ahead, so that no two packets have one time
        pair.rest(left, right)

    run = pair(script, controller, link, pace="yumi_right", seconds=0.1)
    assert robots_seen == {1}
    assert run.arms[0].statistics["robot"] == "yumi_right"


def test_both_hold_while_one_is_not_ready(pair: Any) -> None:
    calls: list[float] = []

    def controller(now: State) -> Command:
        calls.append(now.t)
        return Command(qd=np.full(14, 0.1))

    def script(left: Any, right: Any) -> None:
        for _ in range(20):
            left.cycle()
            right.cycle(mci=2)
        assert not calls
        for _ in range(30):
            left.cycle()
            right.cycle()
        assert min(left.replies[-1].qd.min(), right.replies[-1].qd.min()) > 0.05
        for _ in range(60):
            left.cycle()
            right.cycle(motors=2)
        assert len(calls) < 35
        assert np.abs(left.replies[-1].qd).max() == 0.0
        pair.rest(left, right)

    run = pair(script, controller, seconds=0.3)
    assert calls[0] == 0.0
    assert run.reason == "the time is up"
    assert any(text == "yumi_right: The robot is not ready: the motors are off." for _, text in run.events)


def test_an_arm_that_falls_silent_holds_the_other(pair: Any) -> None:
    """Real time: the left arm paces and goes on, the right one stops sending; the run waits for it."""
    calls: list[int] = []

    def controller(now: State) -> Command:
        calls.append(now.seq)
        return Command(qd=np.full(14, 0.1))

    def together(left: Any, right: Any, count: int) -> None:
        for _ in range(count):
            left.cycle()
            right.cycle()
            time.sleep(0.003)

    def script(left: Any, right: Any) -> None:
        left.begin()
        right.begin()
        together(left, right, 30)
        for _ in range(60):
            left.cycle()
            time.sleep(0.003)
        called = len(calls)
        assert np.abs(left.replies[-1].qd).max() == 0.0
        for _ in range(150):
            left.cycle()
            time.sleep(0.003)
        assert len(calls) == called
        right.packets.seq = 0
        together(left, right, 30)
        assert len(calls) > called
        assert left.replies[-1].qd.min() > 0.0
        pair.rest(left, right)

    run = pair(script, controller, pair.link(clock="wall"), wait="block", seconds=0.25)
    assert run.arms[1].statistics["sessions"] == 2
    assert any("Session 1 ended: " in text for _, text in run.arms[1].events)
    assert run.reason == "the time is up"


def test_a_command_of_another_arm_ages(pair: Any) -> None:
    """When the pacing arm's packets stay away, a velocity does not go on acting on the other."""

    def script(left: Any, right: Any) -> None:
        for _ in range(30):
            left.cycle()
            right.cycle()
        assert right.replies[-1].qd.min() > 0.05
        speeds = [np.abs(right.cycle().qd).max() for _ in range(40)]
        assert speeds[0] > 0.05
        assert speeds[-1] == 0.0
        pair.rest(left, right)

    pair(script, lambda now: Command(qd=np.full(14, 0.1)), seconds=0.2)


def test_an_error_stops_both(pair: Any) -> None:
    def controller(now: State) -> Command:
        if now.t > 0.1:
            raise ValueError("bad luck")
        return sway(now)

    with pytest.raises(ControllerFailed, match="bad luck") as caught:
        pair(pair.rest, controller)
    table = caught.value.table
    for name in ("yumi_left", "yumi_right"):
        np.testing.assert_array_equal(table[f"{name}.qd_sent"][-1], 0.0)
    assert [peer.surplus() for peer in pair.peers] == [0, 0]


def test_commands_refused_on_one_arm_stop_both(pair: Any) -> None:
    def controller(now: State) -> Command:
        q = now.q_start.copy()
        q[13] = np.nan if now.t > 0.05 else q[13]
        return Command(q)

    with pytest.raises(CommandRefused, match="finite"):
        pair(pair.rest, controller)
    with pytest.raises(CommandRefused, match=r"shape \(14,\)"):
        pair(pair.rest, lambda now: Command(now.q_start[:7]))


def test_a_command_per_arm(pair: Any) -> None:
    def controller(now: State) -> Any:
        left, _ = now.arms
        return Command(left.q_start + 0.02 * np.sin(3.0 * now.t)), None

    run = pair(pair.rest, controller, seconds=0.3)
    left, right = (arm.table["q_sent"] for arm in run.arms)
    assert np.ptp(left[:, 0]) > 0.01
    assert np.ptp(right[:, 0]) == 0.0


def test_a_late_controller_stops_both_and_none_is_left_unanswered(pair: Any) -> None:
    asleep, done = threading.Event(), threading.Event()

    def controller(now: State) -> Command:
        if now.t > 0.1 and not asleep.is_set():
            asleep.set()
            done.wait(5.0)
        return Command(qd=np.full(14, 0.2))

    def script(left: Any, right: Any) -> None:
        left.begin()
        right.begin()
        while not asleep.is_set():
            left.cycle()
            if not asleep.is_set():
                right.cycle()
            time.sleep(0.003)
        until = time.monotonic() + 0.3
        while time.monotonic() < until:
            left.cycle()
            right.cycle()
            time.sleep(0.003)
        assert max(np.abs(peer.replies[-1].qd).max() for peer in (left, right)) == 0.0
        done.set()
        pair.rest(left, right)

    with pytest.raises(ControllerLate, match=r"one call took 0.\d+ s"):
        pair(script, controller, pair.link(clock="wall"), wait="block")
    assert [peer.surplus() for peer in pair.peers] == [0, 0]


def test_files_and_feeds(pair: Any, tmp_path: Path) -> None:
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

    good, bad = Feed(-1), Feed(10)
    run = pair(pair.rest, sway, seconds=0.2, record=tmp_path / "log.mcap", feeds=[bad, good])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logleft.mcap", "logright.mcap"]
    tables = {arm.statistics["robot"]: log.read(arm.path) for arm in run.arms}
    assert {name: len(table) for name, table in tables.items()} == {
        name: good.rows.count(name) for name in ("yumi_left", "yumi_right")
    }
    assert len(bad.rows) == 10
    assert "yumi_right: A feed was dropped: it raised OSError: nobody reads." in good.events
    both = run.table
    np.testing.assert_array_equal(both["yumi_left.q_sent"], tables["yumi_left"]["q_sent"])
    assert both["yumi_right.q"].shape == (len(both), 7)
    assert np.nanmax(both["yumi_right.age"]) < 0.0081


def test_wrong_pairs() -> None:
    pair = [LEFT, RIGHT]
    for url, robot, words in (
        ("sim://yumi_left", pair, "one url per robot, got 1 for 2"),
        (["egm://127.0.0.1:6510"] * 2, pair, "a port per arm"),
        (["sim://yumi_left", "egm://127.0.0.1:0"], pair, "of one kind"),
        (["sim://yumi_left?seed=1&loss=0.1", "sim://yumi_right?seed=2"], pair, "the same options"),
        (["egm://127.0.0.1:0"] * 2, [LEFT, LEFT], "different names"),
    ):
        with pytest.raises(ConfigError, match=words):
            bridge.connect(url, robot)
    with bridge.connect(["egm://127.0.0.1:0"] * 2, pair, patience=0.1) as link:
        limits = bridge.Limits.of(LEFT)
        with pytest.raises(ConfigError, match="Limits for each of yumi_left, yumi_right, got 1"):
            link.run(sway, limits=limits)
        with pytest.raises(NoRobot):
            link.run(sway)
