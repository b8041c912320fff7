"""Cells: the file and its errors, listening addresses of the servers, and complete bridges."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log, models, robots
from armlab.bridge.arbiter import Arbiter
from armlab.bridge.cell import Cell, cell_values, is_open, listening, parse_cell, run_cell
from armlab.bridge.inputs.parameters import Parameters
from armlab.bridge.net.sockets import is_here
from armlab.bridge.servers.labcomm.client import LabCommSource
from armlab.bridge.servers.local import LocalFeed, _listen, socket_path
from armlab.bridge.servers.messages import CommandRequest, SetRequest, Stop, Subscribe
from armlab.bridge.servers.row import Row
from armlab.cli import main
from armlab.errors import ConfigError, LinkError, UnknownName
from armlab.models import ForceSensor
from armlab.state import Command
from tests.processes import bound, free_port

HOME = np.array(robots.load("yumi_left").q_home)


def test_a_cell(cell_text: str) -> None:
    cell = parse_cell(cell_text)
    assert cell.text == cell_text
    assert (cell.name, cell.commands, cell.links) == ("yumi", ("local",), ("sim://yumi_left?lockstep=true",))
    assert [one.name for one in cell.parameters] == ["gain", "gentle"]
    assert list(cell.servers) == ["local", "labcomm"]
    assert cell.servers["labcomm"]["arms"] == {"yumi_left": {"port": 0, "axes": [1, 2, 7, 3, 4, 5, 6]}}
    np.testing.assert_allclose(cell.limits[0].qd_max, 0.5 * cell.robots[0].qd_max)


def test_the_arm_of_a_urdf_is_chosen_in_the_file(tmp_path: Path) -> None:
    limit = '<limit lower="-1" upper="1" effort="9" velocity="1"/>'
    path = tmp_path / "fork.urdf"
    path.write_text(
        '<robot name="fork"><link name="foot"/><link name="left"/><link name="right"/><link name="hand"/>'
        + "".join(
            f'<joint name="to_{child}" type="revolute"><parent link="{parent}"/><child link="{child}"/>{limit}</joint>'
            for parent, child in (("foot", "left"), ("foot", "right"), ("right", "hand"))
        )
        + "</robot>"
    )
    text = f'[[robots]]\nname = "{path}"\nlink = "sim://{path}?lockstep=true"\n'
    with pytest.raises(ConfigError, match="got several"):
        parse_cell(text)
    cell = parse_cell(text + 'tip = "hand"\n[robots.lock]\nto_hand = 0.5\n')
    assert cell.robots[0] == robots.load(path, tip="hand", lock={"to_hand": 0.5})
    assert cell.links == (f"sim://{path}?lockstep=true&tip=hand&lock=to_hand%3D0.5",)


def test_two_arms_have_the_ports_of_the_ancestor() -> None:
    cell = parse_cell(
        'pace = "yumi_right"\n[[robots]]\nname="yumi_left"\nlink="egm://127.0.0.1:6511"\n'
        '[[robots]]\nname="yumi_right"\nlink="egm://127.0.0.1:6512"\n[servers.labcomm]\n'
        "types='sample struct { double pos[7]; } state;'\n"
        "[sources.force]\nperiod=0.004\nport=0\n[sources.force.fields.wrench_raw]\nshape=[6]\n"
        "[sources.far]\nkind='labcomm'\nsample='robot_row'\nperiod=0.004\nport=7511\n"
        "[sources.far.fields.trq]\nshape=[7]\nunit='N m'"
    )
    labcomm = cell.servers["labcomm"]
    assert [arm["port"] for arm in labcomm["arms"].values()] == [7511, 7512]
    assert (labcomm["parameters"], labcomm["fused"], cell.pace) == (7513, 7514, "yumi_right")
    assert "state" in labcomm["types"]
    force, far = cell.sources()
    assert (force.name, force.fields["wrench_raw"].unit) == ("force", "N, N m")
    assert isinstance(far, LabCommSource)


def test_a_force_sensor_with_its_calibration(cell_text: str, tmp_path: Path) -> None:
    arm, path = robots.load("yumi_left"), tmp_path / "force.toml"
    sensor = ForceSensor(np.eye(3), 0.8, np.zeros(3), np.zeros(6), robot_name=arm.name, robot_hash=arm.hash)
    models.save(sensor, path)
    text = f"{cell_text}[sources.force]\nperiod=0.004\nport=0\ncalibration='{path}'\nfields.wrench_raw.shape=[6]\n"
    (source,) = parse_cell(text).sources()
    assert (source.calibration.mass, source.robot) == (0.8, "yumi_left")
    models.save(replace(sensor, robot_hash="other"), path)
    with pytest.raises(ConfigError, match=r"cell\.toml: .*to belong to a robot of this run"):
        parse_cell(text)
    path.unlink()
    with pytest.raises(ConfigError, match=r"cell\.toml: .*force\.toml, got: No such file"):
        parse_cell(text)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "yumi"', "name = 3", r"Expected `str`, got `int` - at `\$.name`"),
        ('name = "yumi"', 'name = "../x"', r"regex.*\$.name"),
        ('name = "yumi"', "nam = 1", "unknown field `nam`"),
        ('name = "yumi"', "name =", "Expected valid TOML in cell.toml.*line 2"),
        ('"local"]', '"ros9"]', "Invalid enum value 'ros9'"),
        ('"local"]', '"labcomm", "local"]\npace = "ur5e"', "robot of this cell"),
        ('name = "yumi_left"', 'name = "yumi_lef"', "yumi_left"),
        ("speed = 0.5", "speed = 2.0", r"speed in \(0, 1\]"),
        ("speed = 0.5", "torque = true", r"got `bool` - at `\$.robots\[0\].torque`"),
        ("speed = 0.5", "torque = -1.0", "positive and within its limits, got -1.0"),
        ("speed = 0.5", "torque = [1.0, 2.0]", "one number or 7"),
        ('sim://yumi_left?lockstep=true"', 'egm://127.0.0.1:6510"\ntorque = 5.0', "supports torques.*extension"),
        ('sim://yumi_left?lockstep=true"', 'labcomm://h"\nextension = true\ntorque = 5.0', "supports torques"),
        ("speed = 0.5", 'speed = "fast"', r"Expected `float`, got `str` - at `\$.robots\[0\].speed`"),
        ("default = 2.0", "default = 20.0", "from 0 to 10"),
        ("{yumi_left = 0}", "{yumi_right = 0}", "robot of this cell"),
        ("parameters = 0", "parameters = 7514\nrows = 7514", "Cannot overwrite"),
        ("{yumi_left = 0}\nparameters = 0\nrows = 0", "{yumi_left = 7513}", "Expected a different LabComm port for"),
        ("{yumi_left = 0}", "{yumi_left = 70000}", "65535"),
        ("[servers.labcomm]", '[sources.a]\nperiod=0.0\nport=0\nfields.x.unit="1"\n[servers.labcomm]', "above 0 s"),
    ],
)
def test_errors_are_one_line_with_the_path(cell_text: str, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        parse_cell(cell_text.replace(old, new))
    assert "\n" not in str(caught.value)
    assert "cell.toml" in str(caught.value)


def test_entries_that_contradict_each_other() -> None:
    text = 'name = "yumi_left"\n[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left"\n'
    assert parse_cell(text).name == "yumi_left"
    with pytest.raises(ConfigError, match="that differs from the names of its robots, got yumi_left"):
        parse_cell(f'{text}[[robots]]\nname = "yumi_right"\nlink = "sim://yumi_right"\n')
    with pytest.raises(ConfigError, match=r"got labcomm. Add \[servers.labcomm\]"):
        parse_cell(f'commands=["labcomm"]\n{text}')


def test_ros_2_in_a_domain() -> None:
    assert cell_of("ros2", "ros2").servers["ros2"] == {"domain": None, "tf": False}
    assert cell_of("ros2 domain=7 tf=true", "ros2").servers["ros2"] == {"domain": 7, "tf": True}
    with pytest.raises(ConfigError, match=r"servers\.ros2\.domain"):
        cell_of("ros2 domain=233", "ros2")


@pytest.mark.slow
def test_a_second_bridge_refuses_at_once(cell_text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("armlab.bridge.cell.connect", lambda *words, **options: pytest.fail("a robot was connected"))
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        cell = parse_cell(cell_text.replace("{yumi_left = 0}", f"{{yumi_left = {port}}}"))
        words = (
            rf"server labcomm to listen.* TCP port 127.0.0.1:{port} for yumi_left .* by process {os.getpid()} \(.*\)"
        )
        with pytest.raises(LinkError, match=words) as caught:
            run_cell(cell)
    assert "\n" not in str(caught.value)
    with contextlib.closing(_listen(socket_path("yumi"))):
        words = rf"server local to listen.*yumi.sock, got process {os.getpid()} \("
        with pytest.raises(LinkError, match=words):
            run_cell(parse_cell(cell_text))


def test_torque_is_allowed_arm_by_arm_with_a_bound(cell_text: str) -> None:
    cell = parse_cell(cell_text)
    assert (cell.torque, cell.limits[0].tau_max) == ((), None)
    cell = parse_cell(cell_text.replace("speed = 0.5", "speed = 0.5\ntorque = 5.0"))
    assert cell.torque == ("yumi_left",)
    np.testing.assert_array_equal(cell.limits[0].tau_max, np.full(7, 5.0))  # type: ignore[arg-type]
    each = "extension = true\ntorque = [8, 8, 8, 4, 2, 2, 2]"
    cell = parse_cell(
        cell_text.replace("sim://yumi_left?lockstep=true", "egm://127.0.0.1:6510").replace("speed = 0.5", each)
    )
    assert cell.extension
    np.testing.assert_array_equal(cell.limits[0].tau_max, [8, 8, 8, 4, 2, 2, 2])  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="positive and within its limits, got 200"):
        parse_cell('[[robots]]\nname = "ur5e"\nlink = "sim://ur5e"\ntorque = 200.0')


def test_values_said_and_not() -> None:
    text = (
        'commands = ["local"]\n[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left"\n'
        "[parameters.gain]\ndefault = 2.0\n[servers.labcomm]\nrows = 9000\n"
        "[sources.force]\nport = 6600\nperiod = 0.004\nfields.wrench_raw.shape = [6]\n"
    )
    found = {place: (value, said) for place, value, said in cell_values(text)}
    expected = {
        "commands": (["local"], True), "robots[0].speed": (1.0, False), "record": (None, False),
        "parameters.gain.default": (2.0, True), "parameters.gain.live": (True, False),
        "servers.labcomm.rows": (9000, True), "servers.labcomm.parameters": (7513, False),
        "sources.force.fields.wrench_raw.shape": ((6,), True),
    }  # fmt: skip
    assert {place: found[place] for place in expected} == expected


def server_process(name: str) -> int:
    """Return the ID of the newest process of the named server."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            words = (folder / "cmdline").read_bytes().split(b"\0")
            if b"armlab.bridge.servers.serve" in words and name.encode() in words and folder.name.isdigit():
                parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
                found += [int(folder.name)] if int(parent) == os.getpid() else []
    return max(found)


