"""`connect`, `Link`, and whole runs with the simulated robot."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import bridge, log, robots
from armlab.bridge import Limits
from armlab.bridge.control.recording import Recording
from armlab.bridge.link import GROUP, Link, Simulator, codec_named, codecs_of, connect
from armlab.bridge.net.sockets import Port
from armlab.errors import ConfigError, LinkError, NoRobot, RobotError, UnknownName
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec


def sway(state: State) -> Command:
    return Command(state.q_start + 0.05 * np.sin(3.0 * state.t) * np.ones(7))


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("http://x", "egm://127.0.0.1:6510 or sim://"),
        ("egm://", "egm://127.0.0.1:6510 or sim://"),
        ("egm://127.0.0.1:port", "port from 0 to 65535"),
        ("egm://127.0.0.1:99999", "port from 0 to 65535"),
        ("egm://127.0.0.1:0?seed=1", "no options in an egm link, got seed"),
    ],
)
def test_wrong_links(robot: Robot, url: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        connect(url, robot)


def test_wrong_options(robot: Robot) -> None:
    with pytest.raises(UnknownName, match="codec"):
        connect("egm://127.0.0.1:0", robot, codec="egmri")
    with pytest.raises(ConfigError, match="clock"):
        connect("egm://127.0.0.1:0", robot, clock="atomic")  # type: ignore[arg-type]
    with connect("egm://127.0.0.1:0", robot) as link:
        for options in ({"wait": "sleep"}, {"reconnect": "never"}, {"torque": "always"}):
            with pytest.raises(ConfigError, match=next(iter(options))):
                link.run(sway, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("answer_stream", "controller"), [(True, None), (False, sway)])
def test_a_robot_in_lockstep_must_be_answered(robot: Robot, answer_stream: bool, controller: Any) -> None:
    """It would wait for each reply, seemingly for ever."""
    what = "controller=None" if controller is None else "answer_stream=False"
    options: dict[str, Any] = {"answer_stream": answer_stream, "patience": 0.1}
    with (
        bridge.connect("sim://yumi_right?lockstep=true", robot, **options) as simulated,
        bridge.connect("egm://127.0.0.1:0", robot, clock="robot", **options) as listening,
        bridge.connect("egm://127.0.0.1:0", robot, **options) as in_real_time,
    ):
        for link in (simulated, listening):
            with pytest.raises(ConfigError, match=f"lockstep waits for each reply, got {what}"):
                link.run(controller)
        with pytest.raises(NoRobot):
            in_real_time.run(controller)


def test_limits_of_another_robot_are_refused(robot: Robot) -> None:
    limits = Limits(*np.stack([-np.ones(6), *[np.ones(6)] * 5]))
    with connect("egm://127.0.0.1:0", robot) as link, pytest.raises(ConfigError, match=r"7 joints .* got 6"):
        link.run(sway, limits=limits)


def test_the_default_port_is_on_this_computer_only(robot: Robot) -> None:
    with connect("egm://127.0.0.1:0", robot) as link:
        assert isinstance(link, Link)
        assert link.host == "127.0.0.1"
        assert link.port > 0


def test_a_port_in_use(robot: Robot) -> None:
    with (
        connect("egm://127.0.0.1:0", robot) as first,
        pytest.raises(LinkError, match=rf"{first.port} .* in use by") as e,
    ):
        connect(f"egm://127.0.0.1:{first.port}", robot)
    assert str(os.getpid()) in str(e.value)


def test_the_port_is_free_after_the_link(robot: Robot) -> None:
    with connect("egm://127.0.0.1:0", robot) as link:
        number = link.port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", number))


def test_no_robot(robot: Robot) -> None:
    with (
        connect("egm://127.0.0.1:0", robot, patience=0.1) as link,
        pytest.raises(NoRobot, match=str(link.port)) as caught,
    ):
        link.run(sway)
    assert len(caught.value.table) == 0


def test_a_linear_joint_without_a_unit_may_only_be_listened_to(robot: Robot) -> None:
    prismatic = robot.prismatic.copy()
    prismatic[0] = True
    scara = replace(robot, prismatic=prismatic)
    with connect("egm://127.0.0.1:0", scara) as link, pytest.raises(ConfigError, match=r"cannot\. Listen only"):
        link.run(sway)


def test_another_codec(play: Any, robot: Robot) -> None:
    """A site's own interface: an object with the methods of the protocol."""
    from armlab.wire.egm import EgmCodec

    class Counting(EgmCodec):
        decoded = 0

        def decode(self, data: bytes) -> Any:
            self.decoded += 1
            return super().decode(data)

    codec = Counting(robot)
    run = play(lambda peer: peer.rest(), sway, play.link(codec=codec), seconds=0.1)
    assert codec.decoded >= run.statistics["packets"]


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), "3"])
def test_a_time_that_would_never_come_is_refused(robot: Robot, seconds: Any) -> None:
    with connect("egm://127.0.0.1:0", robot) as link, pytest.raises(ConfigError, match="seconds of at least 0"):
        link.run(sway, seconds=seconds)


