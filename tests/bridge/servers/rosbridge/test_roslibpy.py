"""roslibpy, a client that others wrote, against a whole cell: it runs in processes of its own, as its reactor wants."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from armlab.bridge.cell import parse_cell, run_cell

PROGRAM = """
import json, sys, threading
import roslibpy
port, role = int(sys.argv[1]), sys.argv[2]
ros = roslibpy.Ros("127.0.0.1", port)
ros.run(timeout=20)
got, found, enough = [], {}, threading.Event()
def state(message):
    got.append((message["header"]["seq"], message["position"][3]))
    if len(got) >= 1250:
        enough.set()
roslibpy.Topic(ros, "/yumi_left/joint_states", "sensor_msgs/JointState").subscribe(state)
if role == "deaf":
    print("ready", flush=True)
    threading.Event().wait(60)
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


@pytest.mark.slow
def test_roslibpy_reads_sets_and_commands_while_another_client_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one is stopped by a signal: this one gets 99.9 % all the same. Takes 15 s."""
    pytest.importorskip("roslibpy", reason="roslibpy is not installed (extra dev)")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    text = """
    commands = ["rosbridge"]
    [[robots]]
    name = "yumi_left"
    link = "sim://yumi_left"
    speed = 0.5
    [parameters.gain]
    default = 2.0
    maximum = 10.0
    rights = "anyone"
    [servers.rosbridge]
    port = 0
    """
    with contextlib.ExitStack() as stack:
        programs: list[subprocess.Popen[bytes]] = []

        def run(port: str, role: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-c", PROGRAM, port, role]
            program = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
            stack.callback(program.kill)
            programs.append(program)
            return program

        def ready(line: str) -> None:
            found = re.search(r":(\d+) \(rosbridge\)", line)
            assert found is not None, line
            deaf = run(found[1], "deaf")
            assert deaf.stdout is not None
            assert deaf.stdout.readline() == b"ready\n"
            os.kill(deaf.pid, signal.SIGSTOP)
            run(found[1], "commander")

        cell_run = run_cell(parse_cell(text), seconds=12.0, ready=ready, patience=30.0)
        output, _ = programs[1].communicate(timeout=30.0)
    found = json.loads(output)
    assert (found["before"], found["after"]) == (2.0, 3.0)
    assert "from -inf to 10" in found["refused"]
    assert found["stamp"] == ["nanosec", "sec"]
    assert "/yumi_left/joint_states" in found["topics"]
    numbers, joint = np.array(found["states"]).T
    assert np.all(np.diff(numbers) > 0)
    assert len(numbers) >= 1250
    assert len(numbers) >= 0.999 * (numbers[-1] - numbers[0] + 1)
    assert joint[-1] - joint[0] > 0.02
    assert set(joint) <= set(np.asarray(cell_run.table["q"])[:, 3]), "what the client read is what was measured"
    assert any("rosbridge 127.0.0.1:" in event and "commands yumi_left." in event for _, event in cell_run.events)
    assert cell_run.statistics["parameters"]["gain"] == 3.0


SCRIPT = Path(__file__).with_name("roslib_client.mjs")
CELL = """
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[parameters.gain]
default = 2.0
maximum = 10.0
rights = "anyone"
[servers.rosbridge]
port = 0
"""


def _installed(version: str, folder: Path) -> None:
    """Install a version of roslib into a folder, or skip the test with the reason."""
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
    """Names with and without the leading slash. Takes 15 s."""
    _installed(version, tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    programs: list[subprocess.Popen[str]] = []

    def ready(line: str) -> None:
        found = re.search(r":(\d+) \(rosbridge\)", line)
        assert found is not None, line
        command = ["node", str(tmp_path / SCRIPT.name), found[1]]
        programs.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))

    try:
        run_cell(parse_cell(CELL), seconds=10.0, ready=ready, patience=30.0)
        output, errors = programs[0].communicate(timeout=30.0)
    finally:
        for program in programs:
            program.kill()
    assert programs[0].returncode == 0, errors
    found = json.loads(output)
    assert {"/yumi_left/joint_states", "/yumi_left/stop"} <= set(found["topics"])
    assert found["params"] == ["gain"]
    assert found["type"] == ("sensor_msgs/JointState" if version.startswith("1.") else "sensor_msgs/msg/JointState")
    assert found["rows"] == [[7] * 20] * 2
    assert found["gain"] == 3.5
