"""`armlab sim`: options, files, bad input; no simulator outlives the process that started it."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from armlab import bridge, cli, robots
from armlab.cli.sim import SurroundingOptions, read_hand, read_operator
from armlab.cli.support.options import sim_url, take_robot_options
from armlab.errors import CommandRefused, ConfigError, UnknownName
from armlab.sim.arm.arm import scara
from armlab.sim.controller.settings import ControllerSettings
from armlab.state import Command
from armlab.wire.egm import EgmCodec, Packet

from ..sim.conftest import ThreadedPeer

HEADER = "t,fx,fy,fz,mx,my,mz\n"


@pytest.fixture
def answering() -> Iterator[int]:
    peer = ThreadedPeer(robots.load("yumi_right"))
    yield peer.port
    peer.close()


@pytest.fixture
def silent() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.settimeout(30)
        yield one


def arguments(port: int, *more: str) -> list[str]:
    return ["sim", "yumi_right", "--to", f"127.0.0.1:{port}", "--lockstep", "--seconds", "0.5", "--extension", *more]


def test_a_run_writes_statistics_and_truth(answering: int, tmp_path: Path, command) -> None:
    operator, truth, stats = tmp_path / "push.csv", tmp_path / "truth.csv", tmp_path / "stats.json"
    operator.write_text(HEADER + "0.1,0,0,0,0,0,0\n0.2,5,0,0,0,0,0\n0.4,5,0,0,0,0,0\n", encoding="utf-8")
    files = ["--operator", str(operator), "--truth", str(truth), "--stats", str(stats)]
    said = command(arguments(answering, "--seed", "3", *files))
    assert said.out == ""
    assert "yumi_right: 0.504 s, 125 packets, 125 replies, 0 starved, 1 sessions" in said.err
    counted = json.loads(stats.read_text(encoding="utf-8"))["yumi_right"]
    assert counted["counts"]["packets"] == 125
    header = truth.read_text(encoding="utf-8").splitlines()[0].split(",")
    rows = np.loadtxt(truth, delimiter=",", skiprows=1)
    assert rows.shape == (125, len(header))
    assert header[:5] == ["robot_ns", "session", "seq", "t [s]", "wrench_true1 [N]"]
    t, push = rows[:, 3], rows[:, 4]
    np.testing.assert_allclose(push, np.interp(t, [0.1, 0.2, 0.4, 0.4001], [0, 5, 5, 0]), atol=1e-3)
    np.testing.assert_array_equal(rows[:, 2], np.arange(125))


def test_two_robots_of_one_name_are_both_counted(tmp_path: Path, silent: socket.socket) -> None:
    stats = tmp_path / "stats.json"
    address = f"127.0.0.1:{silent.getsockname()[1]}"
    words = ["sim", "yumi_left", "yumi_left", "--to", f"{address},{address}", "--seconds", "0.05"]
    assert cli.main([*words, "--stats", str(stats)]) == 0
    assert list(json.loads(stats.read_text(encoding="utf-8"))) == ["yumi_left 1", "yumi_left 2"]


def test_each_robot_may_have_a_seed_of_its_own() -> None:
    def first_packets(seed: str) -> list[bytes]:
        with ExitStack() as stack:
            silent = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
            for one in silent:
                one.bind(("127.0.0.1", 0))
            to = ",".join(f"127.0.0.1:{one.getsockname()[1]}" for one in silent)
            words = ["sim", "yumi_left", "yumi_right", "--to", to, "--seconds", "0.01", "--extension"]
            assert cli.main([*words, "--seed", seed]) == 0
            return [one.recv(65535) for one in silent]

    (left, right), (left_again, other) = (first_packets(seed) for seed in ("4", "4,5"))
    assert left_again == left
    assert other != right


def test_abb_defaults_do_not_replace_what_was_given(answering: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With options as the bridge passes them: it turns ``sim://yumi_right?key=value`` into ``--key value``."""
    seen: list[ControllerSettings] = []
    original = ControllerSettings.__post_init__
    monkeypatch.setattr(ControllerSettings, "__post_init__", lambda self: (original(self), seen.append(self))[0])
    more = ["--period", "0.004", "--gain", "10", "--comm-timeout", "0.5", "--loss", "0.01", "--program", "once"]
    assert cli.main(arguments(answering, "--abb-defaults", "--window", "0.2", *more)) == 0
    assert (seen[-1].window, seen[-1].max_speed) == (0.2, np.radians(1.0))


