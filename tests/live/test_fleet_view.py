"""`FleetRows`: the robots at a router, their newest rows, and robots that leave or return with another run."""

from __future__ import annotations

import json
import math
from functools import partial
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.row import RowSchema
from armlab.bridge.servers.zenoh.messages import EVERY
from armlab.bridge.servers.zenoh.session import LabAddress
from armlab.errors import LinkError
from armlab.kinematics import forward
from armlab.live.fleet_view import FleetRows, FleetView, SeenRobot, watch_fleet
from armlab.robots import to_toml

from .fleet_bridges import Fleet, hear_fleet
from .nodes import link, node, pose, tool

LEFT, UR = robots.load("yumi_left"), robots.load("ur5e")


def test_who_comes_is_seen_and_who_goes_is_gone(fleet: Fleet) -> None:
    rows = fleet.rows()
    one = fleet.bridge(LEFT, "arm")
    fleet.bridge(UR, "arm", "lab2")

    def there(name: str) -> bool:
        known = rows.robots.get(name)
        return known is not None and known.state == "connected" and known.row is not None and math.isfinite(known.rate)

    for name, wanted in (("lab1/arm", LEFT), ("lab2/arm", UR)):
        hear_fleet(rows, lambda name=name: there(name))
        seen = rows.robots[name]
        assert seen.robot is not None
        assert (seen.robot.name, seen.robot.n) == (name, wanted.n)
        np.testing.assert_array_equal(seen.value("q"), wanted.q_home)
        assert (seen.damaged, seen.restarts, seen.missed) == (0, 0, 0)
        assert abs(seen.age) < 60.0
        assert seen.rate > 0.0
    one.close()
    hear_fleet(rows, lambda: rows.robots["lab1/arm"].state == "gone")
    assert rows.robots["lab2/arm"].is_alive
    fleet.bridge(UR, "arm")
    hear_fleet(rows, lambda: there("lab1/arm"))
    again = rows.robots["lab1/arm"]
    assert again.restarts == 1
    assert again.robot is not None
    assert again.robot.n == UR.n


def test_one_lab_alone_and_damaged_rows(fleet: Fleet) -> None:
    rows = fleet.rows("lab2")
    fleet.bridge(LEFT)
    fleet.bridge(UR, lab="lab2")
    hear_fleet(rows, lambda: "lab2/ur5e" in rows.robots and rows.robots["lab2/ur5e"].rows > 3)
    assert list(rows.robots) == ["lab2/ur5e"]
    seen = rows.robots["lab2/ur5e"]
    hear_fleet(rows, lambda: seen.damaged > 1, lambda: fleet.put("armlab/lab2/ur5e/view", b"ALR1 and no sum"))
    hear_fleet(rows, lambda: seen.state == "connected")


WRONG = [
    b'{"kind": "status", "arms": {"arm": {"rate": 1.0, "missed": Infinity}}}',
    b'{"kind": "status", "arms": {"arm": {"rate": 1%s, "missed": 0}}}' % (b"0" * 400),
    b"[" * 200_000,
    b"5",
]


def test_texts_that_are_none_end_nothing(fleet: Fleet) -> None:
    rows = fleet.rows()
    fleet.bridge(LEFT, "arm")
    hear_fleet(rows, lambda: "lab1/arm" in rows.robots and math.isfinite(rows.robots["lab1/arm"].rate))
    seen = rows.robots["lab1/arm"]
    send = lambda: [fleet.put("armlab/lab1/arm/status", x) for x in WRONG]  # noqa: E731
    hear_fleet(rows, lambda: seen.refused >= len(WRONG), send)
    assert math.isfinite(seen.rate)
    before = seen.rows
    hear_fleet(rows, lambda: seen.rows > before)


@pytest.mark.parametrize("about", [b"", b"[]", b"[1]", b'[{"schema": "{}"}]', b'[{"schema": 1}]', b"\xff"])
def test_a_description_that_is_none_is_asked_again(about: bytes) -> None:
    seen = SeenRobot("lab1/ur5e")
    seen.live(True)
    seen.describe(about)
    seen.status(about)
    assert (seen.wants, seen.robot, seen.missed, seen.row, seen.refused) == (True, None, 0, None, 2)


def test_a_silent_robot_and_rows_of_another_schema() -> None:
    schema, seen = RowSchema.of([UR]), SeenRobot("lab1/ur5e")
    seen.live(True)
    seen.describe(json.dumps([{"run": "a", "schema": schema.text.decode(), "robots": {"ur5e": to_toml(UR)}}]).encode())
    assert (seen.state, seen.value("q"), seen.wants) == ("silent", None, False)
    seen.take(b"ALR1    " + schema.id)  # too short
    assert seen.state == "connected"
    assert seen.row is None
    seen.listened(1.9)
    assert seen.state == "connected"
    seen.listened(0.2)
    assert seen.state == "silent"
    seen.take(bytes(schema.size))
    assert seen.wants


