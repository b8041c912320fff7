"""View of all robots at a Zenoh router: arms side by side in their current postures, and robot states in the panel."""

from __future__ import annotations

import contextlib
import html
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.bridge.servers.row import Row, RowSchema, read_row
from armlab.bridge.servers.zenoh.messages import EVERY, Inbox, key, read_about, read_message, robot_of, undamaged
from armlab.bridge.servers.zenoh.session import Discovery, LabAddress, close_session, zenoh
from armlab.errors import ArmlabError, LinkError
from armlab.live.curves import Lines, Markup
from armlab.live.scene import RobotScene
from armlab.live.server import address, start, stop
from armlab.robots import Robot
from armlab.robots.robot import arm_length

if TYPE_CHECKING:
    from viser import ViserServer

_MOST = 1000  # maximum number of robots
_INBOX = 20_000  # queued messages: ten seconds from fifty robots; the oldest messages are dropped first
_SILENT = 2.0  # s of listening time without a row, after which a robot counts as silent
_LATE = 0.1  # s; a wait that overruns by more does not count as listening time: the process may have been suspended


class SeenRobot:
    """State of a robot; values are None, NaN or 0 until received from its bridge. Not thread-safe."""

    name: str
    wants: bool
    restarts: int
    rows: int
    damaged: int
    refused: int
    missed: int
    rate: float

    def __init__(self, name: str) -> None:
        self.name, self._arm = name, name.rpartition("/")[2]
        self.robot: Robot | None = None
        self.row: Row | None = None
        self.is_alive = self.wants = False
        self.restarts = self.rows = self.damaged = self.refused = self.missed = 0
        self.rate = math.nan
        self._text, self._run = "", ""
        self._schema: RowSchema | None = None
        self._quiet = math.inf  # s of listening since the newest row

    def live(self, is_alive: bool) -> None:
        """Register that the bridge appeared or disappeared; it may have restarted in between."""
        self.is_alive: bool = is_alive
        self.wants = True
        self._quiet = math.inf

    def take(self, data: bytes | None) -> None:
        """Process the bytes of a row, or None for a corrupted row."""
        if data is None:
            self.damaged += 1
        elif self._schema is None or data[8:16] != self._schema.id:
            self.wants = True
        elif not self.wants:
            self.rows, self._quiet = self.rows + 1, 0.0
            with contextlib.suppress(LinkError):
                self.row = read_row(self._schema, data)

    def listened(self, seconds: float) -> None:
        """Add listening time; call this before processing the rows received in that time."""
        self._quiet += seconds

    def describe(self, about: bytes) -> None:
        """Process the description from the bridge; count an invalid description and request it again."""
        try:
            said = read_about(about)
            robot, text = said.robots[self._arm], said.messages[0]["robots"][self._arm]
        except (ArmlabError, KeyError):
            self.refused += 1
            return
        if text != self._text:
            self.robot, self._text = replace(robot, name=self.name), text
        if self._run and said.run != self._run:
            self.restarts += 1
            self.row = None
        self._schema, self._run, self.wants = said.schema, said.run, False

    def status(self, data: bytes) -> None:
        try:
            said = read_message(data)
        except LinkError:
            self.refused += 1
            return
        arm = said.get("arms", {}).get(self._arm)
        if arm is not None:
            self.rate, self.missed = arm.get("rate") or math.nan, arm.get("missed", 0)

    def value(self, name: str) -> Any:
        return None if self.row is None else self.row.values.get(f"{self._arm}.{name}")

    @property
    def age(self) -> float:
        """Age of the newest row [s], computed from the clocks of both computers; NaN without rows."""
        return math.nan if self.row is None else 1e-9 * (time.time_ns() - self.row.wall_ns)

    @property
    def state(self) -> str:
        """State: "connected", "silent" (no row during two seconds of listening), or "gone" (no bridge)."""
        return "gone" if not self.is_alive else "connected" if self._quiet < _SILENT else "silent"


