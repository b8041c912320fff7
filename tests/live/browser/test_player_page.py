"""The view of a log in headless Chromium: what a person would see is where the log says.

Two arms move for eight seconds, then rest while a force is on them: none, one without a covariance, one that is known
well, one that is badly known along y, one that may be zero. All pictures are kept in the folder of the tests.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import live, robots
from armlab.kinematics import forward, link_transforms
from armlab.live.recording_view import Recorded
from armlab.live.scene import ARROW, LINK_COLORS, TOOL_COLOR, rgb
from armlab.log import Table
from armlab.robots import Robot

from .camera import HEIGHT, WIDTH, projected, taken

pytestmark = pytest.mark.slow

ARMS = (robots.load("yumi_left"), robots.load("yumi_right"))
FORCE = np.array([0.0, 12.0, 16.0])
T = 0.02 * np.arange(14 * 50)
NO_FORCE, BARE, SHARP, WIDE, DOUBTFUL = 8.5, 9.5, 10.5, 11.5, 12.5  # s
PAGE_COLORS = {"force": ("#D55E00", "#009E73", "#0072B2"), "torque": ("#CC79A7", "#E69F00", "#56B4E9", "#000000")}


def recorded(robot: Robot) -> Recorded:
    phase = np.minimum(T, 8.0)[:, None] + np.arange(robot.n)
    q = robot.q_home + 0.4 * (np.sin(phase) - np.sin(np.arange(robot.n)))
    wrench, cov = np.zeros((len(T), 6)), np.full((len(T), 6, 6), np.nan)
    wrench[T >= 9.0, :3] = FORCE
    for begin, sigma in ((10.0, (1.0, 1.0, 1.0)), (11.0, (1.0, 6.0, 1.0)), (12.0, (9.0, 9.0, 9.0))):
        cov[begin <= T] = np.diag(np.square([*sigma, 0.1, 0.1, 0.1]))
    columns = {
        "q": q, "tau": 5.0 * np.sin(phase), "wrench_hat": wrench, "wrench_hat_cov": cov, "q_ref": q,
        "receive_ns": np.round(1e9 * T) + 1e6, "send_ns": np.round(1e9 * T) + 1.4e6,
        **{name: np.full(len(T), value) for name, value in (("motors", 1), ("mci", 3), ("rapid", 2), ("seq_sent", 1))},
    }  # fmt: skip
    return Recorded(robot, Table(T, columns), T, ((4.0, "half way"),))


class View:
    """A player with its page, and a camera of its own."""

    def __init__(self, server: Any, page: Any, folder: Path) -> None:
        self.server, self.page, self.folder = server, page, folder
        self.player = live.Player(server, [recorded(robot) for robot in ARMS])

    def at(self, t: float) -> None:
        self.player.pause()
        self.player.seek(t)
        self.player.advance(0.0)

    def hide_arms(self) -> None:
        """Show forces alone, until the next instant."""
        for robot in ARMS:
            self.server.scene.get_handle_by_name(f"/{robot.name}/arm").visible = False

    def picture(self, name: str) -> np.ndarray:
        return taken(self.server, self.folder / f"{name}.png").astype(float)

    def until(self, name: str, good: Callable[[np.ndarray], bool]) -> np.ndarray:
        """Return the first picture that is good, or the tenth: what was sent may still be on its way to the page."""
        for _ in range(9):
            found = self.picture(name)
            if good(found):
                return found
        return self.picture(name)


@pytest.fixture(scope="module")
def view(_server: Any, open_page: Callable[[Any], Any], tmp_path_factory: pytest.TempPathFactory) -> View:
    _server.scene.reset()
    _server.gui.reset()
    _server.gui.main_panel.dock_right()
    view = View(_server, open_page(_server), tmp_path_factory.mktemp("pictures"))
    view.at(1.0)
    last = [np.zeros((HEIGHT, WIDTH, 4))]

    def settled(now: np.ndarray) -> bool:
        """Whether light has come, which is loaded last, and nothing changes any more."""
        tools = near(now, TOOL_COLOR, saturation=0.4)
        lit = tools.sum() > 50 and now[tools][:, :3].max(axis=-1).mean() > 120.0
        same = bool(lit and np.abs(now - last[0]).max() < 2.0)
        last[0] = now
        return same

    view.until("first", settled)
    return view


def hue(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return hue [turns] and saturation of each pixel."""
    red, green, blue = np.moveaxis(picture[..., :3] / 255.0, -1, 0)
    high, low = picture[..., :3].max(axis=-1) / 255.0, picture[..., :3].min(axis=-1) / 255.0
    turn = np.arctan2(np.sqrt(3.0) * (green - blue), 2.0 * red - green - blue) / (2.0 * np.pi)
    return turn % 1.0, (high - low) / np.maximum(high, 1e-9)


