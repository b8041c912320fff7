"""`connect`, `Link`, their URLs, and whole runs with the simulated robot."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import bridge, log, robots
from armlab.bridge import Limits
from armlab.bridge.control.recording import Recording
from armlab.bridge.control.run import checked_limits
from armlab.bridge.link import GROUP, Simulator, codec_named, connect
from armlab.bridge.net.sockets import Port
from armlab.bridge.urls import Address, addresses, simulator_options, split_url
from armlab.errors import ConfigError, LinkError, LogError, ModelMismatchError, NoRobot, RobotError, UnknownName
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec

from ..processes import until

RIGHT = robots.load("yumi_right")


@pytest.mark.parametrize(
    ("url", "robot", "error", "words"),
    [
        ("sim://yumi", RIGHT, UnknownName, "yumi_right"),
        ("sim://none.toml", RIGHT, RobotError, r"none\.toml"),
        ("sim://irb2400", RIGHT, ModelMismatchError, r"sim://irb2400, 'irb2400' .*got 'yumi_right' .*7 joints, not 6"),
        ("sim://yumi_left", RIGHT, ModelMismatchError, "mount moved by"),
    ],
)
def test_a_simulated_arm_that_is_not_the_robot_is_refused_at_once(url, robot, error, words) -> None:
    with pytest.raises(error, match=words):
        connect(url, robot)


def test_addresses() -> None:
    assert addresses([f"egm://127.0.0.1:{'0' * 5000}6510"], 1)[0].port == 6510
    assert addresses(["egm://10.0.0.1"], 1) == [Address("egm", "10.0.0.1", 6510, "", {})]
    assert [one.port for one in addresses(["egm://127.0.0.1", "egm://127.0.0.1"], 2)] == [6511, 6512]
    assert addresses(["labcomm://lab?order=chain"], 1) == [Address("labcomm", "lab", 7511, "", {"order": "chain"})]
    assert [one.port for one in addresses(["labcomm://lab", "labcomm://lab"], 2)] == [7511, 7512]
    assert addresses(["labcomm://lab:99"], 1)[0].port == 99
    assert split_url("egm://[::1]:6510/a").port == 6510


PORTS = ["65536", "0000001000000", "0" * 30 + "70000", "1" * 5000, "٦٥١٠", "-1", "x"]


@pytest.mark.parametrize(
    ("urls", "words"),
    [
        *(([f"egm://127.0.0.1:{port}"], "a port from 0 to 65535") for port in PORTS),
        (["labcomm://lab:x"], "labcomm://HOST:PORT"),
        (["egm://[::1"], "Expected a URL such as egm"),
        (["sim://a]"], "Expected a URL such as egm"),
        (["sim://"], "Expected a link"),
        (["sim://a+b"], "one URL per robot, got 2 for 1"),
        ([None], "got None"),
        (["sim://a?seed=1&loss=0.1", "sim://b?seed=2"], "same scheme and options, .* Only the seeds of simulated"),
        (["labcomm://a?seed=1", "labcomm://b?seed=2"], "Only the seeds of simulated robots may differ"),
    ],
    ids=range(15),
)
def test_urls_that_are_none(urls: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        addresses(urls, len(urls))


def test_simulated() -> None:
    both = addresses(["sim://yumi_left+yumi_right?seed=3"], 2)
    assert [one.robot for one in both] == ["yumi_left", "yumi_right"]
    assert both[0].options == both[1].options == {"seed": "3"}
    assert addresses(["sim://a?seed=3", "sim://b?seed=3"], 2)[1].robot == "b"
    files = addresses(["sim://mine/a.toml+/lab/b%3f%20c.toml?seed=3"], 2)
    assert [(one.robot, one.options) for one in files] == [
        ("mine/a.toml", {"seed": "3"}),
        ("/lab/b? c.toml", {"seed": "3"}),
    ]
    assert addresses(["sim:///lab/b.toml"], 1)[0].robot == "/lab/b.toml"
    for urls, options in (
        (["sim://a?seed=3&loss=0.1", "sim://b?loss=0.1&seed=4"], {"seed": "3,4", "loss": "0.1"}),
        (["sim://a", "sim://b?seed=4", "sim://c"], {"seed": "0,4,0"}),
        (["sim://a?seed=4", "sim://b?seed=4"], {"seed": "4"}),
    ):
        assert simulator_options(addresses(urls, len(urls))) == options


def sway(state: State) -> Command:
    return Command(state.q_start + 0.05 * np.sin(3.0 * state.t) * np.ones(7))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"controller": 5}, "a callable controller"),
        ({"limits": 3}, r"Expected Limits, .* got 3\. Use Limits\.of"),
        ({"limits": Limits(*np.stack([-np.ones(6), *[np.ones(6)] * 5]))}, r"7 joints of yumi_right, got 6"),
        ({"limits": [Limits.of(RIGHT)] * 2}, "Limits for each"),
        ({"extra": {"a": 3}}, r"extra=\{'a': Column"),
        ({"seconds": -1.0}, "seconds of at least 0"),
        ({"seconds": float("nan")}, "seconds of at least 0"),
        ({"seconds": "3"}, "seconds of at least 0"),
        ({"wait": "sleep"}, "wait"),
        ({"reconnect": "never"}, "reconnect"),
        ({"torque": "always"}, "torque"),
        ({"record": "/dev/null/run.mcap"}, "run.mcap"),
    ],
)
def test_what_a_run_cannot_use_is_refused_before_it_begins(robot: Robot, options: Any, words: str) -> None:
    with connect("egm://127.0.0.1:0", robot) as link:
        assert (link.host, link.port > 0) == ("127.0.0.1", True)
        with pytest.raises((ConfigError, LogError), match=words):
            link.run(**{"controller": sway, **options})
    with pytest.raises(LinkError, match=r"this link is closed\. Connect again"):
        link.run(sway)


@pytest.mark.parametrize(
    ("url", "arms", "options", "words"),
    [
        ("http://x", 1, {}, "egm://127.0.0.1:6510 or sim://"),
        ("egm://", 1, {}, "egm://127.0.0.1:6510 or sim://"),
        ("egm://127.0.0.1:0?seed=1", 1, {}, "rws=HOST, optionally .* got seed"),
        ("egm://127.0.0.1:0", 1, {"clock": "atomic"}, "clock"),
        ("egm://127.0.0.1:0", 1, {"patience": 0.0}, "patience above 0 s"),
        ("sim://yumi_left", 2, {}, "one URL per robot, got 1 for 2"),
        (["egm://127.0.0.1:6510"] * 2, 2, {}, "a separate port for each arm"),
        (["sim://yumi_left", "egm://127.0.0.1:0"], 2, {}, "the same scheme"),
        (["egm://127.0.0.1:0"] * 2, 0, {}, "different names"),
        ("egm://127.0.0.1:0", 3, {}, r"Expected a Robot, got 'yumi_left'\. Load the robot first"),
        ("egm://127.0.0.1:0", 1, {"codec": 5}, r"wire\.egm\.Codec, got 5\."),
        ("egm://127.0.0.1:0", 1, {"codec": "egmri"}, "codec.*egmri.*egm"),
        ("egm://127.0.0.1:0", 1, {"codec": [EgmCodec(RIGHT)] * 2}, "one codec per arm"),
    ],
)
def test_wrong_links(url: Any, arms: int, options: dict[str, Any], words: str) -> None:
    robot: Any = {0: [RIGHT, RIGHT], 1: RIGHT, 2: [robots.load("yumi_left"), RIGHT], 3: "yumi_left"}[arms]
    with pytest.raises((ConfigError, RobotError, UnknownName), match=words):
        connect(url, robot, **options)


@pytest.mark.parametrize(("answer_stream", "controller"), [(True, None), (False, sway)])
def test_a_robot_in_lockstep_must_be_answered(robot: Robot, answer_stream: bool, controller: Any) -> None:
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


def test_a_port_in_use(robot: Robot) -> None:
    with (
        connect("egm://127.0.0.1:0", robot) as first,
        pytest.raises(LinkError, match=rf"{first.port} .* in use by") as e,
    ):
        connect(f"egm://127.0.0.1:{first.port}", robot)
    assert str(os.getpid()) in str(e.value)


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


def test_ctrl_c_stops_the_arm_first_and_completes_the_log(play: Any, tmp_path: Path) -> None:
    path, number = tmp_path / "run.mcap", signal.SIGTERM  # Ctrl-C is tested in real time below

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


@pytest.mark.slow
def test_the_simulated_robot_in_lockstep_is_repeatable_and_on_one_clock(robot: Robot, tmp_path: Path) -> None:
    runs, seen = [], list[Any]()

    def controller(state: State) -> Command:
        seen.append(state.details())
        return sway(state)

    for path in (None, tmp_path / "run.mcap"):
        with bridge.connect("sim://yumi_right?lockstep=true&seed=4", robot) as link:
            runs.append(link.run(controller, seconds=0.6, record=path))
    one, two = (run.table for run in runs)
    for name in ("q", "qd", "tau", "q_sent", "qd_sent", "robot_ns", "seq"):
        np.testing.assert_array_equal(one[name], two[name])
    assert np.isfinite(one["tau"]).all()
    assert one["q"].std(axis=0).min() > 0.01
    begin, events = two.t0_ns, log.inspect(tmp_path / "run.mcap").events
    assert len(events) > 1
    assert all(begin <= event.stamp_ns <= begin + 2 * 10**9 for event in events)
    assert all(begin <= stamp <= begin + 2 * 10**9 for stamp, _ in runs[1].events)
    # The drive's gravity and mode and the planned pose have no field in State; values that were not sent are None.
    assert np.isfinite(seen[-1].tau_gravity).all()
    assert np.isfinite(seen[-1].T_frame_planned).all()
    assert (seen[-1].mode, seen[-1].move_index, seen[-1].used_seq > 0) == (1, None, True)
    assert State(0.0, 0.004, np.zeros(1), np.zeros(1), np.zeros(1)).details() is None


PATIENCE = 30.0


def test_an_end_in_time_is_no_error_and_an_early_death_is_quoted() -> None:
    with contextlib.closing(Port("127.0.0.1", 0)) as port, contextlib.ExitStack() as stack:
        ended = Simulator(["yumi_right"], [port.port], {"seconds": "0.05", "lockstep": "false"})
        stack.callback(ended.stop)
        dead = Simulator(["no_such_robot"], [9], {})
        stack.callback(dead.stop)
        assert until(ended.gone, PATIENCE) == "the simulated robot ended"
        with pytest.raises(LinkError, match=r"armlab sim no_such_robot .* status .*no_such_robot.*yumi_right"):
            until(dead.gone, PATIENCE)


_DIES_AT_ONCE = """
import os, sys
from armlab.bridge.link import Simulator
print(Simulator(["yumi_right"], [int(sys.argv[1])], {})._process.pid, flush=True)
os._exit(0)
"""


@pytest.mark.slow  # 1 s, mostly for the start of a process
@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="identifies running processes by /proc")
def test_it_does_not_outlive_a_bridge_that_dies_while_it_starts() -> None:
    port = Port("127.0.0.1", 0)
    command = [sys.executable, "-c", _DIES_AT_ONCE, str(port.port)]
    number = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE).stdout.strip()
    try:
        until(lambda: not _command_of(number), PATIENCE, "the end of the simulator without its bridge")
        assert not select.select([port], [], [], 0.0)[0], "it never spoke"
    finally:
        port.close()
        if _command_of(number):
            os.kill(int(number), signal.SIGKILL)


def _command_of(number: str) -> str:
    """Return the command line of our process, or "" if it is gone or a zombie."""
    with contextlib.suppress(OSError):
        command = Path(f"/proc/{number}/cmdline").read_text(encoding="utf-8")
        return command if "armlab" in command else ""
    return ""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a package with three entry points, as pip would do."""
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