@pytest.mark.parametrize(
    ("controller", "options", "words"),
    [
        (5, {}, "controller to call"),
        (sway, {"limits": 3}, r"Expected Limits, .* got 3\. Use Limits\.of"),
        (sway, {"extra": {"a": 3}}, r"extra=\{'a': Column"),
    ],
)
def test_what_a_run_cannot_use_is_refused_before_it_begins(
    robot: Robot, controller: Any, options: Any, words: str
) -> None:
    with connect("egm://127.0.0.1:0", robot) as link, pytest.raises(ConfigError, match=words):
        link.run(controller, **options)


def test_a_closed_link_does_not_run(robot: Robot) -> None:
    with connect("egm://127.0.0.1:0", robot) as link:
        pass
    with pytest.raises(LinkError, match=r"closed\. Connect again"):
        link.run(sway)


def test_two_runs_on_one_link(play: Any) -> None:
    link = play.link()
    first = play(lambda peer: peer.rest(), sway, link, seconds=0.1)
    robot = play.peer

    def go_on(peer: Any) -> None:
        robot.over = peer.over
        robot.rest()

    second = play(go_on, sway, link, seconds=0.1)
    assert first.reason == second.reason == "the time is up"
    assert second.table["seq"][0] >= first.table["seq"][-1]
    for run in (first, second):
        assert run.statistics["replies"] + run.statistics["overtaken"] == run.statistics["packets"]
        assert np.isfinite(run.table["q_ref"]).all(axis=1).sum() >= 25


def test_own_limits(play: Any, robot: Robot) -> None:
    limits = Limits.of(robot, speed=0.01)
    run = play(lambda peer: peer.rest(), sway, limits=limits, seconds=0.2)
    assert np.abs(run.table["qd_sent"]).max() <= 0.01 * robot.qd_max.max() + 1e-9
    assert run.statistics["worst_ratio"] < 0.5


def test_seconds_count_from_readiness(play: Any) -> None:
    def script(peer: Any) -> None:
        peer.cycles(100, mci=2)
        peer.rest()

    run = play(script, sway, seconds=0.2)
    assert run.statistics["packets"] > 250
    running = np.isfinite(run.table["q_ref"][:, 0])
    assert not running[:100].any()
    assert running.sum() == pytest.approx(51, abs=1)


def test_a_session_that_ends_ends_the_run_when_asked(play: Any) -> None:
    link = play.link(clock="wall")

    def script(peer: Any) -> None:
        peer.begin()
        peer.cycles(20)
        peer.cycle(motors=2)

    run = play(script, sway, link, reconnect="stop", wait="block")
    assert run.reason == "the motors were switched off"