def near(picture: np.ndarray, color: str, tolerance: float = 0.03, saturation: float = 0.15) -> np.ndarray:
    """Return which pixels have the hue of a colour, in any light."""
    wanted, _ = hue(np.array([[[*rgb(color)]]], dtype=float))
    turn, strong = hue(picture)
    off = np.abs((turn - wanted[0, 0] + 0.5) % 1.0 - 0.5)
    return (picture[..., 3] > 128) & (off < tolerance) & (strong > saturation)


def marker(picture: np.ndarray, at: np.ndarray, reach: float = 40.0) -> np.ndarray:
    """Return the middle of the tool's ball (column, row) nearest to a place; NaN where there is none."""
    rows, columns = np.nonzero(near(picture, TOOL_COLOR, saturation=0.4))
    there = np.hypot(columns - at[0], rows - at[1]) < reach
    return np.array([np.nan, np.nan]) if there.sum() < 8 else np.array([columns[there].mean(), rows[there].mean()])


def tool_points(robot: Robot, t: float) -> np.ndarray:
    return forward(robot, robot.q_home + 0.4 * (np.sin(t + np.arange(robot.n)) - np.sin(np.arange(robot.n))))[:3, 3]


def test_both_arms_are_where_the_log_says(view: View) -> None:
    view.at(t := 4.8)
    wanted = {robot.name: projected(tool_points(robot, t)) for robot in ARMS}

    def off(picture: np.ndarray) -> float:
        return max(float(np.hypot(*(marker(picture, at) - at))) for at in wanted.values())

    picture = view.until("pose", lambda found: off(found) < 6.0)
    assert off(picture) < 6.0
    for robot, color in zip(ARMS, LINK_COLORS, strict=True):
        link = near(picture, color, tolerance=0.05, saturation=0.05)
        q = robot.q_home + 0.4 * (np.sin(t + np.arange(robot.n)) - np.sin(np.arange(robot.n)))
        joints = projected(np.concatenate([link_transforms(robot, q)[:, :3, 3], tool_points(robot, t)[None]]))
        mount = projected(robot.T_base_mount[:3, 3])
        found = 0
        for a, b in zip([mount, *joints[:-1]], joints):
            column, row = np.round(0.5 * (a + b)).astype(int)
            found += bool(link[row - 4 : row + 5, column - 4 : column + 5].mean() > 0.5)
        assert found >= 2, f"{robot.name}: {found} links in their colour"
        assert link.sum() > 500


def test_no_marker_without_an_arm(view: View) -> None:
    view.at(1.0)
    view.hide_arms()
    picture = view.until("hidden", lambda found: not near(found, TOOL_COLOR, saturation=0.4).any())
    assert near(picture, TOOL_COLOR, saturation=0.4).sum() == 0


