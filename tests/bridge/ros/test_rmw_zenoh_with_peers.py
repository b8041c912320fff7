"""Other versions of Zenoh as router and as node: each wheel in a virtual environment of its own (level 2)."""

from __future__ import annotations

import json
import subprocess
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.cell import parse_cell
from armlab.bridge.ros import store

from ..zenoh.conftest import free_port
from ..zenoh.test_cell import play

pytest.importorskip("zenoh", reason="the extra net is not installed")
pytest.importorskip("xxhash", reason="the extra net is not installed")

from armlab.bridge.ros.rmw_zenoh_names import Names

pytestmark = pytest.mark.slow

JOINTS, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
STATES, COMMANDS = "/yumi_left/joint_states", "/yumi_left/joint_group_velocity_controller/commands"
CELL = """
commands = ["rmw_zenoh"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.rmw_zenoh]
port = {port}
"""

ROUTER = """
import json, sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", json.dumps(["tcp/127.0.0.1:" + sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("open", flush=True)
    sys.stdin.read()
"""

NODE = """
import json, struct, sys, time, zenoh
port, states, commands, raw = sys.argv[1:]
config = zenoh.Config()
config.insert_json5("mode", '"peer"')
config.insert_json5("connect/endpoints", json.dumps(["tcp/127.0.0.1:" + port]))
config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
config.insert_json5("scouting/multicast/enabled", "false")
numbers, last = [], [b""]

def take(sample):
    seq, stamp, size = struct.unpack_from("<qqB", sample.attachment.to_bytes())
    assert size == 16
    numbers.append(seq)
    last[0] = sample.payload.to_bytes()

with zenoh.open(config) as session:
    reader = session.declare_subscriber(states, take)
    print("open", flush=True)
    for count in range(1, 1251):
        attachment = struct.pack("<qqB16s", count, time.time_ns(), 16, b"n" * 16)
        session.put(commands, bytes.fromhex(raw), attachment=attachment)
        time.sleep(0.004)
    print(json.dumps({"numbers": numbers, "last": last[0].hex()}), flush=True)
"""


RELEASES = ("1.5", "1.7", "1.9")


@pytest.fixture(scope="module", params=RELEASES)
def other(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The Python of an environment with another version of Zenoh."""
    folder = tmp_path_factory.mktemp(f"zenoh{request.param}")
    venv.create(folder, with_pip=True)
    python = str(folder / "bin" / "python")
    wanted = f"eclipse-zenoh=={request.param}.*"
    command = [python, "-m", "pip", "install", "-q", "--only-binary", ":all:", wanted]
    made = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300.0)
    if made.returncode:
        pytest.skip(f"{wanted} cannot be installed here: {made.stderr[-200:]}")
    return python


def started(*command: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "open\n"
    return process


@pytest.fixture
def router(other: str) -> Iterator[int]:
    """The port of a router of another version."""
    port = free_port()
    process = started(other, "-c", ROUTER, str(port))
    yield port
    process.communicate("")


def test_a_node_of_another_version_reads_and_commands(
    other: str, router: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    names, types = Names(0, "1"), store().types
    array = types[ARRAY](types["std_msgs/msg/MultiArrayLayout"]([], 0), np.array([0.0] * 6 + [0.05]))
    raw = bytes(store().serialize_cdr(array, ARRAY)).hex()
    found: dict[str, Any] = {}

    def script() -> None:
        node = started(other, "-c", NODE, str(router), names.data(STATES, JOINTS), names.data(COMMANDS, ARRAY), raw)
        said, _ = node.communicate(timeout=60.0)
        found.update(json.loads(said))

    run = play(CELL.format(port=router), script, 9.0)
    numbers = np.array(found["numbers"])
    assert np.all(np.diff(numbers) > 0), "in order"
    counted = numbers[numbers > numbers[0] + 500]
    lost = counted[-1] - counted[0] + 1 - len(counted)
    assert lost <= 0.001 * len(counted) + 1, f"{lost} of {len(counted) + lost} lost"
    joints = store().deserialize_cdr(bytes.fromhex(found["last"]), JOINTS)
    moved = joints.position[6] - robots.load("yumi_left").q_home[6]
    assert moved > 0.02, "the command moved the arm"
    assert parse_cell(CELL.format(port=router)).servers["rmw_zenoh"]["distribution"] == "jazzy"
    assert run.reason == "the time is up"