def test_a_session_that_begins_anew_at_once_ends_the_run_when_asked(play: Any) -> None:
    """The controller's program loops: the next session begins before the silence of the last one is seen."""

    def script(peer: Any) -> None:
        peer.begin()
        peer.cycles(20)
        peer.cycle(converged=True)
        peer.packets.seq, peer.packets.cycle = 0, peer.packets.cycle + 50
        peer.send()
        peer.over.wait(10.0)

    run = play(script, sway, reconnect="stop")
    assert "convergence" in run.reason
    assert run.table["seq"][-1] == 0
    assert np.isnan(run.table["q_sent"][-1]).all()  # the next session heard nothing


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_stops_the_arm_first_and_completes_the_log(play: Any, tmp_path: Path, number: signal.Signals) -> None:
    path = tmp_path / "run.mcap"

    def controller(state: State) -> Command:
        if state.seq == 50:
            signal.raise_signal(number)
        return sway(state)

    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt):
        play(lambda peer: peer.rest(), controller, record=path)
    assert signal.getsignal(number) is before
    table = log.read(path)
    assert "Stopping: interrupted." in [event.text for event in log.inspect(path).events]
    np.testing.assert_array_equal(table["seq"], np.arange(len(table)))
    assert len(table) > 50 + 0.5 / 0.004
    np.testing.assert_array_equal(table["qd_sent"][-1], 0.0)


def test_a_second_ctrl_c_raises_at_once(play: Any) -> None:
    def controller(state: State) -> Command:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("not reached")

    with pytest.raises(KeyboardInterrupt):
        play(lambda peer: peer.rest(), controller)


def test_the_simulated_robot_in_lockstep_is_repeatable(robot: Robot) -> None:
    tables = []
    for _ in range(2):
        with bridge.connect("sim://yumi_right?lockstep=true&seed=4", robot) as link:
            tables.append(link.run(sway, seconds=1.0).table)
    one, two = tables
    for name in ("q", "qd", "tau", "q_sent", "qd_sent", "robot_ns", "seq"):
        np.testing.assert_array_equal(one[name], two[name])
    assert np.isfinite(one["tau"]).all()
    assert one["q"].std(axis=0).min() > 0.01


def test_two_runs_of_the_simulated_robot(robot: Robot) -> None:
    with bridge.connect("sim://yumi_right?lockstep=true", robot) as link:
        first, second = (link.run(sway, seconds=0.5) for _ in range(2))
    assert first.reason == second.reason
    assert second.statistics["replies"] == second.statistics["packets"]


def test_a_simulator_that_dies_early_is_quoted(robot: Robot) -> None:
    url = "sim://yumi_right?operator=no_such_file.csv"
    with bridge.connect(url, robot) as link, pytest.raises(LinkError, match=r"armlab sim.*status.*no_such_file.csv"):
        link.run(sway, seconds=1.0)


@pytest.mark.parametrize("fault", ["loss=0.1", "duplicate=0.5", "reorder=0.1", "corrupt=0.1"])
def test_faults_on_the_way_leave_the_arm_within_limits(robot: Robot, fault: str) -> None:
    with bridge.connect(f"sim://yumi_right?lockstep=true&seed=2&{fault}", robot) as link:
        run = link.run(sway, seconds=1.0)
    table = run.table
    assert run.reason == "the time is up"
    sent = table["q_sent"][np.isfinite(table["q_sent"]).all(axis=1)]
    assert np.abs(np.diff(sent, axis=0)).max() <= robot.qd_max.max() * 1.5 * 0.004032
    assert run.statistics["replies"] + run.statistics["overtaken"] == run.statistics["packets"] == len(table)


_PROGRAM = """
import sys
from armlab import bridge, robots
from armlab.state import Command
robot = robots.load("yumi_right")
def controller(state):
    if state.t > 0.3 and not told:
        told.append(1)
        print("running", flush=True)
    return Command(qd=0.1 + 0.0 * state.q)
told = []
with bridge.connect("sim://yumi_right", robot) as link:
    try:
        link.run(controller, record=sys.argv[1])
    except KeyboardInterrupt:
        print("stopped", flush=True)
"""


