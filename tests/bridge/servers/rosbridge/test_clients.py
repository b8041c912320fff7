"""Third-party clients (roslibpy and roslib) and lost clients, against a complete cell.

A lost computer is simulated by a proxy that stops forwarding but closes no connection.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import selectors
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.cell import Cell

from ....processes import free_port
from ..conftest import cell_of, play, until
from .conftest import HANDSHAKE

LOST_PROGRAM = """
import json, sys, time
from websockets.sync.client import connect
port, role, topics = int(sys.argv[1]), sys.argv[2], sys.argv[3:]
with connect(f"ws://127.0.0.1:{port}", compression=None, max_queue=None) as client:
    for name in topics:
        client.send(json.dumps({"op": "subscribe", "topic": f"/yumi_left/{name}"}))
    print("ready", flush=True)
    if role == "reader":
        numbers = [json.loads(text)["msg"]["header"]["seq"] for text in client]  # until the server closes
        print(json.dumps(numbers), flush=True)
        sys.exit()
    message = {"data": [0.0] * 7}
    command = {"op": "publish", "topic": "/yumi_left/joint_group_velocity_controller/command", "msg": message}
    for count in range(100000):
        client.recv(60) if count == 0 else time.sleep(0.01)
        client.send(json.dumps(command))
        if count == 50:
            print("commanding", flush=True)
"""

MANY = ("joint_states", "joint_states_sent", "tcp_pose", "egm_states", "wrench_hat", "joint_states_ref")
GAIN = '[parameters.gain]\ndefault = 2.0\nmaximum = 10.0\nrights = "anyone"'


def cell_at(port: int, settings: str = "") -> Cell:
    arm = 'link = "sim://yumi_left"\nspeed = 0.5'
    return cell_of("rosbridge", f"port = {port}\n{settings}\n{GAIN}", arm)


class Proxy:
    def __init__(self, stack: contextlib.ExitStack, port: int) -> None:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.port = listener.getsockname()[1]
        self.is_dead, self.closed, self._over = threading.Event(), threading.Event(), threading.Event()
        thread = threading.Thread(target=self._carry, args=(listener, port))
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._over.set)

    def _carry(self, listener: socket.socket, port: int) -> None:
        listener.settimeout(20.0)
        client, _ = listener.accept()
        with client, socket.create_connection(("127.0.0.1", port)) as server, selectors.DefaultSelector() as ready:
            ready.register(client, selectors.EVENT_READ, server)
            ready.register(server, selectors.EVENT_READ, client)
            while not self._over.is_set() and not self.is_dead.is_set():
                for key, _ in ready.select(0.05):
                    key.data.sendall(key.fileobj.recv(65536))  # type: ignore[union-attr]
            name = "{}:{}".format(*server.getsockname())
            while not self._over.is_set() and not self.closed.is_set():
                if not _is_connected(name, port):
                    self.closed.set()
                self._over.wait(0.05)


def _is_connected(name: str, port: int) -> bool:
    """Return whether the system lists the server's end of a connection."""
    return any(
        _address(words[1]) == f"127.0.0.1:{port}" and _address(words[2]) == name and words[3] == "01"
        for words in map(str.split, Path("/proc/net/tcp").read_text().splitlines()[1:])
    )


def _address(text: str) -> str:
    host, port = text.split(":")
    return f"{socket.inet_ntoa(bytes.fromhex(host)[::-1])}:{int(port, 16)}"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="lists connections on Linux only")
def test_one_client_reads_while_the_others_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes 20 s: a lost client is disconnected after 10 s without progress, or 15 s without a pong."""
    port, programs, proxies = free_port(), list[subprocess.Popen[bytes]](), list[Proxy]()
    with contextlib.ExitStack() as stack:

        def run(port: int, role: str, *topics: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-c", LOST_PROGRAM, str(port), role, *topics]
            program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            programs.append(stack.enter_context(program))
            stack.callback(program.kill)
            said(program, b"ready\n")
            return program

        def script() -> None:
            silent = stack.enter_context(socket.create_connection(("127.0.0.1", port), 60.0))
            silent.sendall(HANDSHAKE)
            proxies.extend(Proxy(stack, port) for _ in range(2))
            run(port, "reader", "joint_states")
            os.kill(run(port, "reader", *MANY).pid, signal.SIGSTOP)
            run(proxies[0].port, "reader", *MANY)
            proxies[0].is_dead.set()
            said(run(proxies[1].port, "commander", "tcp_pose"), b"commanding\n")
            proxies[1].is_dead.set()
            killed = run(port, "commander", "tcp_pose")
            said(killed, b"commanding\n")
            killed.kill()
            heard = b""
            while part := silent.recv(4096):
                heard += part
            assert b"\x89\x04" in heard, "a ping"
            assert b"keepalive ping timeout" in heard
            until(lambda: all(proxy.closed.is_set() for proxy in proxies), what="the end of the lost clients")

        cell_run = play(monkeypatch, cell_at(port, 'dialect = "ros1"'), script)
        output, _ = programs[0].communicate(timeout=30.0)
    numbers = np.array(json.loads(output))
    assert len(numbers) > 1000
    assert np.all(np.diff(numbers) > 0)
    assert len(numbers) >= 0.999 * (numbers[-1] - numbers[0] + 1)
    assert re.search(r"Rows from this server to its clients: .* dropped\)", cell_run.report())
    served = cell_run.statistics["servers"]["rosbridge"]
    assert served["lost"] == 0, "neither the loop nor the server waited for a client"
    assert sum(dropped > 0 for _, dropped in served["clients"].values()) == 3  # one stopped and two lost clients
    freed = [event for _, event in cell_run.events if "no longer commands yumi_left" in event]
    assert len(freed) == 2, cell_run.events
    assert cell_run.statistics["missed"] <= 0.001 * cell_run.statistics["packets"]


def said(program: subprocess.Popen[bytes], line: bytes) -> None:
    assert program.stdout is not None
    assert program.stdout.readline() == line


PROGRAM = """
import json, sys, threading
import roslibpy
ros = roslibpy.Ros("127.0.0.1", int(sys.argv[1]))
ros.run(timeout=20)
got, found, enough = [], {}, threading.Event()
def state(message):
    got.append((message["header"]["seq"], message["position"][3]))
    if len(got) >= 500:
        enough.set()