def test_a_viewer_that_was_not_run_takes_no_robot_for_silent(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time without listening says nothing about a robot; two seconds of listening do."""
    rows = fleet.rows()
    bridge = fleet.bridge(LEFT)
    hear_fleet(rows, lambda: "lab1/yumi_left" in rows.robots and rows.robots["lab1/yumi_left"].state == "connected")
    seen, looks = rows.robots["lab1/yumi_left"], 0
    monkeypatch.setattr(rows, "_put", lambda *words: None)  # received rows are ignored
    for _ in range(3):
        rows._looked -= 60.0
        rows.hear(0.0)
        assert seen.state == "connected"
    while seen.state == "connected":
        rows._looked -= 60.0
        rows.hear(0.0)
        looks += 1
    assert looks > 10
    bridge.close()


@pytest.mark.slow
def test_each_robot_stands_at_its_place_in_the_pose_of_its_rows(server: Any, fleet: Fleet, page: Any) -> None:
    rows = fleet.rows()
    looks = page(server.get_port())
    view = FleetView(server, rows)
    arms = {"lab1/a": fleet.bridge(UR, "a"), "lab1/b": fleet.bridge(LEFT, "b")}

    def drawn(name: str) -> bool:
        known = rows.robots.get(name)
        return name in view._drawn and known is not None and np.array_equal(known.value("q"), arms[name].q)

    for turn in (0.0, 0.2):
        for one in arms.values():
            one.q = one.robot.q_home + turn
        hear_fleet(rows, lambda: all(drawn(name) for name in arms), view.draw)
        for name, one in arms.items():
            np.testing.assert_allclose(tool(server, name, one.robot.n), forward(one.robot, one.q), atol=1e-9)
    apart = pose(node(server, "/lab1/a")) - pose(node(server, "/lab1/b"))
    hear_fleet(rows, lambda: len(server.get_clients()) == 1, view.draw)  # the page of another test may still close
    (camera,) = (one.camera for one in server.get_clients().values())
    np.testing.assert_allclose(camera.position, server.initial_camera.position)
    looks.close()
    assert np.linalg.norm(apart) > 1.5  # two arms of 0.9 m and 0.6 m do not reach each other

    gone = arms.pop("lab1/a")
    gone.close()
    hear_fleet(rows, lambda: node(server, "/lab1/a/label").text == "lab1/a: gone", view.draw)
    assert not node(server, "/lab1/a/arm").visible
    hear_fleet(rows, lambda: "1 of 2 robots" in view._state._html.content, view.draw)
    hear_fleet(rows, lambda: node(server, "/lab1/b/arm").visible, view.draw)
    assert "<td" in view._table._html.content
    hear_fleet(rows, lambda: node(server, "/lab1/b/label").text == "lab1/b", view.draw)

    arms["lab1/a"] = fleet.bridge(LEFT, "a")  # returns as another arm
    arms["lab1/c"] = fleet.bridge(UR, "c")
    hear_fleet(rows, lambda: all(drawn(name) for name in arms) and rows.robots["lab1/a"].restarts == 1, view.draw)
    hear_fleet(rows, lambda: node(server, "/lab1/a/arm").visible, view.draw)
    assert node(server, link("lab1/a", 7))
    hear_fleet(rows, lambda: "3 of 3 robots" in view._state._html.content, view.draw)


def test_names_are_no_markup(server: Any, fleet: Fleet) -> None:
    rows = fleet.rows()
    view = FleetView(server, rows)
    hear_fleet(rows, lambda: rows.robots, lambda: fleet.put("armlab/lab1/<b>x<b>/view", b""))
    view.draw()
    assert "lab1/&lt;b&gt;x" in view._table._html.content


def test_it_tells_who_comes_and_who_goes(fleet: Fleet) -> None:
    told: list[str] = []
    one = fleet.bridge(UR)

    def over() -> bool:
        fleet.put("armlab/lab1/strange/status", b"5")
        if "lab1/ur5e is connected" in told:
            one.close()
        return {"lab1/ur5e is gone", "lab1/strange sent an invalid description"} <= set(told)

    watch_fleet(LabAddress(port=fleet.port, lab=EVERY), port=0, opened=told.append, tell=told.append, over=over)
    assert told[0].startswith("http://127.0.0.1:")
    assert told.count("lab1/strange sent an invalid description") == 1


def test_without_a_router_nothing_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr("armlab.live.fleet_view.FleetRows", partial(FleetRows, patience=0.1))
    with pytest.raises(LinkError, match="Expected a Zenoh router"):
        watch_fleet(LabAddress(port=1), opened=told.append)
    assert not told
