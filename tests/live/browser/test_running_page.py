"""The view of a bridge that runs in headless Chromium: the arms are where the feed says, nothing asks outside."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.kinematics import forward
from armlab.live.live_bridge import RunningView

from .camera import seen

pytestmark = pytest.mark.slow

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def test_the_arms_in_the_browser_are_where_the_feed_says(
    server: Any, open_page: Callable[[Any], Any], bridge: Any, following: Any, hear_until: Any, tmp_path: Path
) -> None:
    """Also after the bridge began again; the page says how the link does, and asks only its server."""
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

    assert show(one, {LEFT: LEFT.q_home + 0.3, RIGHT: RIGHT.q_home - 0.3}) < 6.0
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
    assert not page.outside()