def test_ctrl_c_in_real_time(tmp_path: Path) -> None:
    """A program of its own, interrupted from outside: the log is complete, the arm at rest, the simulator gone."""
    path = tmp_path / "run.mcap"
    command = [sys.executable, "-c", _PROGRAM, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "running\n"
        program.send_signal(signal.SIGINT)
        assert program.stdout.readline() == "stopped\n"
        assert program.wait(20.0) == 0
    table = log.read(path)
    np.testing.assert_array_equal(table["qd_sent"][-1], 0.0)
    assert np.nanmax(table["qd_sent"]) == pytest.approx(0.1)
    assert not any("recovered" in note for note in table.notes)


def test_robots_that_egm_cannot_describe() -> None:
    """Refused before any socket opens. An IRB 2400, whose axis 3 is not the third joint, is none of them."""
    bridge.connect("egm://127.0.0.1:0", robots.load("irb2400")).close()
    with pytest.raises(RobotError, match=r"Expected a Robot, got 'yumi_left'\. Load it first"):
        bridge.connect("egm://127.0.0.1:0", "yumi_left")  # type: ignore[arg-type]


def test_what_else_a_packet_says_is_read_on_demand() -> None:
    """The drive's gravity, its mode and the planned pose, of which a State has no field; None where nobody sent it."""
    seen: list[Any] = []
    with bridge.connect("sim://yumi_right?lockstep=true", robots.load("yumi_right")) as link:
        link.run(lambda state: seen.append(state.details()), seconds=0.05)
    assert len(seen) > 5
    assert np.isfinite(seen[-1].tau_gravity).all()
    assert np.isfinite(seen[-1].T_frame_planned).all()
    assert (seen[-1].mode, seen[-1].move_index, seen[-1].used_seq > 0) == (1, None, True)
    assert State(0.0, 0.004, np.zeros(1), np.zeros(1), np.zeros(1)).details() is None


PATIENCE = 30.0


def wait_until_gone(simulator: Simulator) -> str:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        reason = simulator.gone()
        if reason:
            return reason
        time.sleep(0.02)
    raise TimeoutError


def test_it_sends_and_is_stopped() -> None:
    port = Port("127.0.0.1", 0)
    simulator = Simulator(["yumi_right"], [port.port], {"lockstep": "true", "seed": "3"})
    try:
        assert select.select([port], [], [], PATIENCE)[0]
        assert simulator.gone() == ""
    finally:
        simulator.stop()
        port.close()
    assert "interrupted" in " ".join(simulator.lines)


def test_an_end_in_time_is_no_error() -> None:
    port = Port("127.0.0.1", 0)
    simulator = Simulator(["yumi_right"], [port.port], {"seconds": "0.05", "lockstep": "false"})
    try:
        assert wait_until_gone(simulator) == "the simulated robot ended"
    finally:
        simulator.stop()
        port.close()


def test_an_early_death_is_quoted() -> None:
    simulator = Simulator(["no_such_robot"], [9], {})
    try:
        with pytest.raises(LinkError, match=r"armlab sim no_such_robot .* status .*no_such_robot.*yumi_right"):
            wait_until_gone(simulator)
    finally:
        simulator.stop()


_DIES_AT_ONCE = """
import os, sys
from armlab.bridge.link import Simulator
print(Simulator(["yumi_right"], [int(sys.argv[1])], {})._process.pid, flush=True)
os._exit(0)
"""


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="tells living processes by /proc")
def test_it_does_not_outlive_a_bridge_that_dies_while_it_starts() -> None:
    """The bridge is gone long before the simulator can look who started it."""
    port = Port("127.0.0.1", 0)
    command = [sys.executable, "-c", _DIES_AT_ONCE, str(port.port)]
    number = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE).stdout.strip()
    deadline = time.monotonic() + PATIENCE
    try:
        while _command_of(number) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not _command_of(number), "the simulator lives on without its bridge"
        assert not select.select([port], [], [], 0.0)[0], "it never spoke"
    finally:
        port.close()
        if _command_of(number):
            os.kill(int(number), signal.SIGKILL)


