"""Trajectories from ROS nodes: action services and topics with a loop in one thread, and peers over DDS."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

pytest.importorskip("rosbags", reason="rosbags is not installed")

from armlab import bridge, robots
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import CommandRequest, Leave, Renew, Stop, Subscribe, TrajectoryRequest
from armlab.bridge.servers.ros.actions import CANCEL, FOLLOW, ActionServers, Goal, Goals, _Goal, message, plain
from armlab.bridge.servers.ros.topics import store
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import CommandRefused
from armlab.log import Tick
from armlab.state import Command, State

from ....processes import free_port
from ..conftest import cell_of, play, until
from .conftest import turning_cell

ROBOT = robots.load("yumi_left")
NAMES = list(ROBOT.ros_joint_names)
ACTION = "/yumi_left/joint_trajectory_controller/follow_joint_trajectory"
TOPIC = "/yumi_left/joint_trajectory_controller/joint_trajectory"
ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 1, 2, 3, 4, 5, 6
PERIOD = 0.004


def seconds(value: float) -> dict[str, int]:
    return dict(zip(("sec", "nanosec"), divmod(round(1e9 * value), 10**9), strict=True))


def trajectory(*points: tuple[float, float], names: list[str] = NAMES, **more: Any) -> dict[str, Any]:
    """Return a trajectory of offsets from home, at rest at each point: (time [s], offset [rad])."""
    home = dict(zip(NAMES, ROBOT.q_home, strict=True))
    made = [
        {
            "positions": [float(home.get(name, 0.0) + offset) for name in names],
            "velocities": [0.0] * len(names),
            "time_from_start": seconds(t),
        }
        for t, offset in points
    ]
    return {"joint_names": names, "points": made, **more}


class Bench:
    """Loop and action servers; the arm follows at once unless `holds` is set."""

    def __init__(self, **options: Any) -> None:
        about = {"cell": "yumi", "speeds": {"yumi_left": (0.5 * ROBOT.qd_max).tolist()}}
        self.hub = Hub([ROBOT], ["ros2"], about=about, **{"allowed": ["ros2"], **options})
        self.feed: socket.socket = self.hub.open("ros2")
        self.loop = LoopEnd(self.feed)
        self.goals = Goals(self.loop)
        self.published: list[tuple[str, Any]] = []
        self.actions = ActionServers(self.goals, lambda topic, one: self.published.append((topic.name, one)), self.read)
        self.services = {one.name.rpartition("/")[2]: one for one in self.actions.services}
        self.q, self.sent = np.array(ROBOT.q_home), np.array(ROBOT.q_home)
        self.events: list[str] = []
        self.hub.begin(lambda text, warn=False, each=False: self.events.append(text))
        self.number = 0
        self.holds = False
        self.hub.arbiter._clock = self.now

    def now(self) -> int:
        return 10**12 + int(1e9 * PERIOD) * self.number

    def read(self) -> list[str]:
        return list(self.actions.topics)

    def tick(self, count: int = 1, serves: bool = True) -> None:
        for _ in range(count):
            self.number += 1
            state = State(
                PERIOD * self.number, PERIOD, self.q, np.zeros(7), np.full(7, np.nan), robot=ROBOT.name,
                q_sent=self.sent, qd_sent=np.zeros(7),
            )  # fmt: skip
            command = self.hub.arbiter(state)
            assert not isinstance(command, tuple)
            if command is not None and command.q is not None:
                self.sent = command.q
                self.q = self.q if self.holds else command.q
            self.row(state, command)
            if serves:
                self.serve()

    def row(self, state: State, command: Command | None) -> None:
        stamp = 10**9 + int(1e9 * PERIOD) * self.number
        self.hub.row(state, command, Tick(self.number, self.number, stamp, stamp, -1, 0))

    def serve(self) -> None:
        while found := self.loop.receive():
            for one in found:
                if isinstance(one, bytes):
                    self.goals.row(one, self.now())
                elif one["kind"] == "goal":
                    self.goals.text(one)

    def call(self, name: str, client: str = "a", **fields: Any) -> list[dict[str, Any]]:
        service, answers = self.services[name], list[dict[str, Any]]()
        raw = bytes(store().serialize_cdr(message(service.request, fields), service.request))
        service.take(raw, client, lambda cdr: answers.append(plain(store().deserialize_cdr(cdr, service.response))))
        return answers

    def send(self, number: int, goal: dict[str, Any], client: str = "a") -> list[dict[str, Any]]:
        (answer,) = self.call("send_goal", client, goal_id=uuid(number), goal=goal)
        assert answer["accepted"]
        return self.call("get_result", client, goal_id=uuid(number))

    def until(self, answers: list[dict[str, Any]], most: int = 4000) -> tuple[int, int, str]:
        while not answers and most > 0:
            self.tick()
            most -= 1
        (answer,) = answers
        return answer["status"], answer["result"]["error_code"], answer["result"]["error_string"]

    def close(self) -> None:
        self.hub.close()
        self.feed.close()

    def status(self) -> dict[int, int]:
        last = [one for name, one in self.published if name.endswith("status")][-1]
        return {int(one.goal_info.goal_id.uuid[0]): one.status for one in last.status_list}


def uuid(number: int) -> dict[str, bytes]:
    return {"uuid": bytes([number] * 16)}


@pytest.fixture
def bench() -> Iterator[Bench]:
    with contextlib.closing(Bench()) as made:
        yield made


def test_a_goal_arrives_with_feedback(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(**vars(time) | {"monotonic_ns": lambda: int(1e9 * PERIOD) * bench.number})
    monkeypatch.setattr("armlab.bridge.servers.hub.time", clock)
    order = [3, 0, 6, 1, 5, 2, 4]
    names = [NAMES[i] for i in order]
    result = bench.send(1, {"trajectory": trajectory((0.0, 0.0), (1.0, 0.1), names=names)})
    assert bench.status() == {1: ACCEPTED}
    bench.tick(2)
    assert bench.status() == {1: EXECUTING}
    assert bench.until(result) == (SUCCEEDED, 0, "")
    assert bench.status() == {1: SUCCEEDED}
    np.testing.assert_allclose(bench.q, ROBOT.q_home + 0.1)
    feedback = [one for name, one in bench.published if name.endswith("feedback")]
    assert 18 <= len(feedback) <= 21
    last = feedback[-1]
    assert bytes(last.goal_id.uuid) == uuid(1)["uuid"]
    assert list(last.feedback.joint_names) == NAMES
    t = 1e-9 * feedback[10].feedback.desired.time_from_start.nanosec
    expected = ROBOT.q_home + 0.1 * (3 * t**2 - 2 * t**3)
    np.testing.assert_allclose(feedback[10].feedback.desired.positions, expected, atol=1e-3)
    error = last.feedback.desired.positions - last.feedback.actual.positions
    np.testing.assert_allclose(last.feedback.error.positions, error, atol=1e-12)
    assert any("ros2 a commands yumi_left." in one for one in bench.events)
    assert bench.call("get_result", goal_id=uuid(1))[0]["status"] == SUCCEEDED, "asked again"
    assert bench.call("get_result", goal_id=uuid(9))[0]["status"] == 0


@pytest.mark.parametrize(
    ("goal", "code", "words"),
    [
        ({}, -1, "points, got none"),
        (trajectory((0.0, 0.0), (1.0, 0.1), names=[*NAMES[:6], "elbow"]), -2, "got 'elbow'"),
        (trajectory((0.0, 0.0), (1.0, 0.1), names=NAMES[:6]), -2, "no column for yumi_robl_joint_7"),
        (trajectory((0.0, 0.0), (1.0, 0.1), names=[]), -2, "joint_names, got none"),
        (trajectory((0.0, 0.0), (1.0, 0.1), (1.0, 0.2)), -1, "increasing times from 0 s, got 1 s at point 2"),
        (trajectory((0.0, 0.0), (1.0, 0.1), (1.01, 0.2)), -1, "speeds up to 1.571"),  # half of the robot's limit
        (trajectory((0.0, 0.0), (9.0, 3.0)), -1, "positions from"),
        (trajectory((0.0, 0.2), (1.0, 0.1)), -1, "first point to be near the arm"),
        (trajectory((0.01, 0.1), (1.0, 0.1)), -1, "to reach the first point"),
        (trajectory((1.0, 0.1), header={"stamp": seconds(1.0)}), -1, "ends in the future"),
        (trajectory((1.0, np.nan)), -1, "finite q"),
    ],
)
def test_refused_goals_are_aborted_with_the_reason(bench: Bench, goal: dict[str, Any], code: int, words: str) -> None:
    status, found, text = bench.until(bench.send(1, {"trajectory": goal}))
    assert (status, found) == (ABORTED, code)
    assert words in text
    bench.tick()
    assert any(words in one for one in bench.events)
    assert bench.hub.arbiter.commander("yumi_left") == ""
    np.testing.assert_array_equal(bench.sent, ROBOT.q_home)


def test_a_goal_while_another_client_commands_is_aborted(bench: Bench) -> None:
    first = bench.send(1, {"trajectory": trajectory((0.0, 0.0), (1.0, 0.1))})
    bench.tick(10)
    status, code, text = bench.until(bench.send(2, {"trajectory": trajectory((0.5, 0.0))}, "b"))
    assert (status, code) == (ABORTED, -1)
    assert "yumi_left is commanded by ros2 a" in text
    assert bench.until(first)[0] == SUCCEEDED


def test_a_newer_goal_of_the_same_client_replaces_the_first(bench: Bench) -> None:
    first = bench.send(1, {"trajectory": trajectory((0.0, 0.0), (1.0, 0.1))})
    bench.tick(125)
    wrong = bench.send(2, {"trajectory": trajectory((0.0, 0.3))})
    assert bench.until(wrong)[0] == ABORTED, "a refused goal changes nothing"
    assert not first
    second = bench.send(3, {"trajectory": trajectory((1.0, 0.0))})
    assert bench.until(first) == (ABORTED, -1, "A newer command replaced this command.")
    assert bench.until(second) == (SUCCEEDED, 0, "")
    np.testing.assert_allclose(bench.q, ROBOT.q_home, atol=1e-6)


def test_cancellation(bench: Bench) -> None:
    first = bench.send(1, {"trajectory": trajectory((0.0, 0.0), (9.0, 0.1))})
    bench.tick(10)
    (answer,) = bench.call("cancel_goal", "b", goal_info={"goal_id": uuid(1)})
    assert answer["return_code"] == 0
    assert answer["goals_canceling"][0]["goal_id"]["uuid"] == list(uuid(1)["uuid"])
    assert bench.status() == {1: CANCELING}
    status, _, text = bench.until(first)
    assert (status, text) == (CANCELED, "Canceled by ros2 a.")
    held = bench.sent
    bench.tick(10)
    np.testing.assert_array_equal(bench.sent, held)
    codes = [bench.call("cancel_goal", goal_info={"goal_id": uuid(k)})[0]["return_code"] for k in (1, 2, 0)]
    assert codes == [3, 2, 1], "ended, unknown, none left"
    second = bench.send(2, {"trajectory": trajectory((9.0, 0.1))})
    bench.tick(10)
    assert bench.call("cancel_goal", goal_info={})[0]["return_code"] == 0, "all"
    assert bench.until(second)[0] == CANCELED


def test_tolerances(bench: Bench) -> None:
    strict = [{"name": NAMES[2], "position": 0.01}]
    bench.holds = True
    status, code, text = bench.until(bench.send(1, {"trajectory": trajectory((1.0, 0.1)), "path_tolerance": strict}))
    assert (status, code) == (ABORTED, -4)
    assert "at yumi_robl_joint_3 (tolerance 0.01)" in text
    goal = {"trajectory": trajectory((1.0, 0.05)), "goal_time_tolerance": seconds(0.2)}
    bench.sent = bench.q
    status, code, text = bench.until(bench.send(2, goal))
    assert (status, code) == (ABORTED, -5)
    assert "0.2 s after the last point" in text
    bench.sent = bench.q
    loose = goal | {"goal_tolerance": [{"name": name, "position": -1.0} for name in NAMES]}
    assert bench.until(bench.send(3, loose))[0] == SUCCEEDED
    for wrong, words in (({"name": "elbow"}, "got 'elbow'"), ({"name": NAMES[0], "acceleration": 1.0}, "not measured")):
        assert words in bench.until(bench.send(4 + len(words), goal | {"goal_tolerance": [wrong]}))[2]


def test_the_lease_ends_with_the_server_or_the_client(bench: Bench) -> None:
    first = bench.send(1, {"trajectory": trajectory((9.0, 0.1))})
    bench.tick(10)
    bench.tick(35, serves=False)
    assert bench.hub.arbiter.commander("yumi_left") == ""
    assert bench.until(first)[2] == "Silent for 0.1 s."
    bench.send(2, {"trajectory": trajectory((9.0, 0.1))})
    bench.tick(10)
    assert bench.hub.arbiter.commander("yumi_left") == "ros2 a"
    bench.goals.leave("a")
    bench.loop.ask(Leave("a"))
    bench.tick(1)
    assert bench.hub.arbiter.commander("yumi_left") == ""
    assert "ros2 a no longer commands yumi_left: it disconnected. The arm holds." in bench.events


def test_an_arm_that_is_not_ready_refuses(bench: Bench) -> None:
    result = bench.send(1, {"trajectory": trajectory((1.0, 0.1))})
    nothing = State(0.0, PERIOD, bench.q, np.zeros(7), np.full(7, np.nan), robot=ROBOT.name)
    for _ in range(100):
        bench.number += 1
        bench.row(nothing, None)
        bench.serve()
    assert bench.until(result)[2] == "yumi_left is not ready. Send the goal again when the arm is ready."


@pytest.mark.parametrize("act", ["stop", "release"])
def test_operators_end_a_trajectory(bench: Bench, act: str) -> None:
    first = bench.send(1, {"trajectory": trajectory((9.0, 0.1))})
    bench.tick(10)
    getattr(bench.hub.arbiter, act)("local 1")
    status, _, text = bench.until(first)
    assert status == ABORTED
    assert text == {"stop": "All arms were stopped.", "release": "Released by local 1."}[act]


def test_a_client_may_use_the_name_of_a_goal_again(bench: Bench) -> None:
    ended: list[tuple[int, int, str]] = []
    for _ in range(2):
        goal = Goal("a", "yumi_left", "1", lambda *result: ended.append(result))
        bench.goals.start(goal, {"trajectory": trajectory((0.1, 0.0))})
        bench.tick(50)
    assert ended == [(SUCCEEDED, 0, "")] * 2


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda bench: bench.hub.arbiter.leave("ros2 a"), "The client disconnected."),
        (lambda bench: bench.hub.arbiter.stop("x") or bench.hub.arbiter.resume("x"), "x ended the stop."),
        (lambda bench: setattr(bench, "number", bench.number + 100), "yumi_left was not ready. Send the goal again."),
    ],
    ids=["leave", "resume", "late"],
)
def test_a_goal_that_waits_for_its_arm_gets_a_result(bench: Bench, act: Any, words: str) -> None:
    result = bench.send(1, {"trajectory": trajectory((1.0, 0.1))})
    bench.hub.poll()
    act(bench)
    assert bench.until(result) == (ABORTED, -1, words)
    assert bench.hub.arbiter.commander(ROBOT.name) == ""


def test_messages_of_the_topic(bench: Bench) -> None:
    refused: list[str] = []
    bench.goals.start_message(TOPIC, "a", trajectory((0.5, 0.1)), refused.append)
    bench.tick(200)
    np.testing.assert_allclose(bench.q, ROBOT.q_home + 0.1)
    assert refused == []
    bench.goals.start_message(TOPIC, "a", trajectory((0.0, 0.5)), refused.append)
    bench.tick(2)
    assert "A trajectory of ros2 a was refused: Expected the first point to be near the arm" in bench.events[-1]
    assert "first point to be near the arm" in refused.pop()
    with pytest.raises(CommandRefused, match="points, got none"):
        bench.goals.start_message(TOPIC, "a", {}, refused.append)
    bench.holds = True
    bench.goals.start_message(TOPIC, "a", trajectory((0.1, 0.0)), refused.append)
    bench.tick(600)
    assert "at the goal 2 s after the last point" in refused[0]


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ({"trajectory": 3}, "Expected `object`, got `int`"),
        (trajectory((1.0, 0.1), header={"stamp": {"sec": 10**400}}), "header.stamp.sec"),
        (trajectory((1.0, 0.1), names=["x" * 300]), "length <= 256"),
        ({"joint_names": NAMES, "points": [{"positions": [None] * 7}]}, "Expected `float`, got `null`"),
        ({"joint_names": NAMES, "points": [{"positions": [0.0] * 7, "effort": [1.0] * 7}]}, "no effort"),
    ],
)
def test_what_is_no_goal_is_refused(bench: Bench, goal: dict[str, Any], words: str) -> None:
    ended: list[str] = []
    made = Goal("a", "yumi_left", "1", lambda status, code, text: ended.append(text))
    bench.goals.start(made, goal if "trajectory" in goal else {"trajectory": goal})
    assert words in ended[0]


def test_a_long_trajectory_goes_in_parts(bench: Bench) -> None:
    many = trajectory(*((0.01 * k, 0.1 * (1.0 - np.cos(0.01 * k))) for k in range(1, 2002)))
    with pytest.raises(CommandRefused, match="length <= 2000"):
        bench.goals.start_message(TOPIC, "a", many, lambda why: None)
    del many["points"][0]
    del many["points"][-1]["velocities"]
    with pytest.raises(CommandRefused, match="7 velocities in every point"):
        bench.goals.start_message(TOPIC, "a", many, lambda why: None)
    for point in many["points"]:
        point.pop("velocities", None)
    result = bench.send(1, {"trajectory": many})
    assert bench.until(result, 9000) == (SUCCEEDED, 0, "")
    np.testing.assert_allclose(bench.q, many["points"][-1]["positions"], atol=1e-6)


def test_lost_parts_a_full_queue_and_a_goal_without_a_name(bench: Bench) -> None:
    many = trajectory(*((0.01 * k, 0.0) for k in range(1, 2001)))
    goal = Goal("a", ROBOT.name, "1", lambda *found: ended.append(found))
    ended: list[tuple[int, int, str]] = []
    requests = bench.goals._request(goal, msgspec.convert({"trajectory": many}, _Goal))
    assert len(requests) > 2
    bench.goals._send(goal, [*requests[:1], *requests[2:]])
    bench.tick(2)
    assert ended == [(ABORTED, -1, f"Expected {len(requests)} parts of the trajectory, got 1. Send it again.")]
    while bench.loop.ask(Renew("a", ROBOT.name, "2")):
        pass  # until the socket is full
    bench.loop.ask(Stop("a"))
    for _ in range(600):
        bench.loop.ask(Renew("a", ROBOT.name, "2"))
        bench.loop.ask(requests[0])
    for _ in range(400):
        bench.tick()
    assert bench.hub.arbiter.stopped == "ros2 a"
    bench.hub.arbiter.stopped = ""
    with pytest.raises(CommandRefused, match="goal with an id"):
        bench.goals._request(Goal("a", ROBOT.name, "", lambda *_: None), _Goal())
    bench.loop.ask(CommandRequest("a", ROBOT.name, qd=[0.01] * 7))
    bench.tick()
    assert bench.hub.arbiter.commander(ROBOT.name) == "ros2 a"
    for _ in range(60):
        bench.loop.ask(Renew("a", ROBOT.name, ""))
        bench.tick()
    assert bench.hub.arbiter.commander(ROBOT.name) == ""


def test_no_lease_is_renewed_between_the_parts_of_a_goal(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    many = trajectory(*((0.001 * k, 1e-4 * k) for k in range(1, 1001)))
    ask = bench.loop.ask

    def renew_first(request: Any) -> bool:
        if isinstance(request, TrajectoryRequest):
            bench.goals.renew(time.monotonic_ns())
            bench.tick(serves=False)
            bench.goals._renewed_ns = 0
        return ask(request)

    monkeypatch.setattr(bench.loop, "ask", renew_first)
    assert bench.until(bench.send(1, {"trajectory": many}), 2000) == (SUCCEEDED, 0, "")


def test_servers_that_only_read_or_do_not_command() -> None:
    for options, words in (
        ({"allowed": []}, "`commands`, got a command through ros2"),
        ({"read_only": ["ros2"]}, "read-only"),
    ):
        with contextlib.closing(Bench(**options)) as bench:
            status, _, text = bench.until(bench.send(1, {"trajectory": trajectory((1.0, 0.1))}))
        assert status == ABORTED
        assert words in text


def test_names_and_types_are_those_of_ros2(bench: Bench) -> None:
    assert {one.name: one.type for one in bench.actions.services} == {
        f"{ACTION}/_action/send_goal": f"{FOLLOW}_SendGoal",
        f"{ACTION}/_action/get_result": f"{FOLLOW}_GetResult",
        f"{ACTION}/_action/cancel_goal": CANCEL,
    }
    assert {name: one.type for name, one in bench.actions.topics.items()} == {
        f"{ACTION}/_action/feedback": f"{FOLLOW}_FeedbackMessage",
        f"{ACTION}/_action/status": "action_msgs/msg/GoalStatusArray",
    }
    assert set(bench.goals.topics) == {TOPIC}


@pytest.fixture(params=["ros2", "rmw_zenoh"])
def running(request: pytest.FixtureRequest) -> Iterator[Any]:
    with turning_cell(request.param) as one:
        yield one


def test_the_services_over_the_network(running: Any) -> None:
    def call(part: str, type_: str, **fields: Any) -> dict[str, Any]:
        request = message(f"{type_}_Request", fields)
        return plain(running.node.call(f"{ACTION}/_action/{part}", type_, request))

    status = running.node.read(f"{ACTION}/_action/status", "action_msgs/msg/GoalStatusArray")
    for number, names, expected in ((1, NAMES, (SUCCEEDED, 0, "")), (2, ["elbow"], (ABORTED, -2, "got 'elbow'"))):
        goal = {"trajectory": trajectory((0.3, 0.0), names=names)}
        answer = {"status": ABORTED, "result": {"error_code": -1}}
        while answer["status"] == ABORTED and answer["result"]["error_code"] == -1:  # the arm may not be ready yet
            number += 10
            assert call("send_goal", f"{FOLLOW}_SendGoal", goal_id=uuid(number), goal=goal)["accepted"]
            answer = call("get_result", f"{FOLLOW}_GetResult", goal_id=uuid(number))
        assert (answer["status"], answer["result"]["error_code"]) == expected[:2], answer
        assert expected[2] in answer["result"]["error_string"]
    assert call("cancel_goal", CANCEL, goal_info={"goal_id": uuid(11)})["return_code"] == 3
    until(lambda: status() and {SUCCEEDED, ABORTED} <= {one.status for one in status()[-1].status_list})
    goal = {"trajectory": trajectory((20.0, 0.0))}
    assert call("send_goal", f"{FOLLOW}_SendGoal", goal_id=uuid(3), goal=goal)["accepted"]
    until(lambda: status()[-1].status_list[-1].status in (EXECUTING, ABORTED))
    call("cancel_goal", CANCEL, goal_info={})
    until(lambda: running.exchange.arbiter.commander("yumi_left") == "", what="the end of the lease")
    until(lambda: status()[-1].status_list[-1].status in (CANCELED, ABORTED))


ARM = 'link = "sim://yumi_left"\nspeed = 0.5'
KINDS = {
    "actions": (("make", "gcc", "idlc"), "make gcc cyclonedds-dev cyclonedds-tools"),
    "fast_actions": (("make", "g++", "fastddsgen"), "make g++ libfastrtps-dev fastddsgen"),
}
"""Action clients built from IDL, in C with Cyclone DDS and in C++ with Fast DDS."""


def peer(folder: Path, kind: str, domain: int, *more: str) -> subprocess.Popen[str]:
    from .test_peers import SOURCES, _built

    environment = {**os.environ, "CYCLONEDDS_URI": f"file://{SOURCES}/loopback.xml"}
    command = [*_built(folder, kind, *KINDS[kind]), str(domain), *map(str, ROBOT.q_home), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_node_runs_trajectories(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
    from .dds_peers import free_domain

    domain, said = free_domain(), list[str]()

    def script() -> None:
        node = peer(tmp_path, kind, domain)
        out, errors = node.communicate(timeout=90.0)
        assert node.returncode == 0, errors
        said.extend(out.splitlines())

    run = play(monkeypatch, cell_of("ros2", f"domain = {domain}", ARM), script)
    goals = {line.split(" ", 1)[0]: line.split(" ", 4)[1:] for line in said}
    assert goals["1"][:2] == ["4", "0"], said
    assert int(goals["5"][2]) > 10
    assert goals["C"] == ["0", "1"]
    for name, status, code, words in (
        ("2", CANCELED, "-1", "Canceled by ros2"),
        ("3", ABORTED, "-2", "got 'elbow'"),
        ("4", ABORTED, "-1", "A newer command replaced this command."),
        ("5", SUCCEEDED, "0", ""),
    ):
        assert goals[name][:2] == [str(status), code], said
        assert words in goals[name][3]
    np.testing.assert_allclose(run.table["q"][-1], ROBOT.q_home + 0.05, atol=0.01)
    check_limits(run)


@pytest.mark.slow
def test_the_arm_rests_after_its_client_was_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lease of a killed node ends after 10 s by default. Takes 20 s."""
    pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
    from .dds_peers import free_domain

    domain, gone = free_domain(), list[bool]()

    def script() -> None:
        node = peer(tmp_path, "actions", domain, "stay")
        assert node.stdout is not None
        assert node.stdout.readline().startswith("1 4 0")
        assert node.stdout.readline() == "moving\n"
        node.kill()
        node.communicate()
        with LocalFeed("yumi", patience=30.0) as feed:
            feed.ask(Subscribe(rate=10.0))
            until(lambda: row_of(feed)["yumi_left.commander"] == "", patience=30.0, what="the end of the lease")
            gone.append(True)
            until(lambda: np.abs(row_of(feed)["yumi_left.qd"]).max() < 1e-3, what="rest")

    run = play(monkeypatch, cell_of("ros2", f"domain = {domain}", ARM), script)
    assert gone
    assert any("it disconnected. The arm holds." in event for _, event in run.events)
    np.testing.assert_allclose(run.table.dropna("qd_sent")["qd_sent"][-1], 0.0, atol=1e-9)
    check_limits(run)


