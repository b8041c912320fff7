"""Cells: the file and its errors, where its servers listen, and whole bridges."""

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
from tests.processes import bound

HOME = np.array(robots.load("yumi_left").q_home)


def test_a_cell(cell_text: str) -> None:
    cell = parse_cell(cell_text)
    assert cell.text == cell_text
    assert isinstance(cell, Cell)
    assert (cell.name, cell.commands, cell.links) == ("yumi", ("local",), ("sim://yumi_left?lockstep=true",))
    assert [one.name for one in cell.parameters] == ["gain", "gentle"]
    assert list(cell.servers) == ["local", "labcomm"]
    assert cell.servers["labcomm"]["arms"] == {"yumi_left": {"port": 0, "axes": [1, 2, 7, 3, 4, 5, 6]}}
    np.testing.assert_allclose(cell.limits[0].qd_max, 0.5 * cell.robots[0].qd_max)


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
    with pytest.raises(ConfigError, match=r"cell\.toml: .*to be of a robot of this run"):
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
        ('name = "yumi"', "name =", "Expected TOML in cell.toml.*line 2"),
        ('"local"]', '"ros9"]', "Invalid enum value 'ros9'"),
        ('"local"]', '"labcomm", "local"]\npace = "ur5e"', "robot of this cell"),
        ('name = "yumi_left"', 'name = "yumi_lef"', "yumi_left"),
        ("speed = 0.5", "speed = 2.0", r"speed in \(0, 1\]"),
        ("speed = 0.5", "torque = true", r"got `bool` - at `\$.robots\[0\].torque`"),
        ("speed = 0.5", "torque = -1.0", "positive and within its limits, got -1.0"),
        ("speed = 0.5", "torque = [1.0, 2.0]", "one number or 7"),
        (
            'sim://yumi_left?lockstep=true"',
            'egm://127.0.0.1:6510"\ntorque = 5.0',
            "carries torques to yumi_left.*extension",
        ),
        ('sim://yumi_left?lockstep=true"', 'labcomm://h"\nextension = true\ntorque = 5.0', "carries torques"),
        ("speed = 0.5", 'speed = "fast"', r"Expected `float`, got `str` - at `\$.robots\[0\].speed`"),
        ("default = 2.0", "default = 20.0", "from 0 to 10"),
        ("{yumi_left = 0}", "{yumi_right = 0}", "robot of this cell"),
        ("parameters = 0", "parameters = 7514\nrows = 7514", "Cannot overwrite"),
        ("{yumi_left = 0}\nparameters = 0\nrows = 0", "{yumi_left = 7513}", "a LabComm port of its own"),
        ("{yumi_left = 0}", "{yumi_left = 70000}", "65535"),
        ("[servers.labcomm]", '[sources.a]\nperiod=0.0\nport=0\nfields.x.unit="1"\n[servers.labcomm]', "above 0 s"),
    ],
)
def test_errors_are_one_line_with_the_path(cell_text: str, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        parse_cell(cell_text.replace(old, new))
    assert "\n" not in str(caught.value)
    assert "cell.toml" in str(caught.value)


def test_two_arms_are_commanded_under_a_name_that_neither_has() -> None:
    text = 'name = "yumi_left"\n[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left"\n'
    assert parse_cell(text).name == "yumi_left"
    with pytest.raises(ConfigError, match="that none of its robots has, got yumi_left"):
        parse_cell(f'{text}[[robots]]\nname = "yumi_right"\nlink = "sim://yumi_right"\n')


def test_a_server_that_commands_must_be_enabled() -> None:
    with pytest.raises(ConfigError, match=r"got labcomm. Add \[servers.labcomm\]"):
        parse_cell('commands=["labcomm"]\n[[robots]]\nname="ur5e"\nlink="egm://127.0.0.1:6510"')


def test_ros_2_in_a_domain() -> None:
    text = 'commands=["ros2"]\n[[robots]]\nname="ur5e"\nlink="egm://127.0.0.1:6510"\n[servers.ros2]\n'
    assert parse_cell(text).servers["ros2"] == {"domain": None}
    assert parse_cell(f"{text}domain = 7").servers["ros2"] == {"domain": 7}
    with pytest.raises(ConfigError, match=r"servers\.ros2\.domain"):
        parse_cell(f"{text}domain = 233")


def test_a_second_bridge_refuses_at_once(cell_text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says which port and who has it, and no robot has been connected by then."""
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
        words = rf"server local to listen.*yumi.sock, but one runs: process {os.getpid()} \("
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


TEXT = """
commands = ["local"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[parameters.gain]
default = 2.0
[servers.labcomm]
rows = 9000
[sources.force]
port = 6600
period = 0.004
robot = "yumi_left"
[sources.force.fields.wrench_raw]
shape = [6]
"""


def test_values_said_and_not() -> None:
    found = {place: (value, said) for place, value, said in cell_values(TEXT)}
    assert found["commands"] == (["local"], True)
    assert found["robots[0].name"] == ("yumi_left", True)
    assert found["robots[0].speed"] == (1.0, False)
    assert found["parameters.gain.default"] == (2.0, True)
    assert found["parameters.gain.live"] == (True, False)
    assert found["servers.labcomm.rows"] == (9000, True)
    assert found["servers.labcomm.parameters"] == (7513, False)
    assert found["sources.force.fields.wrench_raw.shape"] == ((6,), True)
    assert found["record"] == (None, False)


def server_process(name: str) -> int:
    """Number of the newest process that serves under a name."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            words = (folder / "cmdline").read_bytes().split(b"\0")
            if b"armlab.bridge.servers.serve" in words and name.encode() in words and folder.name.isdigit():
                parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
                found += [int(folder.name)] if int(parent) == os.getpid() else []
    return max(found)


JOINT = np.eye(7)[3]
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


def free_ports(count: int) -> list[int]:
    """Return ports on which nobody listens."""
    with contextlib.ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]


class Bench:
    """Runs a cell in this thread while a script plays its clients in another."""

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


@pytest.mark.slow  # 3 s
def test_a_local_client_commands_in_real_time(cell_text: str, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """It moves one joint; the parameter is set; what was sent is what it asked for. The run ends when it has left."""
    asked: list[np.ndarray] = []
    there = threading.Event()
    obey = Arbiter.__call__

    def obey_or_end(arbiter: Arbiter, state: Any) -> Any:
        command = obey(arbiter, state)
        return Command.stop() if there.is_set() and not arbiter.commander("yumi_left") else command

    monkeypatch.setattr(Arbiter, "__call__", obey_or_end)

    def script(ports: dict[str, int]) -> None:
        with contextlib.ExitStack() as stack:
            stack.callback(there.set)
            feed = stack.enter_context(LocalFeed())
            assert bound(os.getpid()) == {"127.0.0.1"}, "127.0.0.1 only, in a full run"
            feed.ask(Subscribe(rate=None))
            feed.ask(SetRequest(values={"gain": 3.0, "gentle": False}))
            start = None
            for values in rows(feed):
                start = values["yumi_left.q"] if start is None else start
                if values["yumi_left.mci"] != 3:
                    continue
                asked.append(start + min(0.04, 0.0005 * len(asked)) * JOINT)
                feed.ask(CommandRequest(arm="yumi_left", q=asked[-1].tolist(), seq=len(asked)))
                off = values["yumi_left.q_sent"] - start - 0.04 * JOINT
                is_there = np.abs([off, values["yumi_left.qd_sent"]]).max() < 1e-9
                if is_there and values["yumi_left.commander"]:
                    assert values["yumi_left.commander"].startswith("local ")
                    assert len(asked) > 80
                    return

    cell = parse_cell(cell_text.replace("?lockstep=true", ""))
    run = bench(cell, script, seconds=60.0)
    told = [text for _, text in run.events]
    assert run.reason == "the controller ended the run"
    assert "yumi_left" in bench.line
    assert any(re.fullmatch(r"local \d+ commands yumi_left\.", text) for text in told)
    assert any("no longer commands yumi_left" in text for text in told)
    assert any("Parameter gain = 3.0, set by local " in text for text in told)
    sent = run.table["q_sent"][np.isfinite(run.table["q_sent"]).all(axis=1)]
    np.testing.assert_allclose(sent[-1], asked[-1], atol=1e-9)
    assert np.abs(np.delete(sent - sent[0], 3, axis=1)).max() < 1e-3


@pytest.mark.slow
def test_a_controller_of_its_own_reads_parameters_and_listens_to_a_stop(
    cell_text: str, bench: Bench, tmp_path: Path
) -> None:
    """Two arms; the history of the parameters is in both logs. Takes 4 s."""
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
        sent = arm.table.dropna("qd_sent")["qd_sent"]  # a tick that found no packet of the robot sends nothing
        assert len(sent) > 20
        assert np.abs(sent[-20:]).max() < 1e-9
        assert arm.statistics["parameters"]["gain"] == 7.0
    assert main(["log", "show", "--parameters", str(tmp_path / "runleft.mcap")]) == 0


@pytest.fixture
def over(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """End the run when this is set: no test guesses how long its clients take."""
    made, obey = threading.Event(), Arbiter.__call__
    monkeypatch.setattr(Arbiter, "__call__", lambda *given: Command.stop() if made.is_set() else obey(*given))
    return made


@pytest.mark.slow
def test_torques_of_a_client_reach_the_arm_within_the_bound(
    cell_text: str, bench: Bench, over: threading.Event
) -> None:
    """Torques are clipped at the bound. Takes 4 s."""

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
    assert run.statistics["clamps"]["torque"][0] > 0


@pytest.mark.slow
def test_ten_idle_clients_and_one_that_never_reads(cell_text: str, bench: Bench, over: threading.Event) -> None:
    """Nor does the loop notice that the server of LabComm is killed; it starts again. Takes 5 s."""

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
    assert any("The server labcomm ended with status -9. It starts again in 1 s." in text for text in told)
    assert run.reason == "the controller ended the run"
    answered = np.asarray(run.table["seq"], dtype=int)[np.asarray(run.table["send_ns"]) > 0]
    assert np.diff(answered).max() <= 25, "0.1 s: a busy machine misses some; a loop that is held up more"


@pytest.mark.slow
def test_a_full_run_with_every_server_listens_on_this_computer_only(cell_text: str, bench: Bench) -> None:
    """Cyclone DDS alone binds to all addresses, and is tied to loopback: see ros/test_dds_domain.py. Takes 10 s."""
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

    router, zenoh, free = free_ports(3)
    text = cell_text.replace("?lockstep=true", "")
    text += ALL.format(domain=free_domain(), router=router, zenoh=zenoh, free=free)
    bench(parse_cell(text), script, seconds=1.0)
    for name in ("labcomm", "ros2", "rmw_zenoh", f"127.0.0.1:{zenoh}", "rosbridge", "plotjuggler", "local"):
        assert name in bench.line


FILE = """
commands = ["local"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.labcomm]
"""


def test_listening() -> None:
    cell = parse_cell(FILE)
    assert listening([], cell) == {"labcomm": "127.0.0.1"}
    assert listening(["labcomm=0.0.0.0"], cell) == {"labcomm": "0.0.0.0"}
    assert listening(["labcomm=lo"], cell) == {"labcomm": "127.0.0.1"}
    with pytest.raises(UnknownName, match="enabled server"):
        listening(["ros=0.0.0.0"], cell)
    with pytest.raises(ConfigError, match="IPv4 address or one of the interfaces"):
        listening(["labcomm=nowhere"], cell)
    commanding = parse_cell(FILE.replace('["local"]', '["labcomm"]'))
    assert listening(["labcomm=127.0.0.2"], commanding) == {"labcomm": "127.0.0.2"}
    with pytest.raises(ConfigError, match="no place for a secret and no encryption"):
        listening(["labcomm=0.0.0.0"], commanding)


def test_who_commands_from_elsewhere_has_to_know_a_secret() -> None:
    text = FILE.replace("labcomm", "rosbridge").replace('["local"]', '["rosbridge"]')
    with pytest.raises(ConfigError, match="asks for no secret, or does not encrypt"):
        listening(["rosbridge=0.0.0.0"], parse_cell(text))
    with pytest.raises(ConfigError, match="asks for no secret, or does not encrypt"):
        listening(["rosbridge=0.0.0.0"], parse_cell(text + 'token_file = "token"\ncertificate = "c.pem"'))
    cell = parse_cell(text + 'token_file = "token"\ncertificate = "c.pem"\nkey = "k.pem"')
    assert listening(["rosbridge=0.0.0.0"], cell) == {"rosbridge": "0.0.0.0"}


@pytest.mark.parametrize(("commanding", "opened"), [("zenoh", "rmw_zenoh"), ("rmw_zenoh", "zenoh")])
def test_no_commands_come_through_the_open_router_of_the_other_server(commanding: str, opened: str) -> None:
    text = FILE.replace("labcomm", opened).replace('["local"]', f'["{commanding}"]')
    with pytest.raises(ConfigError, match=f"shares the router at port 7447 with {commanding}"):
        listening([f"{opened}=0.0.0.0"], parse_cell(f"{text}\n[servers.{commanding}]"))
    through = parse_cell(f'{text}\nport = 7448\n[servers.{commanding}]\nrouter = "127.0.0.1:7448"')
    with pytest.raises(ConfigError, match="shares the router at port 7448"):
        listening([f"{opened}=0.0.0.0"], through)
    apart = parse_cell(f"{text}\n[servers.{commanding}]\nport = 7448")
    assert listening([f"{opened}=0.0.0.0"], apart) == {opened: "0.0.0.0", commanding: "127.0.0.1"}
    together = parse_cell(f"{text}\n[servers.{commanding}]")
    assert set(listening([], together).values()) == {"127.0.0.1"}


def test_two_servers_with_one_router_are_at_the_same_address() -> None:
    text = FILE.replace("labcomm", "zenoh") + "{}\n[servers.rmw_zenoh]\n"
    everywhere = ["zenoh=0.0.0.0", "rmw_zenoh=0.0.0.0"]
    with pytest.raises(ConfigError, match="zenoh and rmw_zenoh at the same address"):
        listening(everywhere[:1], parse_cell(text.format("")))
    assert set(listening(everywhere, parse_cell(text.format(""))).values()) == {"0.0.0.0"}
    assert listening(everywhere[:1], parse_cell(text.format("port = 7448"))) == {
        "zenoh": "0.0.0.0",
        "rmw_zenoh": "127.0.0.1",
    }


@pytest.mark.parametrize("master", ["http://192.168.1.9:11311", "http://127.lab.example:11311", "http://[", "nothing"])
def test_no_commands_come_from_the_network_of_a_master_elsewhere(master: str) -> None:
    text = FILE.replace("labcomm", "ros1") + f'master = "{master}"'
    assert listening([], parse_cell(text)) == {"ros1": "127.0.0.1"}
    with pytest.raises(ConfigError, match="master of ROS 1 on this computer"):
        listening([], parse_cell(text.replace('["local"]', '["ros1"]')))


@pytest.mark.parametrize("master", ["http://127.0.0.1:11311", "http://localhost:11399"])
def test_commands_come_by_a_master_of_this_computer(master: str) -> None:
    text = FILE.replace("labcomm", "ros1").replace('["local"]', '["ros1"]')
    assert listening([], parse_cell(f'{text}master = "{master}"')) == {"ros1": "127.0.0.1"}


@pytest.mark.parametrize("server", ["zenoh", "rmw_zenoh"])
def test_rows_go_to_a_router_elsewhere_only_when_that_is_asked_for(server: str) -> None:
    text = FILE.replace("labcomm", server)
    cell = parse_cell(f'{text}router = "192.168.1.9:7447"')
    with pytest.raises(ConfigError, match=f"Expected --listen {server}=ADDRESS too"):
        listening([], cell)
    assert listening([f"{server}=192.168.1.5"], cell) == {server: "192.168.1.5"}
    assert listening([], parse_cell(f'{text}router = "127.0.0.1:7448"')) == {server: "127.0.0.1"}


def test_routers_of_this_computer_and_elsewhere() -> None:
    assert all(map(is_here, ["127.0.0.1:1", "[::1]:1", "localhost:1"]))
    assert not any(map(is_here, ["192.168.1.9:7447", "127.lab.example:7447", "0.0.0.0:7447", "7447", ""]))


def test_addresses_that_are_no_place_to_listen_at() -> None:
    for place in ("224.0.0.1", "239.255.0.1", "255.255.255.255"):
        with pytest.raises(ConfigError, match="Expected the address of a network card"):
            listening([f"labcomm={place}"], parse_cell(FILE))
    ros = parse_cell(FILE.replace("labcomm", "ros1"))
    with pytest.raises(ConfigError, match="address by which other nodes reach ros1"):
        listening(["ros1=0.0.0.0"], ros)
    assert listening(["ros1=127.0.0.2"], ros) == {"ros1": "127.0.0.2"}


def test_who_proves_nothing_only_reads() -> None:
    assert not is_open({}, "127.0.0.1")
    assert is_open({}, "192.168.1.5")
    assert is_open({"guarded": False}, "0.0.0.0")
    assert not is_open({"guarded": True}, "0.0.0.0")