@pytest.mark.parametrize(
    ("options", "robotware", "n"),
    [
        (["--axes", "6", "--robotware", "7", "--level", "0", "--force"], "7", 6),
        (["--axes", "scara", "--external", "1", "--fields", "utilizationRate"], "6.07", 4),
        (["--axes", "6", "--program", "lead-through", "--rapid", "undefined"], "6.10", 6),
    ],
)
def test_flavours_from_the_command(options: list[str], robotware: str, n: int, silent: socket.socket, command) -> None:
    to = f"127.0.0.1:{silent.getsockname()[1]}"
    assert cli.main(["sim", "--to", to, "--seconds", "0.05", *options]) == 0
    robot = scara() if n == 4 else robots.load("irb1200")
    packet = EgmCodec(robot).decode(silent.recv(65535))
    assert isinstance(packet, Packet)
    assert (packet.robotware, len(packet.q)) == (robotware, n)


def test_events_as_json(capsys: pytest.CaptureFixture[str], silent: socket.socket) -> None:
    to = f"127.0.0.1:{silent.getsockname()[1]}"
    words = ["sim", "ur5e", "--to", to, "--seconds", "0.4", "--comm-timeout", "0.1", "--json"]
    assert cli.main(words) == 0
    event = json.loads(capsys.readouterr().err.splitlines()[0])
    assert (event["number"], event["task"]) == (41822, "ur5e")


def test_a_simulator_ends_with_the_process_that_started_it(silent: socket.socket) -> None:
    """The child keeps the pipe open while it runs, so reading to the end returns only because it has exited."""
    words = [sys.executable, "-m", "armlab", *arguments(silent.getsockname()[1])]
    code = f"import subprocess, sys; subprocess.Popen({words!r}); sys.stdin.readline()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as parent:
        silent.recvfrom(65535)  # the simulator runs and waits for a reply
        _, said = parent.communicate("\n", timeout=30)
    assert "the process that started the simulator has ended" in said


def test_a_simulator_whose_parent_is_gone_before_it_looks_ends(silent: socket.socket) -> None:
    """The bridge passes its process ID, so that a process that adopts the simulator is not mistaken for it."""
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        gone.wait()
    words = arguments(silent.getsockname()[1], "--parent", str(gone.pid))
    assert cli.main(words) == 0
    silent.settimeout(0.05)
    with pytest.raises(TimeoutError):
        silent.recvfrom(65535)


@pytest.mark.slow  # like Ctrl-C, which test_main covers
def test_sim_ends_cleanly_when_terminated(tmp_path: Path, silent: socket.socket) -> None:
    stats = tmp_path / "stats.json"
    words = arguments(silent.getsockname()[1], "--stats", str(stats))
    with subprocess.Popen([sys.executable, "-m", "armlab", *words], stderr=subprocess.PIPE, text=True) as process:
        silent.recvfrom(65535)
        process.terminate()
        _, said = process.communicate(timeout=30)
    assert process.returncode == cli.INTERRUPTED
    assert "interrupted" in said
    assert "Traceback" not in said
    assert json.loads(stats.read_text(encoding="utf-8"))["yumi_right"]["counts"]["packets"] >= 1


def test_around_the_arms(tmp_path: Path) -> None:
    push, robot = tmp_path / "push.csv", robots.load("yumi_right")
    push.write_text(HEADER + "0,1,0,0,0,0,0\n9,1,0,0,0,0,0\n", encoding="utf-8")
    around = SurroundingOptions(operator=push, motors="0:on,2:off", rapid="undefined")
    first, second = (around.scene(robot, index, [0, index], 1) for index in (0, 1))
    assert first.operator.at(1.0) is not None
    assert second.operator is None, "the files are for the first robot"
    assert first.hand is not None
    assert (first.motors.at(3.0), first.rapid.at(3.0), first.external) == (2, 0, 1)
    with pytest.raises(UnknownName, match="off"):
        SurroundingOptions(motors="aus").scene(robot, 0, [0], 0)


def test_invalid_files_of_an_operator_and_a_hand_are_named_with_the_line(tmp_path: Path) -> None:
    path = tmp_path / "hand.csv"
    for text, where in (
        ("t,fx,fy,fz\n", "line 1"),
        (HEADER + "0,1,2,3,4,5,6\n1,1,2,3\n", "line 3"),
        (HEADER + "0,1,2,3,4,5,nan\n", "line 2"),
        (HEADER + "1,0,0,0,0,0,0\n\n1,0,0,0,0,0,0\n", "line 4"),
        (HEADER + "1" * 200_000 + ",0,0,0,0,0,0\n", "line 2"),
        ("", "line 1"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError, match=rf"{where} of .*hand\.csv"):
            read_operator(path)
    for text, what in (("t,q1\n0,0\n", "header t,q1,q2"), ("t,q1,q2\n0,0,0\n", "two rows")):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError, match=what):
            read_hand(path, 2)
    path.write_text("t,q1,q2\n0,0,1\n1,2,1\n2,4,1\n", encoding="utf-8")
    q, qd = read_hand(path, 2).at(1.0)
    np.testing.assert_allclose([q, qd], [[2.0, 1.0], [2.0, 0.0]])