ALL = """
[servers.ros2]
domain = {domain}
[servers.rmw_zenoh]
domain = {domain}
port = {router}
[servers.zenoh]
port = {zenoh}
[servers.rosbridge]
port = 0
[servers.plotjuggler]
port = {free}
"""


class Bench:
    """Runs a cell in this thread while a script plays its clients in another thread."""

    def __call__(self, cell: Cell, script: Callable[[dict[str, int]], None], seconds: float, **options: Any) -> Any:
        failures: list[BaseException] = []
        threads: list[threading.Thread] = []
        self.line = ""

        def play(ports: dict[str, int]) -> None:
            try:
                script(ports)
            except BaseException as error:
                failures.append(error)

        def ready(line: str) -> None:
            self.line = line
            ports = {name: int(port) for port, name in re.findall(r":(\d+) \(labcomm, (\w+)\)", line)}
            threads.append(threading.Thread(target=play, args=(ports,), daemon=True))
            threads[0].start()

        try:
            return run_cell(cell, seconds=seconds, ready=ready, patience=10.0, **options)
        finally:
            threads[0].join(20.0)
            assert not threads[0].is_alive()
            if failures:
                raise failures[0]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return Bench()  # type: ignore[return-value]


def rows(feed: LocalFeed) -> Iterator[Any]:
    while True:
        message = feed.receive()
        if isinstance(message, Row):
            yield message.values


