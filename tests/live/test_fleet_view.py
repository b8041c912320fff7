"""The view of many robots, without a browser: who stands where, what stands over it, what the panel says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.zenoh import EVERY, Place
from armlab.errors import LinkError
from armlab.kinematics import forward
from armlab.lie import quaternion, se3
from armlab.live import FleetView, watch_fleet
from armlab.robots import Robot

from .fleet_bridges import Fleet, hear_fleet

LEFT, UR = robots.load("yumi_left"), robots.load("ur5e")


def handle(server: Any, name: str) -> Any:
    return server.scene._handle_from_node_name[name]


def tool(server: Any, name: str, robot: Robot) -> np.ndarray:
    """Where the scene has the tool of an arm, in the world."""
    path, found = f"/{name}", np.eye(4)
    for part in ("", "/arm", *(f"/link_{i + 1}" for i in range(robot.n)), "/tool"):
        path += part
        found = found @ se3.from_rp(quaternion.to_matrix(handle(server, path).wxyz), handle(server, path).position)
    return found


def test_each_robot_stands_at_its_place_in_the_pose_of_its_rows(server: Any, fleet: Fleet) -> None:
    rows = fleet.rows()
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
            root = handle(server, f"/{name}")
            T = se3.from_rp(quaternion.to_matrix(root.wxyz), root.position)
            np.testing.assert_allclose(tool(server, name, one.robot), T @ forward(one.robot, one.q), atol=1e-9)
    apart = np.linalg.norm(np.subtract(handle(server, "/lab1/a").position, handle(server, "/lab1/b").position))
    assert apart > 1.5  # two arms of 0.9 m and 0.6 m do not reach each other

    gone = arms.pop("lab1/a")
    gone.close()
    hear_fleet(rows, lambda: handle(server, "/lab1/a/label").text == "lab1/a: gone", view.draw)
    assert not handle(server, "/lab1/a/arm").visible
    hear_fleet(rows, lambda: "1 of 2 robots" in view._state._html.content, view.draw)
    hear_fleet(rows, lambda: handle(server, "/lab1/b/arm").visible, view.draw)
    assert "<td" in view._table._html.content
    hear_fleet(rows, lambda: handle(server, "/lab1/b/label").text == "lab1/b", view.draw)

    arms["lab1/a"] = fleet.bridge(LEFT, "a")  # comes again as another arm
    arms["lab1/c"] = fleet.bridge(UR, "c")
    hear_fleet(rows, lambda: all(drawn(name) for name in arms) and rows.robots["lab1/a"].restarts == 1, view.draw)
    hear_fleet(rows, lambda: handle(server, "/lab1/a/arm").visible, view.draw)
    assert "/lab1/a/arm/link_1/link_2/link_3/link_4/link_5/link_6/link_7" in server.scene._handle_from_node_name
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
        if "lab1/ur5e is there" in told:
            one.close()
        return {"lab1/ur5e is gone", "lab1/strange says what cannot be understood"} <= set(told)

    watch_fleet(Place(port=fleet.port, lab=EVERY), port=0, opened=told.append, tell=told.append, over=over)
    assert told[0].startswith("http://127.0.0.1:")
    assert told.count("lab1/strange says what cannot be understood") == 1


def test_without_a_router_nothing_is_opened() -> None:
    told: list[str] = []
    with pytest.raises(LinkError, match="Expected a Zenoh router"):
        watch_fleet(Place(port=1), opened=told.append)
    assert not told