def equal(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((np.abs(a - b).max(axis=-1) > 8.0).sum() < 5)


def test_the_arrow_ends_where_the_force_does(view: View) -> None:
    for robot in ARMS:
        tool = tool_points(robot, 8.0)
        base, tip = projected(tool), projected(tool + ARROW * FORCE)
        along = (tip - base) / np.linalg.norm(tip - base)

        def arrow(picture: np.ndarray, base: np.ndarray = base, along: np.ndarray = along) -> tuple[float, int]:
            """Return how far from the tool its colour reaches along the force [pixels], and how many pixels have it."""
            rows, columns = np.nonzero(near(picture, "#D55E00", saturation=0.6))
            offset = np.stack([columns, rows], axis=1) - base
            inside = (np.abs(offset @ [-along[1], along[0]]) < 12.0) & (offset @ along > 0.0) & (offset @ along < 150.0)
            return float((offset @ along)[inside].max(initial=0.0)), int(inside.sum())

        length = float(np.linalg.norm(tip - base))
        view.at(BARE)
        view.hide_arms()  # nothing stands before the arrow, and no joint has its colour
        picture = view.until(
            f"force_{robot.name}", lambda found, arrow=arrow, length=length: abs(arrow(found)[0] - length) < 6.0
        )
        reach, pixels = arrow(picture)
        assert abs(reach - length) < 6.0
        assert pixels > 40
        view.at(NO_FORCE)
        view.hide_arms()
        picture = view.until(f"no_force_{robot.name}", lambda found, arrow=arrow: arrow(found)[1] == 0)
        assert arrow(picture)[1] == 0


def test_the_ellipsoid_is_wide_where_the_force_is_badly_known(view: View) -> None:
    tip = tool_points(ARMS[0], 8.0) + ARROW * FORCE
    view.at(BARE)
    view.until("bare", lambda found: near(found, "#D55E00", saturation=0.6).sum() > 100)
    bare = view.picture("bare")
    extents = {}
    for name, t, sigma in (("sharp", SHARP, 1.0), ("wide", WIDE, 6.0)):
        view.at(t)
        ends = projected(tip + 2.0 * ARROW * sigma * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))
        across = float(np.linalg.norm(ends[0] - ends[1]))

        def extent(found: np.ndarray) -> float:
            """Return the width of what came to the picture of the bare force around the tip [pixels]."""
            rows, columns = np.nonzero(np.abs(found - bare).max(axis=-1) > 12.0)
            at = projected(tip)
            there = (np.abs(rows - at[1]) < 30) & (np.abs(columns - at[0]) < 70)
            return float(np.ptp(columns[there])) if there.any() else 0.0

        picture = view.until(f"ellipsoid_{name}", lambda found, w=across: abs(extent(found) - w) < 0.2 * w + 3.0)
        extents[name] = extent(picture)
        assert abs(extents[name] - across) < 0.2 * across + 3.0
    assert extents["wide"] > 3.0 * extents["sharp"]


def test_a_force_that_may_be_zero_is_grey(view: View) -> None:
    tip = projected(tool_points(ARMS[0], 8.0) + 0.6 * ARROW * FORCE)
    column, row = np.round(tip).astype(int)
    strong = {}
    spot = (slice(row - 3, row + 4), slice(column - 3, column + 4))
    for name, t in (("certain", BARE), ("doubtful", DOUBTFUL)):
        view.at(t)
        want = name == "certain"
        picture = view.until(name, lambda found, want=want: bool(hue(found[spot])[1].mean() > 0.4) is want)
        strong[name] = float(hue(picture[spot])[1].mean())
    assert strong["certain"] > 0.4 > 0.2 > strong["doubtful"]


def test_the_page_shows_curves_and_words(view: View) -> None:
    view.at(SHARP)
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
        if all(force.get(color, 0) > 20 for color in PAGE_COLORS["force"]):
            break
        time.sleep(0.25)
    for canvas, colors in ((whole, ("#E69F00", "#000000")), (force, PAGE_COLORS["force"])):
        assert all(canvas.get(color, 0) > 20 for color in colors), (colors, canvas)
    assert all(torque.get(color, 0) > 20 for color in (*PAGE_COLORS["force"], *PAGE_COLORS["torque"])), torque
    assert moment.get("#0072B2", 0) > 20, moment
    view.page.picture(view.folder / "page.png")


def test_a_click_on_play_moves_the_arm(view: View) -> None:
    view.at(2.0)
    first = view.until(
        "before_the_click", lambda found: not np.isnan(marker(found, projected(tool_points(ARMS[0], 2.0)))).any()
    )
    view.page.click("Play")
    view.page.wait("true")
    for _ in range(200):
        view.player.run(0.05)
        if view.player.playing and view.player.t > 3.0:
            break
    assert view.player.playing
    picture = view.until("after_the_click", lambda found: not equal(found, first))
    assert not equal(picture, first)
    view.page.click("Pause")
    for _ in range(200):
        view.player.run(0.05)
        if not view.player.playing:
            break
    assert not view.player.playing
    view.page.click("Next event")
    for _ in range(200):
        view.player.run(0.05)
        if view.player.t == 4.0:
            break
    assert view.player.t == 4.0


def test_nothing_is_asked_of_anybody_else_and_nothing_went_wrong(view: View) -> None:
    view.page.value("1")
    here = f"http://127.0.0.1:{view.server.get_port()}"
    assert any(one.startswith(here) for one in view.page.requests)
    assert view.page.outside() == []
    assert view.page.errors == []
