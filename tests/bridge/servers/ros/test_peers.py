"""Level 2 of the test ladder: third-party nodes over DDS and Zenoh, independent of armlab.

The nodes use Python, C (Cyclone DDS) and C++ (Fast DDS) with the versions of Debian 12, other versions of Zenoh, and
zenoh-ros2-sdk; docs/ros.md lists exactly these as checked.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.ros.actions import CONTROLLER, FOLLOW, STATUS, TRAJECTORY, _register
from armlab.bridge.servers.ros.rmw_zenoh import Names
from armlab.bridge.servers.ros.server import Commands
from armlab.bridge.servers.ros.topics import Topics, store
from armlab.bridge.servers.row import RowSchema
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.log import Tick
from armlab.state import Command, State

from ....processes import free_port
from ..conftest import cell_of, play, until
from .dds_peers import free_domain

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
pytestmark = pytest.mark.slow
SOURCES = Path(__file__).parent / "peers"
ARM = robots.load("yumi_left")
PERIOD = 0.004
SETTLED = 2_000_000_000  # ns after the first sample, after which none may be missing
SYSTEM = "/usr/bin:/bin:/usr/local/bin"  # the idlc in the wheel of our Python generates code for another version


BUILT: dict[str, list[str]] = {}


def _built(folder: Path, target: str, tools: tuple[str, ...], packages: str) -> list[str]:
    """Build a node once, and return the command that starts it."""
    if target in BUILT:
        return BUILT[target]
    missing = [tool for tool in tools if shutil.which(tool, path=SYSTEM) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} is missing: apt-get install {packages}")
    command = ["make", "-f", str(SOURCES / "Makefile"), target]
    environment = {**os.environ, "PATH": SYSTEM}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout}{done.stderr}"
    return BUILT.setdefault(target, [str(folder / target)])


def _python(folder: Path) -> list[str]:
    return [sys.executable, str(SOURCES / "cyclone.py")]


def _cyclone(folder: Path) -> list[str]:
    return _built(folder, "cyclone", ("make", "gcc", "idlc"), "make gcc cyclonedds-dev cyclonedds-tools")


def _fast(folder: Path) -> list[str]:
    return _built(folder, "fast", ("make", "g++", "fastddsgen"), "make g++ libfastrtps-dev fastddsgen")


PEERS: dict[str, Callable[[Path], list[str]]] = {
    "cyclonedds, Python": _python,
    "Cyclone DDS 0.10.2, C": _cyclone,
    "Fast DDS 2.9.1, C++": _fast,
}


@pytest.fixture(scope="module", params=PEERS)
def node(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return PEERS[request.param](tmp_path_factory.mktemp("node"))


class Peer:
    def __init__(
        self, command: list[str], folder: Path, domain: int, count: int, first: int, last: int, *more: str
    ) -> None:
        self.out, self.err = folder / f"{time.monotonic_ns()}.out", folder / f"{time.monotonic_ns()}.err"
        environment = {**os.environ, "CYCLONEDDS_URI": f"file://{SOURCES}/loopback.xml"}
        words = [*command, *map(str, (domain, count, first, last, *more))]
        with self.out.open("wb") as out, self.err.open("wb") as err:
            self.process = subprocess.Popen(words, stdout=out, stderr=err, env=environment)

    def is_reading(self) -> bool:
        return "reading" in self.err.read_text()

    def ended(self) -> dict[str, list[list[str]]]:
        assert self.process.wait(90.0) == 0, self.err.read_text()
        lines = [line.split() for line in self.out.read_text().splitlines()]
        return {kind: [words for words in lines if words[0] == kind] for kind in "JW"}


class Stream:
    """Loop that sends a row to the server process every 4 ms and obeys its clients."""

    def __init__(self, parameters: Sequence[Parameter] = ()) -> None:
        self.domain = free_domain()
        about = {"cell": "yumi"}
        self.exchange = Hub([ARM], ["ros2"], Parameters(parameters), allowed=["ros2"], about=about)
        options = {"domain": self.domain, "host": "127.0.0.1"}
        self.servers = Servers(self.exchange, {"ros2": server_command("ros2", options)})
        self.sent: dict[int, dict[str, np.ndarray]] = {}
        self.commands: list[np.ndarray] = []
        self.began = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Stream:
        self.servers.__enter__()
        self.servers.ready()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self.servers.close()

    def _run(self) -> None:
        rng, due = np.random.default_rng(3), time.monotonic()
        nothing = np.full(7, np.nan)
        while not self._over.is_set():
            q, wrench = ARM.q_home + 1e-3 * rng.standard_normal(7), rng.standard_normal(6)
            wall = time.time_ns()
            state = State(t=1.0, dt=PERIOD, q=q, qd=nothing, tau=nothing, robot=ARM.name, wrench=wrench)
            command = self.exchange.arbiter(state)
            if isinstance(command, Command) and command.qd is not None:
                self.commands.append(command.qd)
            k = len(self.sent)
            R = kinematics.forward(ARM, q)[:3, :3]
            self.sent[wall] = {"J": q, "W": np.concatenate([R.T @ wrench[:3], R.T @ wrench[3:]])}
            self.exchange.row(state, None, Tick(k, k, wall, 1_000, 2_000, 3))
            due = max(due, time.monotonic() - PERIOD) + PERIOD  # no burst makes up for the delays of a busy machine
            self._over.wait(max(0.0, due - time.monotonic()))

    def check(self, lines: list[list[str]], kind: str, is_whole: bool = True) -> None:
        stamps = [int(words[1]) for words in lines]
        assert stamps == sorted(set(stamps))
        for words, stamp in zip(lines, stamps, strict=True):
            numbers = np.array(words[4 : 11 if kind == "J" else 10], dtype=float)
            np.testing.assert_allclose(numbers, self.sent[stamp][kind], rtol=0, atol=1e-12)
        if is_whole:
            counted = [stamp for stamp in [*self.sent] if stamps[0] + SETTLED <= stamp <= stamps[-1]]
            assert len(counted) > 400
            assert len(set(counted) & set(stamps)) >= 0.999 * len(counted)


RELEASES = ("1.5", "1.7", "1.9")
SDK = "0.1.8"
Installing = tuple[Path, "subprocess.Popen[str]"]


@pytest.fixture(scope="module")
def installing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Installing]]:
    found = {}
    for wanted in (*(f"eclipse-zenoh=={release}.*" for release in RELEASES), f"zenoh-ros2-sdk=={SDK}"):
        folder = tmp_path_factory.mktemp("packages")
        command = f"{sys.executable} -m pip install -q --only-binary :all: --target {folder} {wanted}".split()
        found[wanted] = folder, subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    yield found
    for _, process in found.values():
        with process:  # processes that no test has waited for
            process.kill()


@pytest.fixture(scope="module")
def stream() -> Iterator[Stream]:
    with Stream() as one:
        yield one
        assert one.exchange.outlets["ros2"].lost == 0


def test_a_node_reads_every_message_and_commands(node: list[str], stream: Stream, tmp_path: Path) -> None:
    before = len(stream.commands)
    lines = Peer(node, tmp_path, stream.domain, 1100, 400, 800).ended()
    for kind in "JW":
        stream.check(lines[kind], kind)
    assert {words[3] for words in lines["J"]} == {"-"}
    assert {words[3] for words in lines["W"]} == {"yumi_left_tool"}
    assert {(words[11], words[12]) for words in lines["J"]} == {("yumi_robl_joint_3", "0")}
    assert len(stream.commands) > before + 100
    assert all(np.array_equal(qd, [0.05] * 7) for qd in stream.commands)
    assert any(client.startswith("ros2 ") for client in stream.exchange.arbiter.obeyed["yumi_left"])


@pytest.mark.parametrize("node", [name for name in PEERS if "Python" not in name], indirect=True)
def test_a_reader_that_stops_and_one_that_dies_disturb_nobody(node: list[str], stream: Stream, tmp_path: Path) -> None:
    slow, dead = (Peer(node, tmp_path, stream.domain, 1800, 0, 0) for _ in range(2))
    until(slow.is_reading)
    until(dead.is_reading)
    good = Peer(_python(tmp_path), tmp_path, stream.domain, 1400, 0, 0)
    until(good.is_reading)
    slow.process.send_signal(signal.SIGSTOP)
    dead.process.kill()
    dead.process.wait()
    lines = good.ended()  # 6 s: messages for the two others are not kept
    slow.process.send_signal(signal.SIGCONT)
    late = slow.ended()
    stream.check(lines["J"], "J")
    stream.check(lines["W"], "W")
    delays = [int(words[2]) - int(words[1]) for words in lines["J"]]
    assert max(delays) < 1_000_000_000, "no message waited for a stopped reader"
    stream.check(late["J"], "J", is_whole=False)
    assert max(np.diff([int(words[1]) for words in late["J"]])) > 1_500_000_000, "it did stop"


def test_a_node_moves_the_simulated_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    domain = free_domain()
    cell = cell_of("ros2", f"domain = {domain}")
    found: dict[str, Any] = {}
    command = _python(tmp_path)
    run = play(monkeypatch, cell, lambda: found.update(Peer(command, tmp_path, domain, 700, 200, 600).ended()))
    lines = found["J"]
    assert any(text.startswith("ros2 ") and text.endswith(" commands yumi_left.") for _, text in run.events)
    q = np.array([words[4:11] for words in lines], dtype=float)
    measured = {row.tobytes() for row in np.asarray(run.table["q"])}
    assert all(row.tobytes() in measured for row in q), "the node read the measured values"
    assert np.all(q[-1] - q[0] > 0.04)
    sent = run.table.dropna("qd_sent")["qd_sent"]
    assert np.nanmax(np.abs(sent)) <= 0.05 + 1e-9


def test_a_fast_dds_node_without_a_profile_finds_a_bridge_that_has_run_for_long(
    stream: Stream, installing: dict[str, Installing], tmp_path: Path
) -> None:
    """Ports that do not answer would be dropped after 30 s. Takes 10 s, plus the remainder of 35 s since the start."""
    command = _fast(tmp_path)
    time.sleep(max(0.0, stream.began + 35.0 - time.monotonic()))
    for _ in range(2):
        before = len(stream.commands)
        lines = Peer(command, tmp_path, stream.domain, 600, 200, 400, "default").ended()
        assert len(lines["J"]) >= 600
        assert len(stream.commands) > before + 100
        time.sleep(1.0)


pytest.importorskip("zenoh", reason="the extra net is not installed")
pytest.importorskip("xxhash", reason="the extra net is not installed")
JOINTS, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
STATES, COMMANDS = "/yumi_left/joint_states", "/yumi_left/joint_group_velocity_controller/commands"
PROGRAM = Path(__file__).parent / "peers" / "sdk.py"
OUT, IN = ["RELIABLE", "VOLATILE", "KEEP_LAST", 10], ["BEST_EFFORT", "VOLATILE", "KEEP_LAST", 1]
LATCHED = ["RELIABLE", "TRANSIENT_LOCAL", "KEEP_LAST", 1]
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
    while time.monotonic() < end and (not numbers or numbers[-1] < numbers[0] + 750):
        count += 1
        attachment = struct.pack("<qqB16s", count, time.time_ns(), 16, b"n" * 16)
        session.put(commands, bytes.fromhex(raw), attachment=attachment)
        time.sleep(0.004)
    print(json.dumps({"numbers": numbers, "last": last[0].hex()}), flush=True)
"""


