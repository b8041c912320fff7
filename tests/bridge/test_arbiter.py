"""Command rights: one client per arm; taking, keeping and losing an arm, in simulated time."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.arbiter import LEASE, Arbiter, Order
from armlab.bridge.control.limits import joint_name
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
HOME = np.array(LEFT.q_home)


class Bench:
    """Arbiter with its own clock and lists of its messages."""

    def __init__(self, arms: Any = (LEFT,), allowed: Any = ("labcomm",), **options: Any) -> None:
        self.now = 10**12
        self.events: list[str] = []
        self.warnings: list[str] = []  # those of the events that warn
        self.each: list[str] = []  # and the events that are reported every time
        self.answers: list[tuple[str, str]] = []
        self.results: list[tuple[str, ...]] = []  # client, goal, status, outcome, reason
        options = {"tell": self.tell, "answer": self.answer, "on_goal": self.on_goal, **options}
        self.arbiter = Arbiter(arms, allowed, clock=lambda: self.now, **options)
        self.q_sent = {robot.name: np.array(robot.q_home) for robot in arms}
        self.arms = arms

    def tell(self, text: str, warn: bool = False, each: bool = False) -> None:
        self.events.append(text)
        if warn:
            self.warnings.append(text)
        if each:
            self.each.append(text)

    def answer(self, client: str, text: str) -> None:
        self.answers.append((client, text))

    def on_goal(self, order: Order, result: tuple[str, str, str]) -> None:
        self.results.append((order.client, order.goal, *result))

    def state(self) -> State:
        made = [
            State(0.0, 0.004, np.array(robot.q_home), *np.zeros((2, robot.n)), q_sent=self.q_sent[robot.name])
            for robot in self.arms
        ]
        return made[0] if len(made) == 1 else State(0.0, 0.004, *np.zeros((3, 14)), arms=tuple(made))

    def __call__(self, *orders: Order, after: float = 0.004) -> Any:
        self.now += int(1e9 * after)
        for order in orders:
            self.arbiter.submit(order)
        command = self.arbiter(self.state())
        if isinstance(command, Command) and command.q is not None:
            self.q_sent[self.arms[0].name] = command.q
        return command


class Motion:
    """Trajectory that stays at `q` until it is ended."""

    def __init__(self, q: Any = HOME, problem: str = "") -> None:
        self.q, self.problem = q, problem
        self.ending = self.reason = ""
        self.begun: list[bool] = []  # whether the arm was moving
        self.steps: list[float] = []

    @property
    def done(self) -> bool:
        return self.ending == "arrived"

    def begin(self, state: State, near: Any, is_moving: bool) -> str:
        self.begun.append(is_moving)
        return self.problem

    def __call__(self, state: State, dt: float) -> Command:
        self.steps.append(dt)
        return Command(self.q)


def goal(name: str = "1", client: str = "labcomm a", arm: str = "yumi_left", motion: Any = None) -> Order:
    return Order(client, arm, goal=name, trajectory=Motion() if motion is None else motion)


def order(client: str = "labcomm a", offset: float = 0.01, arm: str = "yumi_left", **more: Any) -> Order:
    return Order(client, arm, HOME + offset, **more)


def test_the_first_valid_command_takes_the_arm() -> None:
    bench = Bench()
    assert bench() is None
    assert bench(order("labcomm a", 0.01), order("labcomm b", 0.02)).q[0] == HOME[0] + 0.01
    assert bench.arbiter.commander("yumi_left") == "labcomm a"
    assert bench.events[0] == "labcomm a commands yumi_left."
    assert bench.each == bench.events[:1]
    assert bench.results == [], "only trajectories have results"
    assert bench.answers == [
        ("labcomm b", "yumi_left is commanded by labcomm a. You have read-only access. 1 commands refused so far.")
    ]
    assert bench.arbiter.refused == {"labcomm b": 1}
    assert bench.arbiter.obeyed == {"yumi_left": {"labcomm a": 1}}
    assert bench.warnings == [
        "A command of labcomm b was refused: yumi_left is commanded by labcomm a. You have read-only access."
    ]


def test_others_are_answered_once_a_second() -> None:
    bench = Bench()
    bench.now = 0  # a machine that has just started
    for _ in range(600):
        bench(order("labcomm a"), order("labcomm b"))
    assert bench.arbiter.refused["labcomm b"] == 600
    assert [text.split()[-5] for _, text in bench.answers] == ["1", "251", "501"]
    assert sum("refused" in text for text in bench.events) == 3


def test_each_tick_polls_first_and_what_a_server_refused_is_told_and_not_answered() -> None:
    orders = [order()]
    bench = Bench(poll=lambda: bench.arbiter.submit(orders.pop()))
    assert bench() is not None
    bench.arbiter.report("ros b", "Expected a message, got noise.")
    assert (bench.warnings, bench.answers) == (["ros b: Expected a message, got noise."], [])
    assert bench.arbiter.refused == {"ros b": 1}


def test_the_lease_lasts_to_its_last_nanosecond_from_when_the_command_came() -> None:
    """The lease does not start when the command is judged, because it may have waited for the arm to become ready."""
    bench = Bench()
    bench(order())
    assert bench(after=LEASE) is not None
    assert bench(after=1e-9) is None
    bench.arbiter.submit(order("labcomm b"))
    assert bench(after=LEASE) is not None
    bench = Bench()
    bench.arbiter.submit(order())
    assert bench(after=LEASE - 0.004) is not None
    assert bench(after=0.004) is not None
    assert bench(after=1e-9) is None


def test_a_lease_ends_also_while_nobody_asks_for_commands() -> None:
    """Once the lease has ended, rows contain no commander and others may set parameters, even if no arm is ready."""
    bench = Bench()
    bench(order())
    for after, holds in ((LEASE, True), (1e-9, False)):
        bench.now += round(1e9 * after)
        assert bench.arbiter.commander("yumi_left") == ("labcomm a" if holds else "")
        assert bench.arbiter.commands("labcomm b") != holds
    assert bench(order(), after=0.0) is not None
    assert bench.events[1] == "labcomm a no longer commands yumi_left: silent for 0.1 s. The arm holds."
    assert bench.events[1] in bench.each


def test_refused_commands_keep_nothing() -> None:
    bench = Bench()
    bench(order())
    for _ in range(24):
        assert bench(order(offset=np.nan)) is not None
    bench(order(offset=np.nan), after=0.01)
    assert bench.arbiter.commander("yumi_left") == ""


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (order(offset=0.06), "first position within 0.05 of where the arm is"),
        (Order("labcomm a", "yumi_left", HOME[:6]), "7 numbers in q"),
        (Order("labcomm a", "yumi_left", qd=[[1.0], [2.0, 3.0]]), "7 numbers in qd"),
        (Order("labcomm a", "yumi_left", "up"), r"7 numbers in q for yumi_left, got shape \(0,\)"),
        (Order("labcomm a", "yumi_left", HOME, np.full(7, np.inf)), "finite numbers in qd .* joint 1"),
        (Order("labcomm a", "yumi_left", HOME, tau=np.zeros(7)), "a command without torque"),
        (Order("labcomm a", "yumi_left"), "a position, a velocity or a torque"),
        (order(arm="yumi_right"), r"arm of this cell \(yumi_left\), got 'yumi_right'"),
        (order("ros a"), "`commands`, got a command through ros"),
    ],
)
def test_refused(wrong: Order, words: str) -> None:
    bench = Bench()
    assert bench(wrong) is None
    assert re.search(words, bench.answers[0][1])
    assert "was refused" in bench.events[0]
    assert bench.arbiter.commander("yumi_left") == ""


def test_torque_where_the_link_carries_it() -> None:
    command = Bench(torque=["yumi_left"])(Order("labcomm a", "yumi_left", tau=np.ones(7)))
    np.testing.assert_array_equal(command.tau, np.ones(7))
    assert not command.tau.flags.writeable, "each packet is answered with the same array"


def test_older_numbers_are_ignored() -> None:
    bench = Bench()
    assert bench(order(seq=5)).q[0] == HOME[0] + 0.01
    assert bench(order(offset=0.02, seq=5)).q[0] == HOME[0] + 0.01
    assert (bench.arbiter.refused, bench.answers) == ({"labcomm a": 1}, [])
    bench.q_sent["yumi_left"] = HOME + 0.2
    assert bench(order(offset=0.02, seq=5)) is None, "an ignored command does not renew an old one"
    bench.q_sent["yumi_left"] = HOME
    assert bench(order(offset=0.03, seq=6)).q[0] == HOME[0] + 0.03


def test_an_order_that_waited_too_long_is_dropped() -> None:
    """The arbiter is not called while the robot is not ready; commands sent then must not move the robot later."""
    bench = Bench()
    bench.arbiter.submit(order())
    assert bench(after=LEASE + 0.01) is None
    assert bench.arbiter.refused == {"labcomm a": 1}


def test_stop_is_for_everybody_and_resume_for_operators() -> None:
    bench = Bench()
    bench(order())
    bench.arbiter.resume("local 1")
    assert bench.arbiter.commander("yumi_left") == "labcomm a", "nothing was stopped"
    for client in ("web b", "web c"):
        bench.arbiter.stop(client)
    assert bench.warnings == ["Stopped by web b. An operator can end the stop with armlab bridge resume."]
    assert bench.events[-1] == "labcomm a no longer commands yumi_left: all arms were stopped. The arm holds."
    assert bench(order()) is None
    assert "All arms hold their positions, because web b stopped them." in bench.answers[0][1]
    assert (bench.arbiter.stopped, bench.arbiter.commander("yumi_left")) == ("web b", "")
    bench.arbiter.submit(order())
    bench.arbiter.resume("local 1")
    assert bench.events[-1] == "Resumed by local 1."
    assert bench() is None, "sent while all arms were stopped"
    assert bench(order()) is not None


def test_release_and_leave() -> None:
    bench = Bench((LEFT, RIGHT))
    bench(order("labcomm a"), Order("labcomm b", "yumi_right", np.array(RIGHT.q_home)))
    assert (bench.arbiter.commander("yumi_left"), bench.arbiter.commander("yumi_right")) == ("labcomm a", "labcomm b")
    bench.arbiter.leave("labcomm b")
    assert bench.arbiter.commander("yumi_right") == ""
    bench.arbiter.release("labcomm x", "labcomm x")
    assert bench.arbiter.commander("yumi_left") == "labcomm a"
    bench.arbiter.release("local 1")
    assert bench.arbiter.commander("yumi_left") == ""
    assert bench() == (None, None)
    bench = Bench()
    bench.arbiter.submit(order())
    bench.arbiter.leave("labcomm a")
    assert bench() is None
    for _ in range(2):
        bench(order(offset=np.nan))
        bench.arbiter.leave("labcomm a")
    assert len(bench.answers) == 2, "another client with that name is answered immediately"


def test_rights_of_a_commander_and_of_a_controller_of_its_own() -> None:
    arbiter = (bench := Bench()).arbiter
    assert arbiter.commands("labcomm a")
    assert not arbiter.commands("ros a")
    bench(order("labcomm a"))
    assert arbiter.commands("labcomm a")
    assert not arbiter.commands("labcomm b")
    assert Bench().arbiter.commands("labcomm a of the hall")
    assert Bench()(order("labcomm a of the hall")) is not None
    arbiter.reserve("the controller of the cell")
    bench(order("labcomm b"))
    assert "is commanded by the controller of the cell" in bench.answers[0][1]


def test_a_flood_of_clients_is_bounded() -> None:
    bench = Bench()
    bench(order("labcomm holder"), *[order(f"labcomm {k}") for k in range(5000)])
    bench(*[order(f"ros {k}") for k in range(5000)])
    assert len(bench.arbiter.refused) <= 256
    assert len(bench.arbiter._answered) <= 256
    bench = Bench()
    for k in range(300):
        bench.arbiter.submit(order(f"labcomm {k}"))
    assert len(bench.arbiter._inbox) == 256
    assert (bench.arbiter.refused, bench.answers) == ({}, []), "stream commands are dropped silently"
    bench.arbiter.submit(goal("1", "labcomm 299"))
    why = "Expected at most 256 commanding clients at once."
    assert bench.results == [("labcomm 299", "1", "aborted", "refused", why)]
    assert bench(order("labcomm 0", 0.03)).q[0] == HOME[0] + 0.03


def test_a_trajectory_advances_by_the_time_between_packets_and_its_result_is_told_once() -> None:
    bench, motion = Bench(), Motion()
    bench(goal("1", motion=motion))
    bench()
    assert (motion.begun, motion.steps) == ([False], [0.0, 0.004])
    assert bench.results == [("labcomm a", "1", "executing", "", "")]
    second = Motion()
    bench(goal("2", motion=second))
    assert (second.begun, second.steps, motion.steps) == ([True], [0.0], [0.0, 0.004])
    assert bench.results[1:] == [
        ("labcomm a", "1", "aborted", "interrupted", "A newer command replaced this command."),
        ("labcomm a", "2", "executing", "", ""),
    ]
    second.ending = "arrived"
    assert bench() is None
    assert bench.results[3:] == [("labcomm a", "2", "succeeded", "arrived", "")]
    assert bench.events[-1] == "labcomm a no longer commands yumi_left: the trajectory has ended. The arm holds."
    bench(goal("2", motion=Motion(problem="The way is blocked.")))
    assert bench.results[4:] == [("labcomm a", "2", "aborted", "refused", "The way is blocked.")], "used again"
    assert bench.warnings == ["A trajectory of labcomm a was refused: The way is blocked."]
    assert bench.answers == [], "the result says it"


def test_a_trajectory_ends_when_the_arm_cannot_follow() -> None:
    q = HOME + 0.05 * (np.arange(7) == 0)
    bench, motion = Bench(), Motion(q)
    limits = bench.arbiter._limits
    limits["yumi_left"] = dataclasses.replace(limits["yumi_left"], jump=np.full(7, abs(q[0] - HOME[0])))
    assert bench(goal(motion=motion)) is not None, "the largest step allowed"
    bench.q_sent["yumi_left"] = HOME - 1e-9
    assert bench() is None
    reason = "The arm's limits prevent it from following the trajectory."
    assert bench.results[1:] == [("labcomm a", "1", "aborted", "path", reason)]
    assert bench.events[-1] == f"labcomm a no longer commands yumi_left: {reason} The arm holds."


def test_goals_that_wait_are_replaced_by_newer_ones_and_cancelled_by_name() -> None:
    bench = Bench((LEFT, RIGHT))
    waiting = [
        *(goal("1"), goal("2"), goal("2", "labcomm b")),
        *(goal("2", "labcomm c", "yumi_right", Motion(np.array(RIGHT.q_home))), goal("3", "labcomm d")),
    ]
    for one in waiting:
        bench.arbiter.submit(one)
    assert bench.results == [("labcomm a", "1", "aborted", "interrupted", "A newer command replaced this command.")]
    bench.arbiter.cancel("web x", "yumi_left", "")
    assert len(bench.results) == 1
    bench.arbiter.cancel("web x", "yumi_left", "2")
    canceled = ("canceled", "interrupted", "Canceled by web x.")
    assert bench.results[1:] == [("labcomm a", "2", *canceled), ("labcomm b", "2", *canceled)]
    bench()
    assert (bench.arbiter.commander("yumi_left"), bench.arbiter.commander("yumi_right")) == ("labcomm d", "labcomm c")
    bench.arbiter.cancel("web x", "yumi_left", "2")
    assert bench.arbiter.commander("yumi_left") == "labcomm d", "another goal"
    bench.arbiter.cancel("web x", "yumi_left", "3")
    assert bench.arbiter.commander("yumi_left") == ""
    bench(order())
    bench.arbiter.cancel("web x", "yumi_left", "")
    assert bench.arbiter.commander("yumi_left") == "labcomm a", "stream commands are not a goal"


def test_the_lease_of_a_trajectory_is_renewed_only_while_the_arm_is_ready() -> None:
    bench = Bench()
    bench(goal())
    bench.now += round(1e9 * LEASE)
    bench.arbiter.renew("labcomm a", "yumi_left", "1")
    assert bench.arbiter.commander("yumi_left") == "labcomm a", "last request exactly one lease ago"
    bench.now += 1
    bench.arbiter.renew("labcomm a", "yumi_left", "1")
    assert bench.arbiter.commander("yumi_left") == ""
    ended = ("labcomm a", "1", "aborted", "interrupted", "The arm is not ready.")
    assert bench.results[1:] == [ended]
    bench.arbiter.renew("labcomm a", "yumi_left", "1")
    assert bench.results[2:] == [ended], "a client that missed the result gets it again"
    bench.arbiter.renew("labcomm a", "yumi_left", "9")
    assert bench.results[3:] == [("labcomm a", "9", "aborted", "interrupted", "The lease on the arm expired.")]


def test_a_waiting_trajectory_is_refused_once_the_arm_has_not_been_ready_for_a_lease() -> None:
    bench = Bench()
    bench()
    bench.arbiter.submit(goal())
    bench.arbiter.renew("labcomm a", "yumi_left", "1")
    assert bench.results == []
    bench.now += round(1e9 * LEASE) + 1
    bench.arbiter.renew("labcomm a", "yumi_left", "1")
    why = "yumi_left is not ready. Send the goal again when the arm is ready."
    assert bench.results == [("labcomm a", "1", "aborted", "refused", why)]
    assert bench() is None


def test_the_newest_64_results_are_kept() -> None:
    bench = Bench()
    for k in range(65):
        bench.arbiter.submit(goal(f"{k}", "ros a"))
    for k, reason in (
        (1, "Expected a command through a server listed in `commands`, got a command through ros"),
        (0, "The lease on the arm expired."),
    ):
        bench.arbiter.renew("ros a", "yumi_left", f"{k}")
        assert bench.results[-1][4].startswith(reason)


step = st.tuples(st.booleans(), st.booleans(), st.sampled_from([0.0, 0.0, 0.01, 0.03, 0.2, np.nan]))


@settings(max_examples=15)
@given(st.lists(step, min_size=50, max_size=300), st.randoms(use_true_random=False))
def test_two_commanders_that_die_at_random(steps: list[tuple[bool, bool, float]], chance: Any) -> None:
    bench = Bench()
    alive = {"labcomm a": 1.0, "labcomm b": -1.0}
    dead_until = dict.fromkeys(alive, 0)
    holder, last = "", HOME
    for k, (first, second, move) in enumerate(steps):
        orders = []
        for (client, sign), sends in zip(alive.items(), (first, second), strict=True):
            if k >= dead_until[client] and chance.random() < 0.02:
                dead_until[client] = k + chance.randrange(80)
                if chance.random() < 0.5:
                    bench.arbiter.leave(client)
            if sends and k >= dead_until[client]:
                orders.append(Order(client, "yumi_left", HOME + sign * (move + 1e-3 * k / len(steps))))
        before = len(bench.events)
        command = bench(*orders)
        now = bench.arbiter.commander("yumi_left")
        told = bench.events[before:]
        assert (command is None) == (now == "")
        if command is not None:
            assert alive[now] * (command.q[0] - HOME[0]) >= 0.0
            assert np.all(np.abs(command.q - last) <= 0.1 + 1e-12)
            last = command.q
        if now and now != holder:
            assert f"{now} commands yumi_left." in told
        holder = now if now else ("" if any("no longer" in text for text in told) else holder)


def test_a_stop_while_a_command_comes_into_force_wins() -> None:
    """The threads of the guard and the servers also take requests, so a stop may come between check and command."""
    bench = Bench()
    arbiter = bench.arbiter
    arbiter._tell = lambda text, *_, **__: arbiter.stop("local 1") if "commands yumi_left" in text else None
    for _ in range(5):
        assert bench(order()) is None
        assert arbiter.stopped == "local 1"
    arbiter._tell = bench.tell
    arbiter.resume("local 1")
    assert arbiter.commander("yumi_left") == "", "every commander starts again under the start rule"


def test_a_client_of_ros_is_told_of_its_own_joints() -> None:
    """The last seven of fourteen numbers belong to the right arm, and ROS numbers a YuMi's joints from the base."""
    bench = Bench((RIGHT,), ("rosbridge",))
    q = np.array(RIGHT.q_home)
    q[2] += 1.0
    bench(Order("rosbridge a", RIGHT.name, q, first=7))
    assert "for yumi_robr_joint_3 (number 10 of the message) of yumi_right, which is at" in bench.answers[0][1]
    bench(Order("rosbridge b", RIGHT.name, np.where(np.arange(7) == 3, np.nan, 0.0), first=0))
    assert "got nan for yumi_robr_joint_4 (number 4 of the message)" in bench.answers[1][1]