def row_of(feed: LocalFeed) -> Any:
    while isinstance(one := feed.receive(), dict):
        pass
    return one.values


def check_limits(run: Any) -> None:
    qd = run.table.dropna("qd_sent")["qd_sent"]
    assert np.all(np.abs(qd) <= 0.5 * ROBOT.qd_max + 1e-9)
    assert run.statistics["problems"] == []


@pytest.mark.slow
def test_a_minute_is_tracked_as_by_a_controller_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compares tracking of 600 points with a loop that follows the spline itself. Takes 40 s."""
    client = pytest.importorskip("websockets.sync.client", reason="the extra net is not installed")
    t = np.linspace(0.0, 60.0, 601)
    envelope = np.sin(np.pi * t / 60.0)[:, None] ** 2
    swings = np.sin(2.0 * np.pi * t[:, None] * np.linspace(0.1, 0.3, 7))
    path = CubicSpline(t, ROBOT.q_home + 0.2 * envelope * swings, bc_type="clamped")
    points = [
        {"positions": q.tolist(), "velocities": qd.tolist(), "time_from_start": seconds(float(when))}
        for when, q, qd in zip(t, path(t), path(t, 1), strict=True)
    ]
    goal = {"op": "send_action_goal", "id": "1", "action": ACTION, "args": {}}
    goal["args"] = {"trajectory": {"joint_names": NAMES, "points": points}}
    port, found = free_port(), list[dict[str, Any]]()

    def script() -> None:
        with client.connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None) as socket_:
            while not found or "not ready" in found[-1]["values"]["error_string"]:
                socket_.send(json.dumps(goal))
                found.append(json.loads(socket_.recv(timeout=120.0)))

    lockstep = 'link = "sim://yumi_left?lockstep=true"'
    run = play(monkeypatch, cell_of("rosbridge", f"port = {port}", lockstep), script)
    assert found[-1]["values"] == {"error_code": 0, "error_string": ""}

    def follow(state: State) -> Command:
        return Command(path(state.t), path(state.t, 1)) if state.t < 60.0 else Command.stop()

    with bridge.connect("sim://yumi_left?lockstep=true", ROBOT) as link:
        other = link.run(follow, 61.0)
    errors = []
    for one in (run, other):
        table = one.table.dropna("q_ref")
        errors.append(np.sqrt(np.mean((table["q_ref"] - table["q"]) ** 2, axis=0)))
        sent = one.table.dropna("qd_sent")["qd_sent"]
        assert np.all(np.abs(sent) <= ROBOT.qd_max)
    assert np.all(errors[0] <= 1.02 * errors[1] + 1e-6), errors
    assert run.statistics["problems"] == []