def environment(installing: dict[str, Installing], wanted: str) -> str:
    folder, made = installing[wanted]
    _, said = made.communicate(timeout=300.0)
    if made.returncode:
        pytest.skip(f"{wanted} cannot be installed here: {said[-200:]}")
    python = folder / "python"
    python.write_text(f'#!/bin/sh\nPYTHONPATH={folder} exec {sys.executable} -S "$@"\n')
    python.chmod(0o755)
    return str(python)


@pytest.fixture(scope="module", params=RELEASES)
def other(request: pytest.FixtureRequest, installing: dict[str, Installing]) -> str:
    return environment(installing, f"eclipse-zenoh=={request.param}.*")


def started(*command: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "open\n"
    return process


@pytest.fixture
def router(other: str) -> Iterator[int]:
    port = free_port()
    process = started(other, "-c", ROUTER, str(port))
    yield port
    process.communicate("")


def test_a_node_of_another_version_reads_and_commands(other: str, router: int, monkeypatch: pytest.MonkeyPatch) -> None:
    names, types = Names(0, "1"), store().types
    array = types[ARRAY](types["std_msgs/msg/MultiArrayLayout"]([], 0), np.array([0.0] * 6 + [0.05]))
    raw = bytes(store().serialize_cdr(array, ARRAY)).hex()
    found: dict[str, Any] = {}

    def script() -> None:
        node = started(other, "-c", NODE, str(router), names.data(STATES, JOINTS), names.data(COMMANDS, ARRAY), raw)
        said, _ = node.communicate(timeout=90.0)
        found.update(json.loads(said))

    run = play(monkeypatch, cell_of("rmw_zenoh", f"port = {router}"), script)
    numbers = np.array(found["numbers"])
    assert np.all(np.diff(numbers) > 0), "in order"
    counted = numbers[numbers > numbers[0] + 250]
    lost = counted[-1] - counted[0] + 1 - len(counted)
    assert lost <= 0.001 * len(counted) + 1, f"{lost} of {len(counted) + lost} lost"
    joints = store().deserialize_cdr(bytes.fromhex(found["last"]), JOINTS)
    moved = joints.position[6] - robots.load("yumi_left").q_home[6]
    assert moved > 0.02, "the command moved the arm"
    assert cell_of("rmw_zenoh", f"port = {router}").servers["rmw_zenoh"]["distribution"] == "jazzy"
    measured = {row.tobytes() for row in np.asarray(run.table["q"])}
    assert np.asarray(joints.position).tobytes() in measured, "what the node read is what was measured"


def test_zenoh_ros2_sdk_sees_the_graph_reads_and_commands(
    installing: dict[str, Installing], monkeypatch: pytest.MonkeyPatch
) -> None:
    python = environment(installing, f"zenoh-ros2-sdk=={SDK}")
    _register()
    messages = [name for name in store().fielddefs if "/msg/" in name]
    definitions = {name: store().generate_msgdef(name, ros_version=2)[0] for name in messages}
    texts = {name: text.partition("=" * 80)[0] for name, text in definitions.items()}
    port, found = free_port(), dict[str, Any]()

    def script() -> None:
        command = [python, str(PROGRAM), str(port), STATES, COMMANDS]
        node = subprocess.run(
            command, input=json.dumps(texts), capture_output=True, text=True, check=False, timeout=200
        )
        assert node.returncode == 0, node.stderr
        found.update(json.loads(node.stdout))

    run = play(monkeypatch, cell_of("rmw_zenoh", f"port = {port}"), script)
    arm = robots.load("yumi_left")
    out = {name: one.type for name, one in Topics({arm.name: arm}, RowSchema.of([arm])).published.items()}
    controller = f"/{arm.name}/{CONTROLLER}"
    latched = {f"/{arm.name}/robot_description": "std_msgs/msg/String"}
    latched[f"{controller}/follow_joint_trajectory/_action/status"] = STATUS
    out[f"{controller}/follow_joint_trajectory/_action/feedback"] = f"{FOLLOW}_FeedbackMessage"
    about = [
        ({name: type_ for name, type_ in out.items() if name not in latched}, ["out"], OUT),
        (latched, ["out"], LATCHED),
        (Commands("yumi", {arm.name: arm}).types, ["in"], IN),
        ({f"{controller}/joint_trajectory": TRAJECTORY}, ["in"], OUT),
    ]
    expected = [
        [topic, *kind, "/", arm.name, type_, store().hash_rihs01(type_), *quality]
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
