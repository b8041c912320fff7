"""A real master and real nodes under the system's Python: reading, commanding, and behaviour without them."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import select
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import cli, kinematics, robots
from armlab.bridge.cell import run_cell
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.net.sockets import pair
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.ros1.process import Ros1Process
from armlab.errors import LinkError
from armlab.lie import quaternion, se3
from armlab.log import Recorder, Tick
from armlab.state import State
from tests.processes import bound, free_port

from ..conftest import ServedProcess, cell_of
from .conftest import PATIENCE, PYTHON, Ros, end

ROWS = 750  # 3 s

READER = """
import json, sys, rospy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from rosgraph_msgs.msg import Log
numbers, values, names, texts = [], [], set(), []
def state(message):
    numbers.append(message.header.stamp.to_nsec())
    values.append(message.position[6])
    names.update(message.name)
rospy.init_node("reader")
rospy.Subscriber("/yumi_right/joint_states", JointState, state, tcp_nodelay=True, queue_size=1000)
rospy.Subscriber("/yumi_right/parameters", String, lambda message: texts.append(message.data))
end = rospy.get_time() + 60.0
while rospy.get_time() < end and (not numbers or numbers[-1] < int(sys.argv[1])):
    rospy.sleep(0.01)
print(json.dumps([numbers, values, sorted(names), texts]))
"""

COMMANDER = """
import sys, rospy
from std_msgs.msg import Float64MultiArray, Empty
from rosgraph_msgs.msg import Log
rospy.init_node("commander")
said = []
rospy.Subscriber("/rosout", Log, lambda message: said.append(message.msg))
commands = rospy.Publisher(sys.argv[1], Float64MultiArray, tcp_nodelay=True, queue_size=1)
data = [float(word) for word in sys.argv[2].split(",")]
end = rospy.get_time() + 60.0
while rospy.get_time() < end and not rospy.is_shutdown():
    commands.publish(Float64MultiArray(data=data))
    if any("/commander: " in text and sys.argv[3] in text for text in said):
        print("told")
        break
    rospy.sleep(0.004)
"""

LONG = ",".join(["0.123456"] * 8000), "Expected at most 65536 bytes of JSON"


def options(uri: str, python: str = PYTHON, host: str = "127.0.0.1") -> dict[str, Any]:
    return {"host": host, "master": uri, "python": python}


def on_a_network() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # selects a network interface without sending
        return str(probe.getsockname()[0])
    pytest.skip("this computer is not on a network")


class Running(ServedProcess):
    def __init__(self, stack: contextlib.ExitStack, uri: str, host: str = "127.0.0.1") -> None:
        super().__init__(stack, "ros1", options(uri, host=host), restarts=(1.0, 2.0))
        self.told, self.due = list[str](), time.monotonic()
        self.exchange.begin(lambda text, *_: self.told.append(text))

    def state(self) -> State:
        q = np.array(self.robot.q_home)
        q[6] = np.sin(self.number)
        return replace(super().state(), q=q)

    def until(self, condition: Callable[[], Any]) -> Any:
        end = time.monotonic() + PATIENCE
        while not (found := condition()):
            assert time.monotonic() < end, self.told
            self.row()
            self.exchange.arbiter(self.state())
            self.due = max(self.due + 0.004, time.monotonic() - 0.1)
            time.sleep(max(0.0, self.due - time.monotonic()))
        return found


@pytest.fixture
def running(ros: Ros) -> Iterator[Running]:
    with contextlib.ExitStack() as stack:
        yield Running(stack, ros.uri)


@pytest.mark.slow
def test_a_node_gets_every_row_in_order(ros: Ros, running: Running) -> None:
    assert running.where.startswith(f"127.0.0.1 (ros1, master {ros.uri}")
    reader = ros.program(READER, str(10**9))

    def is_read() -> bool:
        return sum(running.exchange.outlets["ros1"].clients.get("/yumi_right/joint_states", (0, 0))) > 0  # type: ignore[union-attr]

    running.exchange.outlets["ros1"].clients = {}
    running.until(lambda: running.exchange.outlets["ros1"].send(b'{"kind":"count"}') and is_read())
    last = running.number + ROWS
    running.until(lambda: running.number >= last)
    running.number = 10**9  # makes the reader exit
    running.until(lambda: reader.poll() is not None)
    assert reader.stdout is not None
    numbers, values, names, texts = json.loads(reader.stdout.read())
    assert names == sorted(running.robot.ros_joint_names)
    assert json.loads(texts[0]) == {"gain": 0.5}
    assert np.all(np.diff(numbers) > 0)
    assert values == np.sin(numbers).tolist()
    counted = [number for number in numbers if numbers[0] + 100 <= number <= last]
    assert len(counted) >= 0.999 * (last - numbers[0] - 100 + 1)
    assert len(counted) > 500


@pytest.mark.slow
def test_a_refusal_is_in_the_log_of_ros(ros: Ros, running: Running) -> None:
    for data, words in ((",".join(["9.0"] * 7), "first position within 0.05"), LONG):
        topic = "/yumi_right/joint_group_position_controller/command"
        commander = ros.program(COMMANDER, topic, data, words)
        running.until(lambda commander=commander: commander.poll() is not None)
        assert commander.stdout is not None
        assert commander.stdout.read() == b"told\n", words
    assert "ros1 /commander" in running.exchange.arbiter.refused


@pytest.mark.slow
@pytest.mark.parametrize("address", [lambda: "127.0.0.1", on_a_network], ids=["loopback", "network"])
def test_it_listens_at_its_address_only(ros: Ros, address: Callable[[], str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the relay, rospy listens at every address, unless its own is loopback."""
    monkeypatch.setenv("ROS_IPV6", "on")  # as in the user's shell
    with contextlib.ExitStack() as stack:
        running = Running(stack, ros.uri, host := address())
        assert running.where.startswith(f"{host} (ros1, ")
        assert bound(running.servers.processes()["ros1"]) == {host}