roslibpy.Topic(ros, "/yumi_left/joint_states", "sensor_msgs/JointState").subscribe(state)
poses = []
roslibpy.Topic(ros, "/yumi_left/tcp_pose", "geometry_msgs/msg/PoseStamped").subscribe(poses.append)
gain = roslibpy.Param(ros, "gain")
found["before"] = gain.get(timeout=20)
gain.set(3.0, timeout=20)
found["after"] = gain.get(timeout=20)
try:
    gain.set(99.0, timeout=20)
except Exception as error:
    found["refused"] = str(error)
command = roslibpy.Topic(ros, "/yumi_left/joint_group_velocity_controller/command", "std_msgs/Float64MultiArray")
over = threading.Event()
def push():
    while not over.wait(0.01):
        command.publish(roslibpy.Message({"data": [0.0, 0.0, 0.0, 0.05, 0.0, 0.0, 0.0]}))
thread = threading.Thread(target=push)
thread.start()
enough.wait(40)
over.set()
thread.join()
found.update(states=got, stamp=sorted(poses[0]["header"]["stamp"]), topics=ros.get_topics())
print(json.dumps(found), flush=True)
ros.terminate()
"""


def beside_a_cell(monkeypatch: pytest.MonkeyPatch, command: Sequence[str], *more: str) -> tuple[Any, Any]:
    """Run a client program, with the port of a cell; return the run of the cell and the program's JSON."""
    port, found = free_port(), list[Any]()

    def script() -> None:
        words = [*command, str(port), *more]
        done = subprocess.run(words, capture_output=True, text=True, timeout=90.0, check=False)
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout))

    return play(monkeypatch, cell_at(port), script), found[0]


@pytest.mark.slow
def test_roslibpy_reads_sets_and_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("roslibpy", reason="roslibpy is not installed (extra dev)")
    cell_run, found = beside_a_cell(monkeypatch, [sys.executable, "-c", PROGRAM])
    assert (found["before"], found["after"]) == (2.0, 3.0)
    assert "from -inf to 10" in found["refused"]
    assert found["stamp"] == ["nanosec", "sec"]
    assert "/yumi_left/joint_states" in found["topics"]
    numbers, joint = np.array(found["states"]).T
    assert np.all(np.diff(numbers) > 0)
    assert len(numbers) >= 500
    assert len(numbers) >= 0.999 * (numbers[-1] - numbers[0] + 1)
    assert joint[-1] - joint[0] > 0.02
    assert set(joint) <= set(np.asarray(cell_run.table["q"])[:, 3]), "the client read the measured values"
    assert any("rosbridge 127.0.0.1:" in event and "commands yumi_left." in event for _, event in cell_run.events)
    assert cell_run.statistics["parameters"]["gain"] == 3.0


SCRIPT = Path(__file__).with_name("roslib_client.mjs")


def _installed(version: str, folder: Path) -> None:
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node or npm is not installed")
    found = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    if version.startswith("2.") and int(found[1:].partition(".")[0]) < 20:
        pytest.skip(f"roslib {version} needs Node.js 20, found {found.strip()}")
    options = ["--no-save", "--no-package-lock", "--ignore-scripts", "--no-audit", "--no-fund"]
    command = [npm, "install", "--prefix", str(folder), *options, f"roslib@{version}"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300.0, check=False)
    if done.returncode:
        pytest.skip(f"npm does not install roslib {version}: {(done.stderr.splitlines() or ['no reason'])[0]}")
    shutil.copy(SCRIPT, folder)