def _command_of(number: str) -> str:
    """Return the command of our process, "" when it is gone or only waits to be buried."""
    try:
        command = Path(f"/proc/{number}/cmdline").read_text(encoding="utf-8")
    except OSError:
        return ""
    return command if "armlab" in command else ""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package as pip would install it, with three entry points."""
    (tmp_path / "somesite.py").write_text(
        "from armlab.wire.egm import EgmCodec\n"
        "def good(robot):\n    return EgmCodec(robot, extension=True)\n"
        "def bad(robot):\n    return 5\n"
        "def broken(robot):\n    raise OSError('no licence')\n"
    )
    info = tmp_path / "somesite-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: somesite\nVersion: 1.0\n")
    points = "\n".join(f"{name} = somesite:{name}" for name in ("good", "bad", "broken"))
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{points}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "somesite", raising=False)


def test_ours(robot: Robot) -> None:
    codec = codec_named("egm", robot, extension=True)
    assert isinstance(codec, EgmCodec)
    assert "torque" in codec.capabilities


@pytest.mark.usefixtures("package")
def test_an_entry_point(robot: Robot) -> None:
    first, second = codec_named("good", robot), codec_named("good", robot)
    assert first is not second
    assert "measured_torque" in first.capabilities
    with connect("egm://127.0.0.1:0", robot, codec="good") as link:
        assert link.port > 0


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "words"), [("bad", "got int without capabilities"), ("broken", "OSError: no licence")]
)
def test_entry_points_that_give_no_codec(robot: Robot, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        codec_named(name, robot)


@pytest.mark.usefixtures("package")
def test_unknown_names_list_what_exists(robot: Robot) -> None:
    with pytest.raises(UnknownName, match="bad, broken, egm, good"):
        codec_named("egmri", robot)


def test_an_object_of_ones_own(robot: Robot) -> None:
    own: Any = SimpleNamespace(capabilities=frozenset(("position",)), reset=None, decode=None, encode=None)
    with connect("egm://127.0.0.1:0", robot, codec=own) as link:
        assert link.robot is robot


def test_an_object_that_is_no_codec_is_refused(robot: Robot) -> None:
    with pytest.raises(ConfigError, match=r"wire\.egm\.Codec, got 5\."):
        connect("egm://127.0.0.1:0", robot, codec=5)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="one codec per arm"):
        codecs_of(EgmCodec(robot), [robot, robot], extension=False)


BROKEN = r"^Expected a cycle without errors, got ZeroDivisionError: division by zero\.$"


def test_an_error_outside_the_controller_stops_the_arm_first(play: Any, robot: Any) -> None:
    """A codec of the user's that raises, against its protocol."""

    class Broken(EgmCodec):
        decoded = 0

        def decode(self, data: bytes) -> Any:
            self.decoded += 1
            if self.decoded == 40:
                raise ZeroDivisionError("division by zero")
            return super().decode(data)

    def script(peer: Any) -> None:
        while not peer.over.is_set():  # one packet has no answer
            peer.send()
            with contextlib.suppress(TimeoutError):
                peer.answer(0.05)

    with pytest.raises(LinkError, match=BROKEN) as caught:
        play(script, lambda state: Command(qd=np.full(7, 0.1)), play.link(codec=Broken(robot)))
    sent = caught.value.table["qd_sent"]
    assert np.nanmax(sent) > 0.05
    assert not sent[-1].any()