def test_a_jump_is_refused_and_the_last_command_stays() -> None:
    bench = Bench()
    bench(order())
    assert bench(order(offset=0.2)).q[0] == HOME[0] + 0.01
    assert "Expected a position near the last position sent" in bench.answers[0][1]
    bench.q_sent["yumi_left"] = HOME + 0.2  # held elsewhere meanwhile
    assert bench() is None
    assert bench(order("labcomm b")) is None, "a refused command does not renew an old one"
    assert bench(order(offset=np.nan)) is None


def test_a_commander_may_lead_the_arm_further_than_it_may_enter() -> None:
    bench = Bench()
    for offset in (0.04, 0.08, 0.12):
        assert bench(order(offset=offset)).q[0] == HOME[0] + offset
    assert bench.events == ["labcomm a commands yumi_left."]


def test_before_anything_was_sent_the_measured_joints_count() -> None:
    """A first command far from the position sent is refused by the state machine, which states the reason."""
    bench = Bench()
    bench.q_sent["yumi_left"] = HOME + 0.2
    assert bench(order()) is not None
    bench = Bench()
    for offset, taken in ((0.01, 0.01), (0.02, 0.02), (0.2, 0.02)):
        bench.q_sent["yumi_left"] = np.full(7, np.nan)
        assert bench(order(offset=offset)).q[0] == HOME[0] + taken


