"""The view of all robots at a Zenoh router: side by side, each under its name, and how they do in the panel."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from armlab.bridge.servers.zenoh import Place
from armlab.live.fleet_rows import FleetRows, SeenRobot
from armlab.live.panel import Lines, Markup
from armlab.live.scene import Scene
from armlab.live.server import address, start, stop
from armlab.robots import Robot
from armlab.robots.outline import arm_length

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["FleetView", "watch_fleet"]

_FRAME = 1.0 / 30.0  # s
_WORDS = 0.25  # s between two looks at what there is to say
_APART = 2.2  # between two robots, over the length of the longest arm
_HEADINGS = ("robot", "state", "rate [Hz]", "missed", "damaged", "age [s]", "commander")


def watch_fleet(
    place: Place,
    *,
    port: int | None = None,
    opened: Callable[[str], None] = lambda url: None,
    tell: Callable[[str], None] = lambda sentence: None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Show all robots at a router in the browser, until `over` or an interrupt: those that come, too, and who goes.

    Parameters
    ----------
    place : of the router; its `lab` may be `bridge.zenoh.EVERY`.
    port : of the view on this computer; from 8080 on the first that is free when None.
    opened : told the address to open. tell : told who comes and goes, and once who says what cannot be understood.
    over : whether to end; asked at each frame.

    Raises
    ------
    MissingExtra : viser or Zenoh is not installed. ConfigError : a wrong port. LinkError : no router, or the port is
        taken.
    """
    rows = FleetRows(place)
    try:
        server = start(port)
        try:
            opened(address(server))
            view, states, strange = FleetView(server, rows), dict[str, str](), set[str]()
            while not over():
                began = time.monotonic()
                rows.hear(_WORDS)
                for name, robot in rows.robots.items():
                    if states.get(name) != robot.state and (robot.rows or robot.state == "gone"):
                        states[name] = robot.state
                        tell(f"{name} is {robot.state}")
                    if robot.refused and name not in strange:
                        strange.add(name)
                        tell(f"{name} says what cannot be understood")
                if server.get_clients():
                    view.draw()
                time.sleep(max(began + _FRAME - time.monotonic(), 0.0))
        finally:
            stop(server)
    finally:
        rows.close()


class FleetView:
    """Scene and panel of all robots, drawn frame by frame.

    A robot whose bridge has gone, or that is silent, is not drawn: its place and its name stay, and say so.

    Parameters
    ----------
    server : of `start`. rows : the robots; somebody else lets them hear.
    """

    def __init__(self, server: ViserServer, rows: FleetRows) -> None:
        self._server, self._rows = server, rows
        self._scene: Scene | None = None
        self._labels: dict[str, _Label] = {}
        self._drawn: dict[str, Robot] = {}
        self._due = 0.0
        server.scene.reset()
        self._state, self._table = Lines(server.gui), Markup(server.gui)

    def draw(self) -> None:
        """Show the newest rows, and four times a second what there is to say."""
        robots = self._rows.robots
        with self._server.atomic():
            came = [one for name, one in robots.items() if one.robot is not self._drawn.get(name)]
            for one in came:
                self._add(one)
            if came:
                self._arrange()
            for name in self._drawn:
                self._show(robots[name])
            if time.monotonic() >= self._due or came:
                self._due = time.monotonic() + _WORDS
                self._say()

    def _add(self, one: SeenRobot) -> None:
        """Add a robot, or draw it anew after it was described in another way."""
        robot = one.robot
        if robot is None:
            return
        if self._scene is None:
            self._scene = Scene(self._server, [robot])
        else:
            self._scene.add(robot)
        self._drawn[one.name] = robot
        self._labels[one.name] = _Label(self._server, robot)

    def _arrange(self) -> None:
        """Put all robots in a grid by their names, and who looks before it."""
        if self._scene is None:
            return
        apart = _APART * max(arm_length(robot) for robot in self._drawn.values())
        columns = math.ceil(math.sqrt(len(self._drawn)))
        poses = {}
        for k, name in enumerate(sorted(self._drawn)):
            poses[name] = np.eye(4)
            poses[name][:2, 3] = -apart * (k // columns), apart * (k % columns)
        self._scene.arrange(poses)
        camera = self._server.initial_camera
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = camera.position, camera.look_at

    def _show(self, one: SeenRobot) -> None:
        is_there = one.state == "there"
        is_new = one.decode()
        q = one.value("q")
        if self._scene is None or q is None or not (is_new or not is_there):
            return
        self._scene.show(one.name, q if is_there else np.full_like(q, np.nan))

    def _say(self) -> None:
        robots = self._rows.robots
        count = sum(one.state == "there" for one in robots.values())
        place = self._rows.place
        self._state.show(f"{count} of {len(robots)} robots at {place.host}:{place.port} are there")
        cell = "padding:0 0.7em 0 0;text-align:left;font-weight:normal"
        rows = [f"<th style='{cell};opacity:0.65'>{word}</th>" for word in _HEADINGS]
        lines = ["".join(rows)]
        for name in sorted(robots):
            words = _words(robots[name])
            lines.append("".join(f"<td style='{cell}'>{html.escape(word)}</td>" for word in words))
            if name in self._labels:
                self._labels[name].say(*words[:2])
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        self._table.show(f"<table style='font-size:0.75em;line-height:1.4;margin:0 1em'>{body}</table>")


class _Label:
    """What stands over a robot."""

    def __init__(self, server: ViserServer, robot: Robot) -> None:
        above = tuple(robot.T_base_mount[:3, 3] + [0.0, 0.0, 0.9 * arm_length(robot)])
        self._handle = server.scene.add_label(
            f"/{robot.name}/label", robot.name, position=above, anchor="bottom-center"
        )

    def say(self, name: str, state: str) -> None:
        text = name if state == "there" else f"{name}: {state}"
        if text != self._handle.text:
            self._handle.text = text


def _words(one: SeenRobot) -> tuple[str, ...]:
    """Return what there is to say of a robot, under `_HEADINGS`."""
    rate = f"{one.rate:.0f}" if math.isfinite(one.rate) else "-"
    age = f"{one.age:.2f}" if math.isfinite(one.age) else "-"
    counts = (rate, str(one.missed), str(one.damaged), age)
    return (one.name, one.state, *counts, one.value("commander") or "nobody")