class Alone:
    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.exchange = Hub(
            [robots.load("yumi_right")], ["ros1"], Parameters([Parameter("gain", 0.5)]), about={"cell": "yumi"}
        )
        stack.callback(self.exchange.close)
        feed = stack.enter_context(self.exchange.open("ros1"))
        ours, theirs = pair()
        self.ours, self.node = stack.enter_context(ours), stack.enter_context(theirs)
        self.node.settimeout(PATIENCE)
        self.process = Ros1Process(feed, options("http://127.0.0.1:1"))
        self.process._node, self.process._log = self.ours, io.BytesIO()
        stack.callback(self.process._subscribers.close)

    def say(self, kind: str, *connections: int, **fields: Any) -> None:
        socket.send_fds(self.node, [json.dumps({"kind": kind, **fields}).encode()], connections)

    def hear(self) -> None:
        self.process._receive()

    def told(self) -> dict[str, Any]:
        return json.loads(self.node.recv(10_000))

    def asked(self) -> dict[str, Any]:
        data = self.exchange.outlets["ros1"].receive()
        assert data is not None
        return json.loads(data)


@pytest.fixture
def alone() -> Iterator[Alone]:
    with contextlib.ExitStack() as stack:
        yield Alone(stack)


def test_half_a_surrogate_pair_is_refused_and_the_server_goes_on(alone: Alone) -> None:
    alone.say("command", topic="/yumi_right/set_parameter", client="/node", content='{"gain": "\\ud800"}')
    alone.hear()
    assert "/node: Expected a request that can be encoded as UTF-8 JSON" in alone.told()["text"]


def test_a_command_may_come_before_the_node_is_ready(alone: Alone) -> None:
    alone.say("command", topic="/yumi_right/set_parameter", client="/node", content='{"gain": 2.0}')
    alone.say("ready", missing=["geometry_msgs/Wrench"])
    alone.process._begin()
    assert "not installed: geometry_msgs/Wrench" in alone.asked()["where"][0]
    assert alone.asked()["values"] == {"gain": 2.0}


def test_what_is_too_long_or_no_json_is_told_and_the_server_goes_on(alone: Alone) -> None:
    alone.node.send(b'{"kind": "command", "topic": "/yumi_right/stop", "clie')
    alone.say("refused", client="/node", text="Expected less.")
    alone.say("command", topic="/yumi_right/stop", client="/node", content=None)
    alone.hear()
    assert "Expected JSON from the ROS 1 node" in alone.asked()["text"]
    assert alone.asked() == {"kind": "report", "client": "/node", "text": "Expected less."}
    assert alone.asked()["kind"] == "stop"
    assert alone.told() == {"text": "/node: Expected less."}