def test_distances_are_those_of_the_axes_where_these_are_not_the_joints() -> None:
    """Axis 3 of an IRB 2400 is the sum of joints 2 and 3; the machine would refuse its jump three times and stop."""
    linked = robots.load("irb2400")
    bench = Bench((linked,))

    def at(second: float, third: float) -> np.ndarray:
        return linked.q_home + np.array([0.0, second, third, 0.0, 0.0, 0.0])

    def away(second: float, third: float) -> Order:
        return Order("labcomm a", linked.name, at(second, third))

    assert bench(away(0.03, 0.03)) is None
    assert "within 0.05 of where the arm is, got" in bench.answers[0][1]
    assert bench(away(0.049, -0.049)) is not None
    bench.now += 10**9
    bench(away(0.0, 0.0))
    assert bench(away(0.095, 0.095)).q[1] == linked.q_home[1]
    axis = linked.q_home[1] + linked.q_home[2]
    assert (
        f"last position sent, {axis:.4f}, for joint 3 (axis_3) of irb2400, got {axis + 0.19:.4f}" in bench.answers[1][1]
    )
    assert "ABB's axes" in bench.answers[1][1]
    bench.q_sent[linked.name] = at(0.06, 0.06)  # held elsewhere meanwhile
    assert bench() is None
    bench.q_sent[linked.name] = at(0.06, -0.06)
    assert bench() is not None


def test_the_ends_of_what_is_allowed_are_within() -> None:
    q = HOME + 0.05 * (np.arange(7) == 0)
    bench = Bench(entry=abs(q[0] - HOME[0]))
    assert bench(Order("labcomm a", "yumi_left", q)) is not None
    limits = bench.arbiter._limits
    limits["yumi_left"] = dataclasses.replace(limits["yumi_left"], jump=np.full(7, abs(q[0] - HOME[0])))
    bench.q_sent["yumi_left"] = HOME
    assert bench() is not None
    bench.q_sent["yumi_left"] = HOME
    assert bench(Order("labcomm a", "yumi_left", q)) is not None
    assert bench.arbiter.refused == {}


def test_a_joint_is_called_as_its_client_knows_it() -> None:
    """The third joint of a YuMi is ABB's axis 7; ROS numbers the joints from the base."""
    assert joint_name(RIGHT, 2) == f"joint 3 ({RIGHT.joint_names[2]})"
    assert joint_name(RIGHT, 2, by_axis=True) == "axis_7 (number 7 of the vector)"
    assert joint_name(RIGHT, 3, by_axis=True) == "axis_3 (number 3 of the vector)"
