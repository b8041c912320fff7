"""robot_state_publisher with the URDF of an arm, driven by the JointState messages of a recording."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import cli, kinematics, robots
from armlab.bridge.servers.ros.topics import FORMS
from armlab.lie import quaternion, se3
from armlab.log import Recorder, Tick
from armlab.state import State

from .conftest import PATIENCE, PYTHON, Ros

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
    """Return names and positions in the last message of a topic."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        connections = [one for one in reader.connections if one.topic == topic]
        messages: list[Any] = [reader.deserialize(raw, one.msgtype) for one, _, raw in reader.messages(connections)]
    return messages[-1].name, messages[-1].position.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["recording", "exported bag"])
def test_a_played_recording_drives_robot_state_publisher(ros: Ros, tmp_path: Path, kind: str) -> None:
    """Each link is where the arm's kinematics have it. Takes 5 s each."""
    imports = subprocess.run([PYTHON, "-c", "import tf2_msgs.msg"], capture_output=True, check=False)
    if not PUBLISHER.exists() or imports.returncode:
        pytest.skip("robot_state_publisher is missing (Debian: ros-robot-state-publisher python3-tf2-msgs)")
    with Recorder(tmp_path / "run.mcap", ARM) as recorder:
        for k in range(5):
            state = State(k * 0.004, 0.004, Q, np.zeros(7), np.zeros(7), seq=k, robot_ns=k * 4_000_000)
            recorder.row(state, None, Tick(k, k, 10**18 + k * 4_000_000, 0, -1, 0))
    path, topic = recorder.path, "/yumi_left/joint_states"
    if kind == "exported bag":
        path, topic = tmp_path / "run.rosbag2", "/joint_states"
        assert cli.main(["log", "export", str(recorder.path), str(path)]) == 0
    names, positions = played(path, topic)
    assert names == FORMS["joint_states"].message(ARM, 0, (tuple(Q), (), ())).name, "the live topic fits the same URDF"
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
