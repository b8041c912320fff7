"""Logs of arms: on one clock, with their robots and events, and the text shown for each instant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log, robots
from armlab.errors import LogError, ModelMismatchError, RobotError, ShapeError
from armlab.kinematics import forward
from armlab.live.recording_view import Player, Recorded, read_arms
from armlab.live.scene import rgb
from armlab.log import Recorder, Table, Tick
from armlab.models import TorqueModel
from armlab.robots import Robot
from armlab.state import Command, State

from .nodes import tip, tool

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
START = 1_700_000_000_000_000_000
DT = 0.004


def recording(path: Path, robot: Robot, first: float = 0.0, seconds: float = 2.0, **options: object) -> Path:
    with Recorder(path, robot, **options) as recorder:  # type: ignore[arg-type]
        for k in range(round(seconds / DT)):
            stamp = START + round(1e9 * (first + DT * k))
            q = robot.q_home + 0.1 * DT * k * np.eye(robot.n)[0]
            late = DT * k >= seconds / 2.0
            state = State(
                t=DT * k, dt=DT, q=q, qd=np.zeros(robot.n), tau=np.zeros(robot.n), seq=k, robot_ns=stamp,
                motors=1, mci=3, rapid=2, missed=int(k == 10),
            )  # fmt: skip
            command = Command(q=q) if late else None
            clamped = np.array([0, 2 * late, *[0] * (robot.n - 2)])
            tick = Tick(k, k, stamp, stamp, stamp + 400_000, 0, q_sent=q, clamped=clamped)
            recorder.row(state, command, tick)
            if k == 100:
                recorder.event("something happened", stamp)
    return path


@pytest.fixture
def table() -> Callable[..., Table]:
    def make(n: int = 7, **columns: np.ndarray) -> Table:
        t = DT * np.arange(500)
        return Table(t, {"q": np.tile(LEFT.q_home[:n], (500, 1)), **columns})

    return make


def test_two_arms_of_two_files_are_on_one_clock(tmp_path: Path) -> None:
    files = [recording(tmp_path / "left.mcap", LEFT), recording(tmp_path / "right.mcap", RIGHT, first=0.5)]
    left, right = read_arms(files)
    assert (left.robot, right.robot) == (LEFT, RIGHT)
    assert left.t[0] == 0.0
    assert right.t[0] == pytest.approx(0.5)
    assert left.events[-1] == (pytest.approx(0.4), "something happened")
    assert right.events[-1] == (pytest.approx(0.9), "something happened")
    assert left.row(0.2) == 50
    assert left.row(0.2 - 1e-6) == 49
    assert (left.row(-1.0), left.row(99.0)) == (0, 499)
    assert left.span(1.0, 0.4) == slice(150, 251)
    assert left.span(-5.0, 0.4) == slice(0, 1)
    np.testing.assert_array_equal(left.tool, forward(LEFT, left.table["q"])[:, :3, 3])


def test_two_arms_of_one_file_are_both_shown(tmp_path: Path) -> None:
    mine = robots.from_dh("mine", [0.0] * 7, [0.1] * 7, [0.0] * 7)
    files = [recording(tmp_path / "left.mcap", LEFT), recording(tmp_path / "mine.mcap", mine, first=0.5)]
    both = log.merge(files, tmp_path / "both.mcap")
    first, second = sorted(read_arms([both]), key=lambda arm: arm.robot.name)
    assert (first.robot, second.robot) == (mine, LEFT)
    assert (first.t[0], second.t[0]) == (pytest.approx(0.5), 0.0)
    assert len(first.table) == len(second.table) == 500


def test_what_is_said_of_an_instant(tmp_path: Path) -> None:
    (arm,) = read_arms([recording(tmp_path / "left.mcap", LEFT)])
    early, late = arm.words(0.5), arm.words(1.5)
    assert early == {
        "state": "holding",
        "rate": "250.0 Hz",
        "latency": "p50 400 µs, p99 400 µs",
        "clamps": "none (0 rows so far)",
        "drops": "1 missed, 0 refused",
    }
    assert late["state"] == "running"
    assert late["clamps"] == "velocity of joint 2 (126 rows so far)"
    assert arm.words(3.0)["state"] == "no packet for 1.0 s"
    assert arm.words(-0.1)["state"] == "not started"


def test_an_estimate_goes_before_a_sensor(table: Callable[..., Table]) -> None:
    hat, cov = np.full((500, 6), 2.0), np.tile(np.diag(np.arange(1.0, 7.0)), (500, 1, 1))
    sensor = np.ones((500, 6))
    both = Recorded(LEFT, table(wrench_hat=hat, wrench_hat_cov=cov, wrench=sensor), table().t)
    np.testing.assert_array_equal(both.wrench, hat)
    assert both.sigma is not None
    np.testing.assert_allclose(both.sigma[3], np.sqrt(np.arange(1.0, 7.0)))
    measured = Recorded(LEFT, table(wrench=sensor, wrench_hat_cov=cov), table().t)
    np.testing.assert_array_equal(measured.wrench, sensor)
    assert measured.covariance is None  # that of an estimate does not apply to a sensor


def test_robots_come_from_the_file_the_library_or_the_caller(tmp_path: Path, table: Callable[..., Table]) -> None:
    special = robots.from_dh("mine", [0.0] * 7, [0.1] * 7, [0.0] * 7)
    path = recording(tmp_path / "mine.mcap", special)  # the file contains its description
    assert read_arms([path])[0].robot == special
    assert read_arms([path], [special])[0].robot is special
    log.write(table(), tmp_path / "run.csv")
    with pytest.raises(RobotError, match="a file that names no robot"):
        read_arms([tmp_path / "run.csv"])
    assert read_arms([tmp_path / "run.csv"], [RIGHT])[0].robot is RIGHT


def test_a_robot_that_a_file_tells_is_not_taken_for_the_next_one(tmp_path: Path, table: Callable[..., Table]) -> None:
    files = [recording(tmp_path / "left.mcap", LEFT, seconds=0.2), tmp_path / "run.csv"]
    log.write(table(), files[1])
    assert [arm.robot.name for arm in read_arms(files, [LEFT, RIGHT])] == ["yumi_left", "yumi_right"]


def test_a_bag_of_another_program_shows_the_arm_in_its_posture(ur5e_bag: Path) -> None:
    (arm,) = read_arms([ur5e_bag], [robots.load("ur5e")])
    np.testing.assert_array_equal(arm.table["q"][0], np.arange(6.0))
    (same,) = read_arms([ur5e_bag / "bag.mcap"], [robots.load("ur5e")])
    np.testing.assert_array_equal(same.tool, arm.tool)


def test_a_model_estimates_for_its_own_arm_only(tmp_path: Path, model: TorqueModel, excited: Table) -> None:
    log.write(excited.select("q", "qd", "tau"), tmp_path / "left.csv")
    (arm,) = read_arms([tmp_path / "left.csv"], [LEFT], [model])
    assert arm.wrench is not None
    assert arm.covariance is not None
    with pytest.raises(ModelMismatchError, match=r"torque model, 'yumi_left' .*, got 'yumi_right' .*mount moved"):
        read_arms([tmp_path / "left.csv"], [RIGHT], [model])


def test_logs_that_cannot_be_shown_are_refused(tmp_path: Path, table: Callable[..., Table]) -> None:
    with pytest.raises(LogError, match="at least one log"):
        read_arms([])
    with pytest.raises(LogError, match="Expected"):
        read_arms([tmp_path / "none.mcap"])
    path = recording(tmp_path / "left.mcap", LEFT, seconds=0.2)
    with pytest.raises(LogError, match="each arm only once, got yumi_left"):
        read_arms([path, path])
    log.write(table(n=6), tmp_path / "six.csv")
    with pytest.raises(LogError, match=r"positions q \(N, 7\) of yumi_left.*\(500, 6\)"):
        read_arms([tmp_path / "six.csv"], [LEFT])
    with Recorder(tmp_path / "nothing.mcap", LEFT):
        pass
    with pytest.raises(LogError, match=r"rows of yumi_left in .*nothing\.mcap, got an empty log"):
        read_arms([tmp_path / "nothing.mcap"])


T = 0.004 * np.arange(5000)
EVENTS = ((2.0, "a limit acts"), (5.5, "<stop>"))


def arm(robot: robots.Robot, **columns: np.ndarray) -> Recorded:
    q = robot.q_home + 0.3 * np.sin(T)[:, None]
    tau = np.tile(np.arange(7.0), (len(T), 1))
    return Recorded(robot, Table(T, {"q": q, "tau": tau, **columns}), T, EVENTS if robot is LEFT else ())


@pytest.fixture
def pressed() -> Recorded:
    f = np.zeros((len(T), 6))
    f[:, 0] = T
    return arm(LEFT, wrench_hat=f, wrench_hat_cov=np.eye(6) * (30.0 - T)[:, None, None])


def control(server: Any, label: str) -> Any:
    found = [one for one in server.gui._gui_input_handle_from_uuid.values() if one.label == label]
    assert len(found) == 1, label
    return found[0]


def test_arms_stand_where_the_log_says(server: Any) -> None:
    player = Player(server, [arm(LEFT), arm(RIGHT)])
    assert player.duration == T[-1]
    for t in (0.0, 3.3333, 20.0, -1.0, 99.0):
        player.seek(t)
        player.advance(0.0)
        k = max(int(np.searchsorted(T, t, side="right")) - 1, 0)
        for robot in (LEFT, RIGHT):
            want = forward(robot, robot.q_home + 0.3 * np.sin(T[k]))[:3, 3]
            np.testing.assert_allclose(tool(server, robot.name, 7)[:3, 3], want, atol=1e-12, rtol=0)


def test_time_goes_on_while_playing_at_its_speed_and_ends(server: Any) -> None:
    player = Player(server, [arm(LEFT)])
    before = tool(server, "yumi_left", 7)[:3, 3]
    player.advance(1.0)
    assert player.t == 0.0
    player.play()
    player.speed = 4.0
    player.advance(0.5)
    assert player.t == pytest.approx(2.0)
    assert np.abs(tool(server, "yumi_left", 7)[:3, 3] - before).max() > 1e-3
    player.pause()
    player.advance(1.0)
    assert player.t == pytest.approx(2.0)
    player.play()
    player.advance(1e6)
    assert (player.t, player.playing) == (player.duration, False)
    player.play()
    assert player.t == 0.0  # begins again


def test_the_next_event_is_jumped_to_and_told(server: Any) -> None:
    player = Player(server, [arm(LEFT), arm(RIGHT)])
    found = []
    for _ in range(3):
        player.next_event()
        player.advance(0.0)
        found.append((player.t, player._controls._said.content))
    assert [t for t, _ in found] == [2.0, 5.5, 2.0]
    assert "2.00 s: a limit acts" in found[0][1]
    assert "5.50 s: &lt;stop&gt;" in found[1][1]
    Player(server, [arm(RIGHT)]).next_event()  # there is none


def test_the_force_of_that_instant_and_its_covariance_are_drawn(server: Any, pressed: Recorded) -> None:
    player = Player(server, [pressed])
    widths = []
    for t, significant in ((5.0, False), (18.0, True)):
        player.seek(t)
        player.advance(0.0)
        arrow = server.scene.get_handle_by_name("/yumi_left/force")
        at = tool(server, "yumi_left", 7)[:3, 3] + 0.01 * t * np.eye(3)[0]
        np.testing.assert_allclose(tip(arrow), at, atol=1e-9, rtol=0)
        assert (tuple(arrow.color) == rgb("#D55E00")) is significant
        widths.append(max(server.scene.get_handle_by_name("/yumi_left/uncertainty").scale))
    np.testing.assert_allclose(widths, 0.02 * np.sqrt([25.0, 12.0]))


def test_curves_show_the_last_ten_seconds_and_the_whole_run(server: Any, pressed: Recorded) -> None:
    player = Player(server, [pressed])
    player.seek(15.0)
    player.advance(0.0)
    force = player._panels[0].force._plot.data
    assert force[0][0] == pytest.approx(5.0, abs=0.05)
    assert force[0][-1] == pytest.approx(15.0, abs=0.05)
    np.testing.assert_allclose(force[1], force[0], atol=0.05, rtol=0)
    np.testing.assert_allclose(force[4] - force[5], 4.0 * np.sqrt(30.0 - force[0]), atol=0.1, rtol=0)
    np.testing.assert_array_equal(player._panels[0].torque._plot.data[4], 3.0)
    whole = player._run._plot.data
    assert whole[0][0] == pytest.approx(0.0, abs=0.06)
    assert whole[0][-1] == pytest.approx(T[-1], abs=0.06)
    marked = np.isfinite(whole[2])
    np.testing.assert_array_equal(whole[0][marked], [15.0, 15.0])


def test_without_a_force_the_whole_run_is_the_speed_of_the_tool(server: Any) -> None:
    one = arm(LEFT)
    player = Player(server, [one])
    speed = np.linalg.norm(np.gradient(one.tool, T, axis=0), axis=1)
    assert np.nanmax(player._run._plot.data[1]) == pytest.approx(speed.max())
    panel = player._panels[0]
    assert [plot._plot.visible for plot in (panel.force, panel.moment, panel.torque)] == [False, False, True]


def test_sliders_set_speed_and_length_of_a_force(server: Any, pressed: Recorded) -> None:
    player = Player(server, [pressed])
    control(server, "speed").value = 0.5
    control(server, "force [mm/N]").value = 20.0
    player.seek(10.0)
    player.advance(0.0)
    assert player.speed == 0.5
    arrow = server.scene.get_handle_by_name("/yumi_left/force")
    np.testing.assert_allclose(tip(arrow), tool(server, "yumi_left", 7)[:3, 3] + 0.2 * np.eye(3)[0], atol=1e-9, rtol=0)
    assert control(server, "time [s]").value == 10.0
    assert (control(server, "speed").min, control(server, "speed").max) == (0.1, 4.0)


def test_a_run_that_is_bounded_ends(server: Any) -> None:
    player = Player(server, [arm(LEFT)])
    player.play()
    player.run(0.1)
    assert player.t > 0.0


def test_wrong_input_gets_a_sentence(server: Any) -> None:
    with pytest.raises(LogError, match="at least one recorded arm"):
        Player(server, [])
    player = Player(server, [arm(LEFT)])
    for t in (np.nan, np.inf, "now"):
        with pytest.raises(ShapeError):
            player.seek(t)  # type: ignore[arg-type]
