"""The view of a bridge that runs in headless Chromium: the arms are where the feed says, nothing asks outside."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.kinematics import forward
from armlab.lie import quaternion
from armlab.live.node import rgb
from armlab.live.running_view import RunningView
from armlab.live.scene import TOOL_COLOR

pytestmark = pytest.mark.slow

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
WIDTH, HEIGHT, FOV = 600, 400, np.deg2rad(45.0)
POSITION, LOOK_AT = np.array([1.6, 0.0, 0.9]), np.array([0.2, 0.0, 0.35])
PICTURES = 12  # until the page has drawn what it was sent


def axes() -> np.ndarray:
    """Right, down and forward of the camera, columns."""
    z = (LOOK_AT - POSITION) / np.linalg.norm(LOOK_AT - POSITION)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def projected(point: np.ndarray) -> np.ndarray:
    """Return column and row of a point: a pinhole camera."""
    x, y, z = (point - POSITION) @ axes()
    return np.array([WIDTH, HEIGHT]) / 2.0 + HEIGHT / 2.0 / np.tan(FOV / 2.0) * np.array([x, y]) / z


def off(picture: np.ndarray, at: np.ndarray) -> float:
    """Return how far the ball at the tool is from where it should be [pixels]; infinite where there is none."""
    color = np.array(rgb(TOOL_COLOR), dtype=float)
    pixels = picture[..., :3].astype(float)
    shade = pixels @ color / (color @ color)  # light changes the length, not the direction
    alike = np.linalg.norm(pixels - shade[..., None] * color, axis=-1) < 0.12 * np.linalg.norm(pixels, axis=-1)
    rows, columns = np.nonzero(alike & (shade > 0.3))
    there = np.hypot(columns - at[0], rows - at[1]) < 40.0
    if there.sum() < 8:
        return np.inf
    return float(np.hypot(columns[there].mean() - at[0], rows[there].mean() - at[1]))


def seen(server: Any, points: list[np.ndarray], path: Path) -> float:
    """Return how far the tools in the picture are from where they should be, once they are there or too late."""
    import imageio.v3 as iio

    client = next(iter(server.get_clients().values()))
    worst = np.inf
    for _ in range(PICTURES):
        view = {"wxyz": quaternion.from_matrix(axes()), "position": POSITION, "fov": FOV}
        picture = client.get_render(HEIGHT, WIDTH, **view, transport_format="png", timeout=120.0)
        iio.imwrite(path, picture)
        worst = max(off(picture, projected(point)) for point in points)
        if worst < 6.0:
            break
    return worst


def test_the_arms_in_the_browser_are_where_the_feed_says(
    server: Any, open_page: Callable[[Any], Any], bridge: Any, following: Any, hear_until: Any, tmp_path: Path
) -> None:
    """In two poses, and after the bridge began again; the page says how the link does, and asks only its server."""
    server.gui.main_panel.dock_right()
    one, running = bridge(LEFT, RIGHT), following(rate=1e6)
    view = RunningView(server, running)
    page = open_page(server)

    fields = {"motors": 1, "rapid": 2, "mci": 3, "later": 600.0}  # no old news, however long a picture takes

    def show(one: Any, poses: dict[Any, np.ndarray]) -> float:
        for arm, q in poses.items():
            same = lambda arm=arm, q=q: running.row and np.array_equal(running.value(arm.name, "q"), q)  # noqa: E731
            hear_until(running, same, lambda arm=arm, q=q: one.row(arm, q=q, **fields))
        view.draw()
        return seen(server, [forward(arm, q)[:3, 3] for arm, q in poses.items()], tmp_path / "pose.png")

    for turn in (0.0, 0.3):
        assert show(one, {LEFT: LEFT.q_home + turn, RIGHT: RIGHT.q_home - turn}) < 6.0
    view._due = 0.0
    view.draw()
    page.wait("document.body.innerText.includes('Cell small') && document.body.innerText.includes('holding')")
    page.wait("document.querySelectorAll('.uplot canvas').length >= 3")
    for word in ("rate [Hz]", "p50 / p99 / max [us]", "clamps per joint", "refused packets", "commander", "yumi_right"):
        assert word in page.text()
    one.close()
    hear_until(running, lambda: "has ended" in running.state)
    view._due = 0.0
    view.draw()
    page.wait("document.body.innerText.includes('has ended. Waiting')")
    again = bridge(LEFT, RIGHT)
    hear_until(running, lambda: running.state == "Cell small")
    assert show(again, {LEFT: LEFT.q_home - 0.2, RIGHT: RIGHT.q_home + 0.1}) < 6.0
    page.picture(tmp_path / "page.png")
    assert not page.errors
    outside = [
        url for url in page.requests if not url.startswith(("http://127.0.0.1:", "ws://127.0.0.1:", "data:", "blob:"))
    ]
    assert not outside