USELESS = {  # commands that need an arm with masses: options by verb
    "sim": ["--operator", "operator.csv"],
    "sim ": ["--grip", "1,2"],
    "sim  ": ["--mismatch.payload", "0.5"],
    "demo": [],
    "excite": ["--seconds", "10"],
}


@pytest.mark.parametrize("verb", USELESS)
@pytest.mark.parametrize("name", ["irb1200", "massless.urdf", "yumi_left"])
def test_hands_and_mismatch_need_masses(verb: str, name: str, tmp_path: Path, command, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("operator.csv").write_text(HEADER + "0,0,0,0,0,0,0\n1,5,0,0,0,0,0\n")
    robots.save(robots.load("irb1200"), "massless.urdf")
    words = {"demo": ["demo", "--robot", name], "excite": ["excite", name, "--run", f"sim://{name}"]}
    words = words.get(verb, ["sim", name])
    more = ["--to", "127.0.0.1:9", "--seconds", "0.01", *USELESS[verb]] if verb.strip() == "sim" else []
    lagging = ["--lagging"] if name == "yumi_left" else []
    if lagging and words[0] != "sim":
        return
    said = command([*words, *more, *lagging], 2).err
    assert "no masses" in said or "--lagging" in said
    assert "kinematic" in said


@pytest.mark.parametrize("name", ["irb1200", "yumi_left"])
@pytest.mark.parametrize("program", ["loop", "stream"])
def test_a_hand_that_leads_needs_its_program(name: str, program: str, tmp_path: Path, command, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    n = robots.load(name).n
    Path("hand.csv").write_text("t," + ",".join(f"q{i + 1}" for i in range(n)) + "\n0" + ",0" * n + "\n1" + ",0" * n)
    words = ["sim", name, "--to", "127.0.0.1:9", "--seconds", "0.01", "--hand", "hand.csv", "--program", program]
    assert f"Expected --program lead-through with --hand, got {program}" in command(words, 2).err


def test_torque_commands_to_an_arm_without_masses_are_refused_with_the_reason() -> None:
    robot = robots.load("irb1200")
    with bridge.connect("sim://irb1200?lockstep=true", robot) as link:
        limits = bridge.Limits.of(robot, tau_max=np.full(6, 10.0))
        with pytest.raises(CommandRefused, match=r"reports no torques.*masses"):
            link.run(lambda state: Command(tau=np.zeros(6)), 1.0, limits=limits)
        assert link.last is not None
        assert any("accepts no torque commands" in str(event) for event in link.last.events)


def test_torque_commands_move_an_arm_of_a_description() -> None:
    robot = robots.load("panda")
    with bridge.connect("sim://panda?lockstep=true", robot) as link:
        run = link.run(lambda state: Command(q=state.q_start, tau=np.full(7, 3.0)), 0.5)
    assert np.abs(run.table["tau"][-1] - run.table["tau"][0]).max() < 20
    assert not run.statistics["problems"]


def test_the_simulator_builds_the_arm_that_tip_and_lock_choose(tmp_path: Path, command) -> None:
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    text = f"""<robot name="two"><link name="base"/>
    <link name="a"><inertial><mass value="1"/>{inertia}</inertial></link>
    <link name="b"><inertial><mass value="2"/>{inertia}</inertial></link>
    <joint name="ja" type="revolute"><parent link="base"/><child link="a"/><limit lower="-1" upper="1"/></joint>
    <joint name="jb" type="revolute"><parent link="a"/><child link="b"/><limit lower="-1" upper="1"/></joint>
    <joint name="jc" type="revolute"><parent link="a"/><child link="c"/><limit lower="-1" upper="1"/></joint>
    <link name="c"/></robot>"""
    path = tmp_path / "two.urdf"
    path.write_text(text)
    several = command(["sim", path, "--to", "127.0.0.1:9", "--seconds", "0.01"], 1).err
    assert "got several: b, c. Select the tip with --tip LINK" in several
    assert "two.urdf: 0.0" in command(["sim", path, "--to", "127.0.0.1:9", "--seconds", "0.01", "--tip", "b"]).err
    shown = command(["robot", "show", path, "--tip=c", "--lock", "jb=0.5", "--json"]).out
    assert json.loads(shown)["inertias"][0][0] == 3.0
    assert "JOINT=VALUE" in command(["robot", "show", path, "--lock", "jb"], 2).err
    assert take_robot_options(["sim", "a", "--lock", "jb", "--to", "x"]) == ["sim", "a", "--to", "x"]
    assert sim_url("a.urdf+b", seed=1) == "sim://a.urdf+b?lock=jb&seed=1", "links build the arm of this command"
    take_robot_options([])