class FleetRows:
    """Newest rows of all robots at a router, keyed by lab/robot, at most thirty per second; includes absent robots."""

    place: LabAddress
    robots: dict[str, SeenRobot]

    def __init__(self, place: LabAddress, patience: float = 5.0) -> None:
        self.place, self.robots = place, dict[str, SeenRobot]()
        self._inbox: Inbox[tuple[str, str, Any]] = Inbox(_INBOX)
        self._looked = time.monotonic()
        self._session = place.open_behind(patience)
        self._asking = Discovery(
            self._session, lambda lab, robot, data: self._put("describe", key(lab, robot, ""), data)
        )
        declare, alive = self._session.declare_subscriber, key(place.lab, EVERY, "alive")
        self._declared = [
            declare(
                key(place.lab, EVERY, "view"), lambda sample: self._put("take", sample.key_expr, undamaged(sample))
            ),
            declare(
                key(place.lab, EVERY, "status"),
                lambda sample: self._put("status", sample.key_expr, sample.payload.to_bytes()),
            ),
            self._session.liveliness().declare_subscriber(alive, self._take_life, history=True),
        ]

    def close(self) -> None:
        close_session(self._session)

    def hear(self, seconds: float) -> None:
        """Wait for a message, and process all queued messages; `SeenRobot.row` is then the newest row."""
        self._inbox.wait(seconds)
        now = time.monotonic()
        listened, self._looked = min(now - self._looked, seconds + _LATE), now
        for robot in self.robots.values():
            robot.listened(listened)
        for _ in range(len(self._inbox)):
            message = self._inbox.get()
            if message is None:
                break
            what, where, data = message
            lab, name = robot_of(where)
            full = f"{lab}/{name}"
            if full not in self.robots and len(self.robots) < _MOST:
                self.robots[full] = SeenRobot(full)
            if full in self.robots:
                getattr(self.robots[full], what)(data)
        for full, robot in self.robots.items():
            if robot.wants and robot.is_alive:
                lab, _, name = full.partition("/")
                self._asking.ask(lab, name)

    def _take_life(self, sample: Any) -> None:
        self._put("live", sample.key_expr, sample.kind == zenoh().SampleKind.PUT)

    def _put(self, what: str, where: Any, data: Any) -> None:
        self._inbox.put((what, str(where), data), len(data) if isinstance(data, bytes) else 0)


_FRAME = 1.0 / 30.0  # s
_WORDS = 0.25  # s between updates of the text
_APART = 2.2  # distance between robots, relative to the length of the longest arm
_HEADINGS = ("robot", "state", "rate [Hz]", "missed", "damaged", "age [s]", "commander")


def watch_fleet(
    place: LabAddress,
    *,
    port: int | None = None,
    opened: Callable[[str], None] = lambda url: None,
    tell: Callable[[str], None] = lambda sentence: None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Show all robots at a router in the browser until `over` is true or Ctrl-C is pressed; report state changes."""
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
                        tell(f"{name} sent an invalid description")
                if server.get_clients():
                    view.draw()
                time.sleep(max(began + _FRAME - time.monotonic(), 0.0))
        finally:
            stop(server)
    finally:
        rows.close()


class FleetView:
    """Scene and panel of all robots, drawn frame by frame. For a silent or absent robot, only the name is shown."""

    def __init__(self, server: ViserServer, rows: FleetRows) -> None:
        self._server, self._rows = server, rows
        self._scene: RobotScene | None = None
        self._labels: dict[str, Any] = {}
        self._drawn: dict[str, Robot] = {}
        self._shown: dict[str, Row | None] = {}
        self._due = 0.0
        server.scene.reset()
        self._state, self._table = Lines(server.gui), Markup(server.gui)

    def draw(self) -> None:
        """Draw the newest rows, and update the text four times per second."""
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
        """Add a robot, or redraw it after a change of its description."""
        if (robot := one.robot) is None:
            return
        if self._scene is None:
            self._scene = RobotScene(self._server, [robot])
        else:
            self._scene.add(robot)
        self._drawn[one.name] = robot
        above = tuple(robot.T_base_mount[:3, 3] + [0.0, 0.0, 0.9 * arm_length(robot)])
        self._labels[one.name] = self._server.scene.add_label(
            f"/{robot.name}/label", robot.name, position=above, anchor="bottom-center"
        )

    def _arrange(self) -> None:
        """Arrange all robots in a grid by name, with the camera in front."""
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
        q, row = one.value("q"), one.row if one.state == "connected" else None
        if self._scene is None or q is None or (row is not None and row is self._shown.get(one.name)):
            return
        self._shown[one.name] = row
        self._scene.show(one.name, np.full_like(q, np.nan) if row is None else q)

    def _say(self) -> None:
        robots = self._rows.robots
        count = sum(one.state == "connected" for one in robots.values())
        place = self._rows.place
        self._state.show(f"{count} of {len(robots)} robots at {place.host}:{place.port} are connected")
        cell = "padding:0 0.4em 0 0;text-align:left;font-weight:normal"
        lines = ["".join(f"<th style='{cell};opacity:0.65'>{word}</th>" for word in _HEADINGS)]
        for name in sorted(robots):
            words = _words(robots[name])
            lines.append("".join(f"<td style='{cell}'>{html.escape(word)}</td>" for word in words))
            if name in self._labels:
                _, state, *_ = words
                self._labels[name].text = name if state == "connected" else f"{name}: {state}"
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        self._table.show(f"<table style='font-size:0.75em;line-height:1.4;margin:0 1em'>{body}</table>")


def _words(one: SeenRobot) -> tuple[str, ...]:
    """Return the table row of a robot, with the columns `_HEADINGS`."""
    rate = f"{one.rate:.0f}" if math.isfinite(one.rate) else "-"
    age = f"{one.age:.2f}" if math.isfinite(one.age) else "-"
    counts = (rate, str(one.missed), str(one.damaged), age)
    return (one.name, one.state, *counts, one.value("commander") or "none")