@pytest.mark.slow
def test_a_controller_of_its_own_reads_parameters_and_listens_to_a_stop(
    cell_text: str, bench: Bench, tmp_path: Path
) -> None:
    """Two arms; the parameter history is in both logs; the bridge listens only on 127.0.0.1. Takes 4 s."""
    both = cell_text.replace("?lockstep=true", "").replace(
        "[parameters.gain]", '[[robots]]\nname = "yumi_right"\nlink = "sim://yumi_right"\n[parameters.gain]'
    )
    both = both.replace("ports = {yumi_left = 0}", "ports = {yumi_left = 0, yumi_right = 0}")
    cell = parse_cell(both.replace('name = "yumi"', f'name = "yumi"\nrecord = "{tmp_path / "run.mcap"}"'))
    params = Parameters(cell.parameters)
    seen: list[float] = []

    def controller(state: Any) -> Any:
        seen.append(params.gain)
        return Command(qd=np.full(14, 0.01))

    def script(ports: dict[str, int]) -> None:
        with LocalFeed() as feed:
            assert bound(os.getpid()) == {"127.0.0.1"}, "127.0.0.1 only, in a full run"
            feed.ask(Subscribe(rate=None))
            for values in rows(feed):
                if values["yumi_right.qd_sent"][0] > 0.009:
                    break
            feed.ask(CommandRequest(arm="yumi_left", qd=[0.0] * 7))
            feed.ask(SetRequest(values={"gain": 7.0}))
            for _ in rows(feed):
                if seen[-1] == 7.0:
                    break
            feed.ask(Stop())

    run = bench(cell, script, seconds=1.5, controller=controller, parameters=params)
    assert (seen[0], seen[-1]) == (2.0, 7.0)
    for arm in run.arms:
        assert arm.path is not None
        assert log.inspect(arm.path).attachments["cell.toml"] == cell.text.encode()
        sent = arm.table.dropna("qd_sent")["qd_sent"]  # a tick without a packet from the robot sends nothing
        assert len(sent) > 20
        assert np.abs(sent[-20:]).max() < 1e-9
        assert arm.statistics["parameters"]["gain"] == 7.0
    assert main(["log", "show", "--parameters", str(tmp_path / "runleft.mcap")]) == 0