@pytest.mark.slow
@pytest.mark.parametrize("version", ["1.4.1", "2.1.0"])
def test_roslib_reads_topics_and_parameters(version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _installed(version, tmp_path)
    _, found = beside_a_cell(monkeypatch, ["node", str(tmp_path / SCRIPT.name)])
    assert {"/yumi_left/joint_states", "/yumi_left/stop"} <= set(found["topics"])
    assert found["params"] == ["gain"]
    assert found["type"] == ("sensor_msgs/JointState" if version.startswith("1.") else "sensor_msgs/msg/JointState")
    assert found["rows"] == [[7] * 20] * 2
    assert found["gain"] == 3.5


ACTIONS = """
const ROSLIB = await import("roslib");
const [port, home] = [process.argv[2], JSON.parse(process.argv[3])];
const ros = new ROSLIB.Ros({ url: `ws://127.0.0.1:${port}` });
await new Promise((resolve, reject) => (ros.on("connection", resolve), ros.on("error", reject)));
const name = "/yumi_left/joint_trajectory_controller/follow_joint_trajectory";
const action = new ROSLIB.Action({ ros, name, actionType: "control_msgs/action/FollowJointTrajectory" });
const names = home.map((_, i) => `yumi_robl_joint_${i + 1}`).reverse();
const point = (offset, sec) => ({
  positions: home.map((q) => q + offset).reverse(), velocities: home.map(() => 0.0), time_from_start: { sec },
});
const goal = (joint_names, ...points) => ({ trajectory: { joint_names, points } });

function run(message, onFeedback = () => {}) {
  let id;
  const done = new Promise((resolve) => {
    const feedback = [];
    id = action.sendGoal(message, (result) => resolve({ result, feedback }),
      (one) => (feedback.push(one), onFeedback(id, feedback.length)), (error) => resolve({ error, feedback }));
  });
  return done;
}

const found = { servers: await new Promise((resolve, reject) => ros.getActionServers(resolve, reject)) };
do found.moved = await run(goal(names, point(0.1, 1))); while (/not ready/.test(found.moved.error));
found.canceled = await run(goal(names, point(0.0, 9)), (id, count) => count === 5 && action.cancelGoal(id));
found.wrong = await run(goal([...names.slice(1), "elbow"], point(0.0, 1)));
found.fast = await run(goal(names, point(0.4, 0)));
found.empty = await run({});
let second;
found.first = await run(goal(names, point(0.0, 9)), (id, count) => {
  if (count === 5) second = run(goal(names, point(0.05, 1)));
});
found.second = await second;
const topic = new ROSLIB.Topic({
  ros, name: name.replace("follow_joint", "joint"), messageType: "trajectory_msgs/msg/JointTrajectory",
});
const states = new ROSLIB.Topic({ ros, name: "/yumi_left/joint_states", messageType: "sensor_msgs/msg/JointState" });
const there = new Promise((resolve) => states.subscribe(({ position }) => {
  if (Math.abs(position[0] - home[0] - 0.1) < 1e-3) resolve(position);
}));
topic.publish(goal(names, point(0.1, 1)).trajectory);
found.there = await there;
process.stdout.write(`${JSON.stringify(found)}\\n`, () => process.exit(0));
"""


@pytest.mark.slow
def test_roslib_runs_trajectories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _installed("2.1.0", tmp_path)
    (tmp_path / "actions.mjs").write_text(ACTIONS)
    home = robots.load("yumi_left").q_home
    command = ["node", str(tmp_path / "actions.mjs")]
    cell_run, found = beside_a_cell(monkeypatch, command, json.dumps(home.tolist()))
    assert found["servers"] == ["/yumi_left/joint_trajectory_controller/follow_joint_trajectory"]
    assert found["moved"].get("result") == {"error_code": 0, "error_string": ""}, found["moved"]
    feedback = found["moved"]["feedback"]
    assert len(feedback) > 10
    last = feedback[-1]
    assert last["joint_names"][0] == "yumi_robl_joint_1"
    np.testing.assert_allclose(last["actual"]["positions"], home + 0.1, atol=0.02)
    error = np.subtract(last["desired"]["positions"], last["actual"]["positions"])
    np.testing.assert_allclose(last["error"]["positions"], error, atol=1e-12)
    times = [one["desired"]["time_from_start"] for one in feedback]
    seconds = np.array([one["sec"] + 1e-9 * one["nanosec"] for one in times])
    assert np.all(np.diff(seconds) > 0.04)
    assert 0.8 < seconds[-1] < 3.0
    for name, code, words in (
        ("canceled", -1, "was canceled.*Canceled by rosbridge 127.0.0.1"),
        ("wrong", -2, "was aborted.*name of a joint, got .*elbow"),
        ("fast", -1, "was aborted.*first point to be near the arm"),
        ("empty", -1, "was aborted.*points, got none"),
        ("first", -1, "was aborted.*newer command replaced this command"),
    ):
        assert re.search(words, found[name]["error"]), found[name]["error"]
        assert f'"error_code":{code}' in found[name]["error"]
    assert found["second"]["result"]["error_code"] == 0
    np.testing.assert_allclose(found["there"], home + 0.1, atol=0.01)
    sent = cell_run.table.dropna("qd_sent")["qd_sent"]
    assert np.all(np.abs(sent) <= robots.load("yumi_left").qd_max * 0.5 + 1e-9)
    np.testing.assert_allclose(sent[-1], 0.0, atol=1e-6)
    assert any("name of a joint, got 'elbow'" in event for _, event in cell_run.events)