def test_a_connection_that_the_node_hands_over_is_written_to(alone: Alone) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        alone.say("subscriber", ours.fileno(), topic="/yumi_right/parameters", client="/node", id=3)
        alone.hear()
        assert json.loads(theirs.recv(1000)[8:]) == {"gain": 0.5}


@pytest.mark.parametrize("came", [True, False])
def test_a_connection_without_room_is_ended_and_the_reason_told(
    alone: Alone, came: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armlab.bridge.servers.ros1.process._MOST", 0)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        numbers = [ours.fileno()] if came else []
        alone.say("subscriber", *numbers, topic="/yumi_right/parameters", client="/node", id=3)
        alone.hear()
        theirs.settimeout(PATIENCE)
        assert not came or theirs.recv(1) == b""
    words = "Expected at most 0 node connections" if came else "Raise `ulimit -n`."
    assert words in alone.told()["text"]
    assert alone.told() == {"topic": "/yumi_right/parameters", "id": 3}
    asked = alone.asked()
    assert (asked["kind"], asked["client"]) == ("report", "/node")
    assert words in asked["text"]


def test_each_of_many_nodes_is_answered_at_most_once_a_second(alone: Alone, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.ros1.process.time.monotonic", lambda: 100.0)
    for k in range(300):
        for _ in range(2):
            alone.process.answer(f"/node_{k}", "no")
        assert alone.told() == {"text": f"/node_{k}: no"}
        assert not select.select([alone.node], [], [], 0.0)[0]
    assert len(alone.process._answered) == 256


def test_what_is_missing_is_told_in_one_sentence(tmp_path: Path) -> None:
    exchange = Hub([robots.load("yumi_right")], ["ros1"], about={"cell": "yumi"})
    with exchange.open("ros1") as feed, pytest.raises(LinkError, match="Expected a Python with rospy at /none"):
        Ros1Process(feed, options("http://127.0.0.1:1", "/none")).run()
    without = tmp_path / "python"
    without.write_text(f'#!/bin/sh\nexec {os.path.realpath(PYTHON)} -I -S "$@"\n')
    without.chmod(0o755)
    with exchange.open("ros1") as feed, pytest.raises(LinkError, match=r"No module named .* Install python3-rospy\."):
        Ros1Process(feed, options("http://127.0.0.1:1", str(without))).run()
    exchange.close()


@pytest.mark.slow
def test_no_master_or_another_address_is_told_in_one_sentence() -> None:
    if subprocess.run([PYTHON, "-c", "import rospy"], capture_output=True, check=False).returncode:
        pytest.skip(f"rospy is not installed for {PYTHON} (Debian: python3-rospy)")
    exchange = Hub([robots.load("yumi_right")], ["ros1"], about={"cell": "yumi"})
    uri = f"http://127.0.0.1:{free_port()}"
    with exchange.open("ros1") as feed, pytest.raises(LinkError, match=f"master at {uri}.*Start roscore"):
        Ros1Process(feed, options(uri)).run()
    with (
        exchange.open("ros1") as feed,
        pytest.raises(LinkError, match=r"this computer for ros1, got 198\.51\.100\.1: "),
    ):
        Ros1Process(feed, options(uri, host="198.51.100.1")).run()
    exchange.close()


PUBLISHER = Path("/usr/lib/robot_state_publisher/robot_state_publisher")
ARM = robots.load("yumi_left")
Q = ARM.q_home + np.linspace(-0.2, 0.2, 7)

PLAYER = """
import json, subprocess, sys, rospy
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
names, positions, urdf, publisher = json.load(open(sys.argv[1]))
rospy.init_node("player")
rospy.set_param("robot_description", urdf)
found = {}
def take(message):
    for one in message.transforms:
        t, r = one.transform.translation, one.transform.rotation
        found[one.child_frame_id] = [one.header.frame_id, [t.x, t.y, t.z], [r.w, r.x, r.y, r.z]]
readers = [rospy.Subscriber(name, TFMessage, take) for name in ("/tf", "/tf_static")]
states = rospy.Publisher("/joint_states", JointState, queue_size=10)
process = subprocess.Popen([publisher])
end = rospy.get_time() + float(sys.argv[2])
while rospy.get_time() < end and not {"link_1", "link_7", "tool"} <= set(found):
    message = JointState(name=names, position=positions)
    message.header.stamp = rospy.Time.now()
    states.publish(message)
    rospy.sleep(0.02)
rospy.sleep(0.5)
process.terminate()
process.wait()
print(json.dumps(found))
"""


def played(path: Path, topic: str) -> tuple[list[str], list[float]]:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        connections = [one for one in reader.connections if one.topic == topic]
        messages: list[Any] = [reader.deserialize(raw, one.msgtype) for one, _, raw in reader.messages(connections)]
    return messages[-1].name, messages[-1].position.tolist()


@pytest.mark.slow
def test_a_played_recording_drives_robot_state_publisher(ros: Ros, tmp_path: Path) -> None:
    imports = subprocess.run([PYTHON, "-c", "import tf2_msgs.msg"], capture_output=True, check=False)
    if not PUBLISHER.exists() or imports.returncode:
        pytest.skip("robot_state_publisher is missing (Debian: ros-robot-state-publisher python3-tf2-msgs)")
    with Recorder(tmp_path / "run.mcap", ARM) as recorder:
        for k in range(5):
            state = State(k * 0.004, 0.004, Q, np.zeros(7), np.zeros(7), seq=k, robot_ns=k * 4_000_000)
            recorder.row(state, None, Tick(k, k, 10**18 + k * 4_000_000, 0, -1, 0))
    names, positions = played(recorder.path, "/yumi_left/joint_states")
    assert cli.main(["log", "export", str(recorder.path), str(tmp_path / "run.rosbag2")]) == 0
    assert played(tmp_path / "run.rosbag2", "/joint_states") == (names, positions)
    assert names == list(ARM.ros_joint_names), "the same names as in the live topic"
    robots.save(ARM, tmp_path / "arm.urdf")
    told = tmp_path / "told.json"
    told.write_text(json.dumps([names, positions, (tmp_path / "arm.urdf").read_text(), str(PUBLISHER)]))
    player = ros.program(PLAYER, str(told), "20")
    output, _ = player.communicate(timeout=PATIENCE)
    found = json.loads(output)
    frame, T_base_tool = "tool", np.eye(4)
    while frame != "base":
        frame, position, rotation = found[frame]
        T_base_tool = se3.from_rp(quaternion.to_matrix(np.array(rotation)), position) @ T_base_tool
    np.testing.assert_allclose(T_base_tool, kinematics.forward(ARM, Q), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_node_moves_the_arm_of_a_cell(ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    started: list[subprocess.Popen[bytes]] = []

    def ready(line: str) -> None:
        assert re.search(r"127\.0\.0\.1 \(ros1, master", line)
        topic = "/yumi_left/joint_group_velocity_controller/command"
        started.append(ros.program(COMMANDER, topic, "0,0,0,0.05,0,0,0", "never"))

    cell = cell_of("ros1", f'master = "{ros.uri}"', 'link = "sim://yumi_left"\nspeed = 0.5')
    run = run_cell(cell, seconds=4.0, ready=ready, patience=20.0)
    assert any("ros1 /commander commands yumi_left." in event for _, event in run.events)
    moved = run.table["q"][-1] - run.table["q"][0]
    assert moved[3] > 0.05
    assert np.abs(np.delete(moved, 3)).max() < 0.01


@pytest.mark.slow
def test_a_server_whose_relay_is_killed_starts_again_and_comes_back_when_the_master_does(
    ros: Ros, running: Running
) -> None:
    """Must be the last test of this module, because it ends the master."""
    server = running.servers.processes()["ros1"]
    (relay,) = Path(f"/proc/{server}/task/{server}/children").read_text().split()
    os.kill(int(relay), signal.SIGKILL)
    running.until(lambda: any("The server restarts in 1 s" in text for text in running.told))
    running.until(lambda: running.exchange.outlets["ros1"].where)
    end(ros.master)
    running.until(lambda: any("stopped or restarted" in text for text in running.told))
    ros.start()
    reader = ros.program(READER, str(10**9))
    running.until(lambda: running.exchange.outlets["ros1"].where)
    running.number = 10**9
    running.until(lambda: reader.poll() is not None)
    assert running.servers.dead == set()