@pytest.fixture
def over(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Return an event that ends the run, so that no test guesses how long its clients take."""
    made, obey = threading.Event(), Arbiter.__call__
    monkeypatch.setattr(Arbiter, "__call__", lambda *given: Command.stop() if made.is_set() else obey(*given))
    return made


@pytest.mark.slow
def test_torques_of_a_client_reach_the_arm_within_the_bound(
    cell_text: str, bench: Bench, over: threading.Event
) -> None:
    """In real time, the client takes the arm, its torques are clipped at the bound, and it loses the arm. Takes 4 s."""

    def push(ports: dict[str, int]) -> None:
        with contextlib.ExitStack() as stack:
            stack.callback(over.set)
            feed = stack.enter_context(LocalFeed())
            feed.ask(Subscribe(rate=None))
            for values in rows(feed):
                if values["yumi_left.mci"] == 3:
                    feed.ask(CommandRequest(arm="yumi_left", tau=[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
                if values["yumi_left.tau_sent"][0] == 1.5:
                    return

    text = cell_text.replace("?lockstep=true", "").replace("speed = 0.5", "speed = 0.5\ntorque = 1.5")
    run = bench(parse_cell(text), push, seconds=60.0)
    assert np.nanmax(run.table["tau_sent"]) == 1.5
    assert any(re.fullmatch(r"local \d+ commands yumi_left\.", text) for _, text in run.events)
    assert run.statistics["clamps"]["torque"][0] > 0


@pytest.mark.slow
def test_ten_idle_clients_and_one_that_never_reads(cell_text: str, bench: Bench, over: threading.Event) -> None:
    """Killing the LabComm server does not affect the loop either; the server restarts. Takes 5 s."""

    def script(ports: dict[str, int]) -> None:
        places = [("127.0.0.1", ports[name]) for name in ("yumi_left", "fused")] * 5
        with contextlib.ExitStack() as stack:
            stack.callback(over.set)
            silent, feed = (stack.enter_context(LocalFeed()) for _ in range(2))
            for place in places:
                stack.enter_context(socket.create_connection(place))
            for one in (silent, feed):
                one.ask(Subscribe(rate=None))
            numbers = []
            for values in rows(feed):
                numbers.append(values["yumi_left.tick"])
                if len(numbers) == 200:
                    os.kill(server_process("labcomm"), signal.SIGKILL)
                if len(numbers) == 600:
                    break
            assert np.all(np.diff(numbers) > 0)

    run = bench(parse_cell(cell_text.replace("?lockstep=true", "")), script, seconds=60.0)
    told = [text for _, text in run.events]
    assert any("The server labcomm ended with status -9. The server restarts in 1 s." in text for text in told)
    assert run.reason == "the controller ended the run"
    answered = np.asarray(run.table["seq"], dtype=int)[np.asarray(run.table["send_ns"]) > 0]
    assert np.diff(answered).max() <= 25, "0.1 s: a busy machine misses some packets, a blocked loop more"


@pytest.mark.slow
def test_a_full_run_with_every_server_listens_on_this_computer_only(cell_text: str, bench: Bench) -> None:
    """Only Cyclone DDS binds to all addresses, but it is restricted to loopback: see its own tests. Takes 10 s."""
    for module, extra in (("cyclonedds", "ros"), ("zenoh", "net"), ("websockets", "net"), ("xxhash", "net")):
        pytest.importorskip(module, reason=f"the extra {extra} is not installed")
    from .servers.ros.dds_peers import free_domain

    def script(ports: dict[str, int]) -> None:
        ros2 = server_process("ros2")
        assert bound(os.getpid(), but=ros2) == {"127.0.0.1"}
        if shutil.which("ss"):
            listed = subprocess.run(["ss", "-Huanp"], capture_output=True, text=True, check=True).stdout.splitlines()
            own = [line.split()[3] for line in listed if f"pid={ros2}," in line]
            assert any("%lo:" in one for one in own)
            assert all(one.startswith("127.0.0.1:") or "%lo:" in one for one in own), own

    router, zenoh, free = free_port(), free_port(), free_port()
    text = cell_text.replace("?lockstep=true", "")
    text += ALL.format(domain=free_domain(), router=router, zenoh=zenoh, free=free)
    bench(parse_cell(text), script, seconds=1.0)
    for name in ("labcomm", "ros2", "rmw_zenoh", f"127.0.0.1:{zenoh}", "rosbridge", "plotjuggler", "local"):
        assert name in bench.line


def cell_of(servers: str, commands: str = "local") -> Cell:
    """Return a cell with the named servers and their entries: "zenoh port=7448; rmw_zenoh"."""
    text = f'commands = ["{commands}"]\n[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left"\n'
    for server in servers.split("; "):
        name, *entries = server.split(" ")
        text += "\n".join([f"[servers.{name}]", *entries, ""])
    return parse_cell(text)


ELSEWHERE, KEYS = "http://192.168.1.9:11311", 'token_file="token" certificate="c.pem"'
HERE = "127.0.0.1"


@pytest.mark.parametrize(
    ("servers", "commands", "listen", "found"),
    [
        ("labcomm", "local", [], [HERE]),
        ("labcomm", "local", ["labcomm=0.0.0.0"], ["0.0.0.0"]),
        ("labcomm", "local", ["labcomm=lo"], [HERE]),
        ("labcomm", "local", ["ros=0.0.0.0"], "enabled server"),
        ("labcomm", "local", ["labcomm=nowhere"], "IPv4 address or one of the interfaces"),
        ("labcomm", "local", ["labcomm=224.0.0.1"], "Expected the address of a network interface"),
        ("labcomm", "local", ["labcomm=255.255.255.255"], "Expected the address of a network interface"),
        ("labcomm", "labcomm", ["labcomm=127.0.0.2"], ["127.0.0.2"]),
        ("labcomm", "labcomm", ["labcomm=0.0.0.0"], "neither a secret nor encryption"),
        # Commands from other computers require a secret and an encrypted connection.
        ("rosbridge", "rosbridge", ["rosbridge=0.0.0.0"], "needs a secret and encryption"),
        (f"rosbridge {KEYS}", "rosbridge", ["rosbridge=0.0.0.0"], "needs a secret and encryption"),
        (f'rosbridge {KEYS} key="k.pem"', "rosbridge", ["rosbridge=0.0.0.0"], ["0.0.0.0"]),
        # No commands are accepted through the open router of another server.
        ("rmw_zenoh; zenoh", "zenoh", ["rmw_zenoh=0.0.0.0"], "shares the router at port 7447 with zenoh"),
        ("zenoh; rmw_zenoh", "rmw_zenoh", ["zenoh=0.0.0.0"], "shares the router at port 7447 with rmw_zenoh"),
        ('rmw_zenoh port=7448; zenoh router="127.0.0.1:7448"', "zenoh", ["rmw_zenoh=0.0.0.0"], "router at port 7448"),
        ("zenoh port=7448; rmw_zenoh", "zenoh", ["rmw_zenoh=0.0.0.0"], [HERE, "0.0.0.0"]),
        ("zenoh; rmw_zenoh", "zenoh", [], [HERE, HERE]),
        # Two servers with one router share one address.
        ("zenoh; rmw_zenoh", "local", ["zenoh=0.0.0.0"], "zenoh and rmw_zenoh at the same address"),
        ("zenoh; rmw_zenoh", "local", ["zenoh=0.0.0.0", "rmw_zenoh=0.0.0.0"], ["0.0.0.0", "0.0.0.0"]),
        ("zenoh port=7448; rmw_zenoh", "local", ["zenoh=0.0.0.0"], ["0.0.0.0", HERE]),
        # Rows go to a router on another computer only on request.
        ('zenoh router="192.168.1.9:7447"', "local", [], "Expected --listen zenoh=ADDRESS too"),
        ('rmw_zenoh router="192.168.1.9:7447"', "local", [], "Expected --listen rmw_zenoh=ADDRESS too"),
        ('zenoh router="192.168.1.9:7447"', "local", ["zenoh=192.168.1.5"], ["192.168.1.5"]),
        ('zenoh router="127.0.0.1:7448"', "local", [], [HERE]),
        # No commands are accepted from the network of a master on another computer.
        (f'ros1 master="{ELSEWHERE}"', "local", [], [HERE]),
        (f'ros1 master="{ELSEWHERE}"', "ros1", [], "ROS 1 master on this computer"),
        ('ros1 master="http://127.lab.example:11311"', "ros1", [], "ROS 1 master on this computer"),
        ('ros1 master="http://["', "ros1", [], "ROS 1 master on this computer"),
        ('ros1 master="nothing"', "ros1", [], "ROS 1 master on this computer"),
        ('ros1 master="http://127.0.0.1:11311"', "ros1", [], [HERE]),
        ('ros1 master="http://localhost:11399"', "ros1", [], [HERE]),
        ("ros1", "local", ["ros1=0.0.0.0"], "address at which other nodes can reach ros1"),
        ("ros1", "local", ["ros1=127.0.0.2"], ["127.0.0.2"]),
    ],
)
def test_listening(servers: str, commands: str, listen: list[str], found: list[str] | str) -> None:
    cell = cell_of(servers, commands)
    if isinstance(found, list):
        names = [server.split(" ")[0] for server in servers.split("; ")]
        assert listening(listen, cell) == dict(zip(names, found, strict=True))
        return
    with pytest.raises((ConfigError, UnknownName), match=found):
        listening(listen, cell)


def test_who_is_here_and_who_only_reads() -> None:
    assert all(map(is_here, ["127.0.0.1:1", "[::1]:1", "localhost:1"]))
    assert not any(map(is_here, ["192.168.1.9:7447", "127.lab.example:7447", "0.0.0.0:7447", "7447", ""]))
    assert is_open({}, "192.168.1.5")
    assert is_open({"guarded": False}, "0.0.0.0")
    assert not is_open({}, HERE)
    assert not is_open({"guarded": True}, "0.0.0.0")
