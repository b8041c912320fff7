"""Level 2 of the test ladder: other versions of Zenoh as router and as node, and zenoh-ros2-sdk as a node.

Each is in a virtual environment of its own. What stands here is what docs/ros.md says was checked.
"""

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
from armlab.bridge.servers.ros.requests import Commands
from armlab.bridge.servers.ros.topics import Topics, store
from armlab.bridge.servers.row import RowSchema

from ..zenoh.conftest import free_port
from .ending import play

pytest.importorskip("zenoh", reason="the extra net is not installed")
pytest.importorskip("xxhash", reason="the extra net is not installed")

from armlab.bridge.servers.ros.rmw_zenoh import Names

pytestmark = pytest.mark.slow

JOINTS, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
STATES, COMMANDS = "/yumi_left/joint_states", "/yumi_left/joint_group_velocity_controller/commands"
PROGRAM = Path(__file__).parent / "peers" / "sdk.py"
OUT, IN = ["RELIABLE", "VOLATILE", "KEEP_LAST", 10], ["BEST_EFFORT", "VOLATILE", "KEEP_LAST", 1]
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
    count, end = 0, time.monotonic() + 60.0
    while time.monotonic() < end and (not numbers or numbers[-1] < numbers[0] + 1250):
        count += 1
        attachment = struct.pack("<qqB16s", count, time.time_ns(), 16, b"n" * 16)
        session.put(commands, bytes.fromhex(raw), attachment=attachment)
        time.sleep(0.004)
    print(json.dumps({"numbers": numbers, "last": last[0].hex()}), flush=True)
"""


RELEASES = ("1.5", "1.7", "1.9")
SDK = "0.1.8"


def environment(folder: Path, wanted: str) -> str:
    """Return the Python of a new environment with one package; without a package index the test is skipped."""
    venv.create(folder, with_pip=True)
    python = str(folder / "bin" / "python")
    command = [python, "-m", "pip", "install", "-q", "--only-binary", ":all:", wanted]
    made = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300.0)
    if made.returncode:
        pytest.skip(f"{wanted} cannot be installed here: {made.stderr[-200:]}")
    return python


@pytest.fixture(scope="module", params=RELEASES)
def other(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The Python of an environment with another version of Zenoh."""
    return environment(tmp_path_factory.mktemp(f"zenoh{request.param}"), f"eclipse-zenoh=={request.param}.*")


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
        said, _ = node.communicate(timeout=90.0)
        found.update(json.loads(said))

    run = play(monkeypatch, parse_cell(CELL.format(port=router)), script)
    numbers = np.array(found["numbers"])
    assert np.all(np.diff(numbers) > 0), "in order"
    counted = numbers[numbers > numbers[0] + 500]
    lost = counted[-1] - counted[0] + 1 - len(counted)
    assert lost <= 0.001 * len(counted) + 1, f"{lost} of {len(counted) + lost} lost"
    joints = store().deserialize_cdr(bytes.fromhex(found["last"]), JOINTS)
    moved = joints.position[6] - robots.load("yumi_left").q_home[6]
    assert moved > 0.02, "the command moved the arm"
    assert parse_cell(CELL.format(port=router)).servers["rmw_zenoh"]["distribution"] == "jazzy"
    measured = {row.tobytes() for row in np.asarray(run.table["q"])}
    assert np.asarray(joints.position).tobytes() in measured, "what the node read is what was measured"


def test_zenoh_ros2_sdk_sees_the_graph_reads_and_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Node, types, hashes and quality of service as a program sees them that computes them by itself."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    python = environment(tmp_path / "sdk", f"zenoh-ros2-sdk=={SDK}")
    definitions = {name: store().generate_msgdef(name, ros_version=2)[0] for name in store().fielddefs}
    texts = {name: text.partition("=" * 80)[0] for name, text in definitions.items()}
    port, found = free_port(), dict[str, Any]()

    def script() -> None:
        command = [python, str(PROGRAM), str(port), STATES, COMMANDS]
        node = subprocess.run(
            command, input=json.dumps(texts), capture_output=True, text=True, check=False, timeout=200
        )
        assert node.returncode == 0, node.stderr
        found.update(json.loads(node.stdout))

    run = play(monkeypatch, parse_cell(CELL.format(port=port)), script)
    arm = robots.load("yumi_left")
    out = {name: one.type for name, one in Topics({arm.name: arm}, RowSchema.of([arm])).published.items()}
    about = [(out, ["out"], OUT), (Commands("yumi", {arm.name: arm}).types, ["in"], IN)]
    expected = [
        [topic, *kind, "/", "armlab", type_, store().hash_rihs01(type_), *quality]
        for topics, kind, quality in about
        for topic, type_ in topics.items()
    ]
    assert sorted(found["graph"]) == sorted(expected)
    assert found["hashes"] == {name: store().hash_rihs01(name) for name in (JOINTS, ARRAY)}
    stamps, q = [stamp for stamp, _ in found["states"]], np.array([q for _, q in found["states"]])
    assert stamps == sorted(set(stamps))
    assert q[-1, 6] - q[0, 6] >= 0.05, "its commands moved the arm"
    measured = {row.tobytes() for row in np.asarray(run.table["q"])}
    assert all(row.tobytes() in measured for row in q), "what the node read is what was measured"
