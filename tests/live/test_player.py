"""The player of logs: what it shows at which instant, without a browser."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import LogError, ShapeError
from armlab.kinematics import forward
from armlab.lie import quaternion, se3
from armlab.live.recording_view import Player, Recorded
from armlab.live.scene import rgb
from armlab.log import Table

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
T = 0.004 * np.arange(5000)
EVENTS = ((2.0, "a limit acts"), (5.5, "<stop>"))


def arm(robot: robots.Robot, **columns: np.ndarray) -> Recorded:
    q = robot.q_home + 0.3 * np.sin(T)[:, None]
    tau = np.tile(np.arange(7.0), (len(T), 1))
    return Recorded(robot, Table(T, {"q": q, "tau": tau, **columns}), T, EVENTS if robot is LEFT else ())


@pytest.fixture
def pressed() -> Recorded:
    """A force that grows along x, known better and better."""
    f = np.zeros((len(T), 6))
    f[:, 0] = T
    return arm(LEFT, wrench_hat=f, wrench_hat_cov=np.eye(6) * (30.0 - T)[:, None, None])


def tool(server: Any, robot: robots.Robot) -> np.ndarray:
    path, T = f"/{robot.name}/arm", np.eye(4)
    for name in (*(f"link_{i + 1}" for i in range(robot.n)), "tool"):
        path += f"/{name}"
        handle = server.scene.get_handle_by_name(path)
        T = T @ se3.from_rp(quaternion.to_matrix(handle.wxyz), handle.position)
    return T[:3, 3]


def tip(arrow: Any) -> np.ndarray:
    return arrow.position + quaternion.to_matrix(arrow.wxyz) @ [0.0, 0.0, arrow.scale[2]]


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
            np.testing.assert_allclose(tool(server, robot), want, atol=1e-12, rtol=0)


def test_time_goes_on_while_playing_at_its_speed_and_ends(server: Any) -> None:
    player = Player(server, [arm(LEFT)])
    before = tool(server, LEFT)
    player.advance(1.0)
    assert player.t == 0.0
    player.play()
    player.speed = 4.0
    player.advance(0.5)
    assert player.t == pytest.approx(2.0)
    assert np.abs(tool(server, LEFT) - before).max() > 1e-3
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
        np.testing.assert_allclose(tip(arrow), tool(server, LEFT) + 0.01 * t * np.eye(3)[0], atol=1e-9, rtol=0)
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


def test_the_path_is_that_of_the_last_ten_seconds(server: Any) -> None:
    one = arm(LEFT)
    player = Player(server, [one])
    player.seek(15.0)
    player.advance(0.0)
    path = server.scene.get_handle_by_name("/yumi_left/path").points
    np.testing.assert_allclose(path[0, 0], one.tool[one.row(5.0)], atol=2e-3, rtol=0)
    np.testing.assert_allclose(path[-1, 1], one.tool[one.row(15.0)], atol=2e-2, rtol=0)


def test_sliders_set_speed_and_length_of_a_force(server: Any, pressed: Recorded) -> None:
    player = Player(server, [pressed])
    control(server, "speed").value = 0.5
    control(server, "force [mm/N]").value = 20.0
    player.seek(10.0)
    player.advance(0.0)
    assert player.speed == 0.5
    arrow = server.scene.get_handle_by_name("/yumi_left/force")
    np.testing.assert_allclose(tip(arrow), tool(server, LEFT) + 0.2 * np.eye(3)[0], atol=1e-9, rtol=0)
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