def test_an_error_in_the_guard_stops_the_arm(play: Any, robot: Any) -> None:
    """While the guard answers for a controller that sleeps, the codec raises: the run ends and says so."""
    asleep, raised = threading.Event(), threading.Event()

    class Broken(EgmCodec):
        def encode(self, reference: Any) -> bytes:
            if asleep.is_set() and not raised.is_set():
                raised.set()
                raise ZeroDivisionError("division by zero")
            return super().encode(reference)

    def controller(state: State) -> Command:
        if state.t > 0.05 and not asleep.is_set():
            asleep.set()
            assert raised.wait(5.0)
        return Command(qd=np.full(7, 0.1))

    def script(peer: Any) -> None:
        peer.begin()
        while not peer.over.is_set():  # one packet has no answer
            peer.send()
            with contextlib.suppress(TimeoutError):
                peer.answer(0.02)

    with pytest.raises(LinkError, match=BROKEN) as caught:
        play(script, controller, play.link(clock="wall", codec=Broken(robot)))
    sent = caught.value.table["qd_sent"]
    assert not sent[-1].any()


def answered(peer: Any) -> None:
    """Guided packets until the run has ended, which the loop under test sees to."""
    peer.begin()
    until = time.monotonic() + 20.0
    while not peer.over.is_set():
        assert time.monotonic() < until
        peer.send()
        with contextlib.suppress(TimeoutError):
            peer.answer(0.05)


def test_errors_while_the_arm_stops_end_the_run(play: Any, robot: Any) -> None:
    """A codec that raises from then on: the loop must not go round for ever."""

    class Broken(EgmCodec):
        broken = False

        def decode(self, data: bytes) -> Any:
            if self.broken:
                raise ZeroDivisionError("division by zero")
            return super().decode(data)

    codec = Broken(robot)

    def controller(state: State) -> Command:
        codec.broken = state.t > 0.1
        return Command.stop() if codec.broken else Command(qd=np.full(7, 0.1))

    with pytest.raises(LinkError, match=BROKEN) as caught:
        play(answered, controller, play.link(codec=codec))
    assert np.nanmax(caught.value.table["qd_sent"]) > 0.05


def test_a_row_for_which_there_is_no_memory_is_recorded_later(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """No hole and none twice: the table has a row for each packet."""
    keep, failures = Recording.keep, [MemoryError()]

    def fails_once(self: Recording, state: State, command: Command | None, tick: Any) -> Command | None:
        if tick.number == 30 and failures:
            raise failures.pop()
        return keep(self, state, command, tick)

    monkeypatch.setattr(Recording, "keep", fails_once)

    with pytest.raises(LinkError, match=r"without errors, got MemoryError: no memory is left\.") as caught:
        play(answered, lambda state: Command(qd=np.full(7, 0.1)))
    table = caught.value.table
    np.testing.assert_array_equal(table["tick"], np.arange(len(table)))
    assert len(table) > 31
    assert not table["qd_sent"][-1].any()


def test_rows_for_which_there_is_never_memory_leave_the_reason_and_a_whole_file(
    play: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    keep = Recording.keep

    def fails(self: Recording, state: State, command: Command | None, tick: Any) -> Command | None:
        if tick.number >= 30:
            raise MemoryError
        return keep(self, state, command, tick)

    monkeypatch.setattr(Recording, "keep", fails)

    link = play.link()
    with pytest.raises(LinkError, match=r"got MemoryError: no memory is left\."):
        play(answered, lambda state: Command(qd=np.full(7, 0.1)), link, record=tmp_path / "run.mcap")
    assert len(log.read(tmp_path / "run.mcap")) == 30
    assert "The last rows were not recorded: MemoryError." in link.last.statistics["problems"]


def test_a_run_without_memory_for_its_end_does_not_begin(
    play: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def none_left(*_: Any) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr("armlab.bridge.control.loop.mmap", none_left)
    link = play.link()
    with pytest.raises(LinkError, match=r"Expected 16 MiB .* of the run: Cannot allocate memory\. End other"):
        play(lambda peer: None, lambda state: None, link, record=tmp_path / "run.mcap")
    assert log.inspect(tmp_path / "run.mcap").finished
    assert link.last.reason == "there is no memory for its end"
