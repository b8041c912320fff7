"""The view of a log in headless Chromium: what a person would see is where the log says. Pictures are kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import live, robots
from armlab.kinematics import forward
from armlab.live.recording_view import Recorded
from armlab.log import Table
from armlab.robots import Robot

from .camera import seen

pytestmark = pytest.mark.slow

ARMS = (robots.load("yumi_left"), robots.load("yumi_right"))
T = 0.02 * np.arange(14 * 50)
FORCE_COLORS, TORQUE_COLORS = ("#D55E00", "#009E73", "#0072B2"), ("#CC79A7", "#E69F00", "#56B4E9", "#000000")


def positions(robot: Robot, t: np.ndarray) -> np.ndarray:
    return robot.q_home + 0.4 * (np.sin(t[:, None] + np.arange(robot.n)) - np.sin(np.arange(robot.n)))


def recorded(robot: Robot) -> Recorded:
    """Return a moving arm with a force from 9 s on, whose covariance is known from 10 s on."""
    q, wrench, cov = positions(robot, T), np.zeros((len(T), 6)), np.full((len(T), 6, 6), np.nan)
    wrench[T >= 9.0, :3] = [0.0, 12.0, 16.0]
    cov[T >= 10.0] = np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])
    columns = {
        "q": q, "tau": 5.0 * np.sin(T[:, None] + np.arange(robot.n)), "wrench_hat": wrench, "wrench_hat_cov": cov,
        "q_ref": q,
        "receive_ns": np.round(1e9 * T) + 1e6, "send_ns": np.round(1e9 * T) + 1.4e6,
        **{name: np.full(len(T), value) for name, value in (("motors", 1), ("mci", 3), ("rapid", 2), ("seq_sent", 1))},
    }  # fmt: skip
    return Recorded(robot, Table(T, columns), T, ((4.0, "half way"),))


class View:
    """A player with its page."""

    def __init__(self, server: Any, page: Any) -> None:
        self.server, self.page = server, page
        self.player = live.Player(server, [recorded(robot) for robot in ARMS])

    def at(self, t: float) -> None:
        self.player.pause()
        self.player.seek(t)
        self.player.advance(0.0)

    def run_until(self, condition: Callable[[], bool]) -> None:
        for _ in range(1000):  # only a failing test uses all of them
            self.player.run(0.05)
            if condition():
                return
        pytest.fail("the page did not reach the player")


@pytest.fixture(scope="module")
def view(_server: Any, open_page: Callable[[Any], Any]) -> View:
    _server.scene.reset()
    _server.gui.reset()
    _server.gui.main_panel.dock_right()
    return View(_server, open_page(_server))


def test_both_arms_are_where_the_log_says(view: View, tmp_path: Path) -> None:
    view.at(4.8)
    tools = [forward(robot, positions(robot, np.array([4.8]))[0])[:3, 3] for robot in ARMS]
    assert seen(view.server, tools, tmp_path / "pose.png") < 6.0


def test_the_page_shows_curves_and_words(view: View, tmp_path: Path) -> None:
    view.at(10.5)
    for words in ("running", "50.0 Hz", "p50 400 µs", "yumi_right", "4.00 s: half way"):
        view.page.wait(f"document.body.innerText.includes({words!r})")
    view.page.wait("document.querySelectorAll('.uplot canvas').length >= 4")
    script = """[...document.querySelectorAll('.uplot canvas')].map(canvas => {
        const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data, seen = {};
        for (let i = 0; i < data.length; i += 4) if (data[i + 3] > 250) {
            const key = '#' + [0, 1, 2].map(k => data[i + k].toString(16).padStart(2, '0')).join('').toUpperCase();
            seen[key] = (seen[key] || 0) + 1;
        }
        return seen;
    })"""
    for _ in range(40):  # a busy computer draws the curves after their canvases
        whole, force, torque, moment = view.page.value(script)[:4]
        if all(force.get(color, 0) > 20 for color in FORCE_COLORS):
            break
        time.sleep(0.25)
    wanted = (
        (whole, ("#E69F00", "#000000")),
        (force, FORCE_COLORS),
        (torque, (*FORCE_COLORS, *TORQUE_COLORS)),
        (moment, ("#0072B2",)),
    )
    for canvas, colors in wanted:
        assert all(canvas.get(color, 0) > 20 for color in colors), (colors, canvas)
    view.page.picture(tmp_path / "page.png")


def test_clicks_play_pause_and_go_to_the_next_event(view: View) -> None:
    view.at(2.0)
    view.page.click("Play")
    view.run_until(lambda: view.player.playing and view.player.t > 3.0)
    view.page.click("Pause")
    view.run_until(lambda: not view.player.playing)
    view.page.click("Next event")
    view.run_until(lambda: view.player.t == 4.0)


def test_nothing_is_asked_of_anybody_else_and_nothing_went_wrong(view: View) -> None:
    view.page.value("1")
    here = f"http://127.0.0.1:{view.server.get_port()}"
    assert any(one.startswith(here) for one in view.page.requests)
    assert view.page.outside() == []
    assert view.page.errors == []
