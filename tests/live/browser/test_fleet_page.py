"""The view of many robots in headless Chromium: each is where its rows say, who goes goes, who comes is added."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.kinematics import forward
from armlab.live.fleet_view import FleetView

from ..fleet_bridges import Fleet, hear_fleet
from .camera import seen

pytestmark = pytest.mark.slow

UR, LEFT = robots.load("ur5e"), robots.load("yumi_left")
PATIENCE = 120.0  # s


def test_the_robots_in_the_browser_are_where_their_rows_say(
    server: Any, open_page: Callable[[Any], Any], fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One goes and one comes; the page names all, and asks only its server."""
    server.gui.main_panel.dock_right()
    rows = fleet.rows()
    view = FleetView(server, rows)
    page = open_page(server)
    monkeypatch.setattr("armlab.live.fleet_view._SILENT", 60.0)  # a picture takes seconds, in which nobody hears

    arms = {f"lab1/{name}": fleet.bridge(robot, name) for name, robot in (("a", UR), ("b", LEFT))}

    def drawn(name: str) -> bool:
        known = rows.robots.get(name)
        return name in view._drawn and known is not None and np.array_equal(known.value("q"), arms[name].q)

    def off() -> float:
        """Pixels from where the tools should be, before each robot."""
        hear_fleet(rows, lambda: all(drawn(name) for name in arms), view.draw)
        worst = 0.0
        for name, one in arms.items():
            place = np.asarray(server.scene.get_handle_by_name(f"/{name}").position)
            tool = forward(one.robot, one.q)[:3, 3] + place
            worst = max(worst, seen(server, [tool], tmp_path / f"{name.replace('/', '_')}.png", place))
        return worst

    for one in arms.values():
        one.q = one.robot.q_home + 0.3
    assert off() < 6.0
    arms.pop("lab1/b").close()
    arms["lab1/c"] = fleet.bridge(LEFT, "c")
    hear_fleet(rows, lambda: rows.robots["lab1/b"].state == "gone" and drawn("lab1/c"), view.draw)
    assert off() < 6.0
    words = ("lab1/a", "lab1/b", "lab1/c", "gone", "there", "2 of 3 robots at 127.0.0.1")
    until = time.monotonic() + PATIENCE
    while not all(word in page.text() for word in words):
        assert time.monotonic() < until, page.text()
        rows.hear(0.05)
        view.draw()
    page.picture(tmp_path / "fleet.png")
    assert not page.errors
    assert not page.outside()
