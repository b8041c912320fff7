"""ROS 2 itself: rclpy with Fast DDS, from the distributions that have packages for Python 3.11.

Services are also tested with Cyclone DDS in C, whose messages are those of rmw_cyclonedds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import pytest

from armlab.bridge.inputs.parameters import Parameter

from .test_peers import SOURCES, Stream, _built

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
pytestmark = pytest.mark.slow
GAIN = Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights="anyone")
PACKAGES = {"jazzy": "ros-jazzy-{}", "kilted": "ros-{}"}

PROGRAM = """
import json, sys, time, rclpy
from rcl_interfaces import msg, srv
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
rclpy.init()
node, found = rclpy.create_node("theirs"), {"joints": 0, "urdf": ""}
late = rclpy.qos.QoSProfile(depth=1, durability=rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL)
velocity = node.create_publisher(Float64MultiArray, "/yumi_left/joint_group_velocity_controller/commands", 10)

def joints(message):
    found["joints"] += 1
    velocity.publish(Float64MultiArray(data=[0.05] * 7))

def urdf(message):
    found["urdf"] = message.data

node.create_subscription(JointState, "/yumi_left/joint_states", joints, 10)
node.create_subscription(String, "/yumi_left/robot_description", urdf, late)

def call(name, **fields):
    kind = getattr(srv, "".join(word.capitalize() for word in name.split("_")))
    client = node.create_client(kind, "/yumi_left/" + name)
    assert client.wait_for_service(20.0), name
    future = client.call_async(kind.Request(**fields))
    rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
    return future.result()

def gain(value, kind=3):
    given = msg.ParameterValue(type=kind, double_value=value)
    return msg.Parameter(name="gain", value=given)

end = time.monotonic() + 30.0
arm = lambda: [one for one in node.get_node_names_and_namespaces() if one[0] == "yumi_left"]
while time.monotonic() < end and not (found["joints"] > 500 and found["urdf"] and arm()):
    rclpy.spin_once(node, timeout_sec=0.1)
found["names"] = call("list_parameters").result.names
results = call("set_parameters", parameters=[gain(0.75), gain(7.5)]).results
found["set"] = [[one.successful, one.reason] for one in results]
found["gain"] = call("get_parameters", names=["gain"]).values[0].double_value
found["nodes"] = sorted(node.get_node_names())
found["services"] = [name for name, _ in node.get_service_names_and_types_by_node("yumi_left", "/")]
found["publishers"] = [name for name, _ in node.get_publisher_names_and_types_by_node("yumi_left", "/")]
print(json.dumps(found))
"""


@pytest.fixture(scope="module", params=PACKAGES)
def rclpy(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    if sys.version_info[:2] != (3, 11):
        pytest.skip("the ROS 2 packages require Python 3.11")
    folder = tmp_path_factory.mktemp(request.param)
    venv.create(folder, with_pip=True)
    packages = [PACKAGES[request.param].format(name) for name in ("rclpy", "rmw-fastrtps-cpp", "sensor-msgs")]
    python = str(folder / "bin" / "python")
    made = subprocess.run(
        [python, "-m", "pip", "install", "-q", *packages], capture_output=True, text=True, check=False
    )
    if made.returncode:
        pytest.skip(f"ROS 2 {request.param} cannot be installed here: {made.stderr[-200:]}")
    return python


def test_a_node_of_ros_2_knows_the_arm_reads_commands_and_sets(rclpy: str) -> None:
    with Stream([GAIN]) as stream:
        more = {"ROS_DOMAIN_ID": str(stream.domain), "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
        done = subprocess.run(
            [rclpy, "-c", PROGRAM], env={**os.environ, **more}, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, done.stderr
        found: dict[str, Any] = json.loads(done.stdout)
        assert found["joints"] > 500
        assert len(stream.commands) > 100
        assert found["names"] == ["gain"]
        (good, bad) = found["set"]
        assert good == [True, ""]
        assert not bad[0]
        assert "Expected a number from 0 to 1 for the parameter gain" in bad[1]
        assert found["gain"] == stream.exchange.parameters.values()["gain"] == 0.75
        assert found["nodes"] == ["theirs", "yumi", "yumi_left"]
        assert "/yumi_left/get_parameters" in found["services"]
        assert "/yumi_left/joint_states" in found["publishers"]
        assert found["urdf"].startswith("<?xml")


def test_a_node_with_cyclone_dds_in_c_sets_parameters(tmp_path: Path) -> None:
    tools = "make", "gcc", "idlc"
    command = _built(tmp_path, "services", tools, "make gcc cyclonedds-dev cyclonedds-tools")
    more = {"CYCLONEDDS_URI": f"file://{SOURCES}/loopback.xml"}
    with Stream([GAIN]) as stream:
        words = [*command, str(stream.domain)]
        done = subprocess.run(
            words, env={**os.environ, **more}, capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0
        names, good, bad, got = done.stdout.splitlines()
        assert (names, good.strip(), got) == ("name gain", "set 1", "get 3 0.75")
        assert bad.startswith("set 0 Expected a number from 0 to 1 for the parameter gain")
        assert stream.exchange.parameters.values()["gain"] == 0.75