@pytest.mark.usefixtures("package")
def test_an_entry_point(robot: Robot) -> None:
    first = codec_named("good", robot)
    assert first is not codec_named("good", robot)
    assert "measured_torque" in first.capabilities
    with connect("egm://127.0.0.1:0", robot, codec="good") as link:
        assert link.port > 0
    with pytest.raises(UnknownName, match="bad, broken, egm, good"):
        codec_named("egmri", robot)
    connect("egm://127.0.0.1:0", robots.load("irb2400")).close()  # whose axis 3 is not the third joint
    scara = replace(robot, prismatic=np.arange(7) == 0)  # a prismatic joint without a unit
    with (
        connect("egm://127.0.0.1:0", scara) as link,
        pytest.raises(ConfigError, match=r"without that capability\. To listen only"),
    ):
        link.run(sway)


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "words"), [("bad", "got int without capabilities"), ("broken", "OSError: no licence")]
)
def test_entry_points_that_give_no_codec(robot: Robot, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        codec_named(name, robot)


def answered(peer: Any) -> None:
    """Send guided packets until the run has ended; the loop under test ends it."""
    peer.begin()
    latest = time.monotonic() + 20.0
    while not peer.over.is_set():
        assert time.monotonic() < latest
        peer.send()
        with contextlib.suppress(TimeoutError):
            peer.answer(0.05)


BROKEN = r"^Expected the cycle to run without errors, got ZeroDivisionError: division by zero\.$"


def test_an_error_outside_the_controller_stops_the_arm_first(play: Any, robot: Any) -> None:
    class Broken(EgmCodec):
        decoded = 0

        def decode(self, data: bytes) -> Any:
            self.decoded += 1
            if self.decoded == 40:
                raise ZeroDivisionError("division by zero")
            return super().decode(data)

    with pytest.raises(LinkError, match=BROKEN) as caught:  # one packet gets no answer
        play(answered, lambda state: Command(qd=np.full(7, 0.1)), play.link(codec=Broken(robot)))
    sent = caught.value.table["qd_sent"]
    assert np.nanmax(sent) > 0.05
    assert not sent[-1].any()


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
    with pytest.raises(LinkError, match=r"got MemoryError: out of memory\."):
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
    with pytest.raises(LinkError, match=r"Expected 16 MiB .* of the run: Cannot allocate memory\. Close other"):
        play(lambda peer: None, lambda state: None, link, record=tmp_path / "run.mcap")
    assert log.inspect(tmp_path / "run.mcap").finished
    assert link.last.reason == "not enough memory to end the run"


def test_a_robot_without_limits_of_speed_is_not_commanded() -> None:
    """Any jump would pass the limits, because the allowed jump is set by the allowed speed."""
    robot = robots.load("dh_test")
    with pytest.raises(ConfigError, match=r"speed and acceleration.* of dh_test.*qd_max"):
        checked_limits(None, [robot])
    with pytest.raises(ConfigError, match="of dh_test"):
        checked_limits(Limits.of(robot), [robot])
    assert len(checked_limits(None, [robot], commands=False)) == 1
    ones = np.ones(robot.n)
    slow = Limits(-np.inf * ones, np.inf * ones, ones, ones, ones, ones)
    assert checked_limits(slow, [robot]) == [slow]
