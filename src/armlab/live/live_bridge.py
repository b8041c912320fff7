"""View of a running bridge through its local feed or Zenoh, with reconnection after a restart."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from armlab.bridge.servers.row import Row
from armlab.bridge.servers.status import Watch
from armlab.bridge.servers.zenoh.feed import ZenohFeed
from armlab.bridge.servers.zenoh.session import LabAddress
from armlab.contact import Estimator
from armlab.errors import LinkError, ModelMismatchError, UnknownName
from armlab.kinematics import forward
from armlab.live.curves import ArmPanel, Lines, RingBuffer, Window
from armlab.live.scene import RobotScene, arrow_slider
from armlab.live.server import address, start, stop
from armlab.models import TorqueModel
from armlab.robots import Robot, from_toml
from armlab.robots.comparison import check_same
from armlab.state import State

if TYPE_CHECKING:
    from viser import ViserServer

_AGAIN = 0.5  # s between searches for a bridge
_MOST = 5000  # messages processed at once: ten seconds of rows from two arms at full rate
_PATIENCE = 2.0  # s, timeout for a bridge over Zenoh
_ESTIMATE_GAP = 1.0  # s without a packet, after which an estimate restarts


class Force(NamedTuple):
    """Wrench (6,) exerted by the environment, in base axes at the tool [N, N m], with covariance if known."""

    wrench: np.ndarray
    covariance: np.ndarray | None
    origin: str


class Running:
    """Newest row of a running bridge, local or over Zenoh. If models are given, forces are estimated from every row.

    `described`: robot descriptions with meshes, which bridges do not send.
    """

    watch: Watch
    state: str

    def __init__(
        self,
        robot: str | None = None,
        cell: str = "",
        *,
        zenoh: str = "",
        rate: float = 30.0,
        models: Sequence[TorqueModel] = (),
        described: Sequence[Robot] = (),
    ) -> None:
        if zenoh:
            LabAddress.read(zenoh)
        self._robot, self._cell, self._zenoh, self._models = robot, cell, zenoh, tuple(models)
        self._described = {one.name: one for one in described}
        self._rate = None if models else rate
        self._feed: LocalFeed | ZenohFeed | None = None
        self._due = 0.0
        self._estimates: dict[str, _Estimate] = {}
        self.robots: Mapping[str, Robot] = {}
        self.row: Row | None = None
        self.watch = Watch(robot)
        where = f"at {zenoh}" if zenoh else "of this user"
        self.state = f"Waiting for a bridge {where}; start it with armlab bridge --config CELL."

    def close(self) -> None:
        if self._feed is not None:
            self._feed.close()
        self._feed = None

    def hear(self, seconds: float) -> bool:
        """Wait for a message, process all queued messages, and return whether a row was received."""
        if self._feed is None:
            self._look(seconds)
        before = self.row
        try:
            for _ in range(_MOST):
                if self._feed is None or not self._feed.wait(seconds):
                    break
                self._take(self._feed.receive())
                seconds = 0.0
        except LinkError:
            self.close()
            self._due = time.monotonic() + _AGAIN
            self.state = f"The bridge of {self._cell} has ended. Waiting for the bridge to start again."
        return self.row is not before

    def _look(self, seconds: float) -> None:
        """Search for the bridge if a search is due; otherwise wait."""
        pause = self._due - time.monotonic()
        if pause > 0.0:
            time.sleep(min(pause, seconds))
            return
        self._due = time.monotonic() + _AGAIN
        try:
            self._feed = ZenohFeed(self._zenoh, self._robot or "", _PATIENCE) if self._zenoh else LocalFeed(self._cell)
            self._feed.ask(Subscribe(rate=self._rate))
        except LinkError:
            self.close()
            return
        self._cell, self.state = self._feed.cell, f"Cell {self._feed.cell}"
        self.row, self.watch = None, Watch(self._robot)

    def _take(self, message: Row | dict[str, Any]) -> None:
        self.watch.take(message)
        if not isinstance(message, dict):
            self.row = message
            for estimate in self._estimates.values():
                estimate.take(message)
        elif message["kind"] == "about":
            self._meet(message["robots"])

    def _meet(self, descriptions: Mapping[str, str]) -> None:
        found = {name: from_toml(text, f"the bridge of {self._cell}") for name, text in descriptions.items()}
        if self._robot is not None and self._robot not in found:
            raise UnknownName.among("robot of this cell", self._robot, found)
        for name, robot in self._described.items():
            if name not in found:
                raise UnknownName.among("robot of this cell", name, found)
            advice = "Pass the bridge's description, or omit --robot."
            check_same(robot, f"the bridge of {self._cell}", name, found[name].hash, found[name], advice)
        found |= self._described
        shown = {name: robot for name, robot in found.items() if self._robot in (None, name)}
        self._estimates = _estimates(self._models, shown)
        if shown != self.robots:  # otherwise, the scene is kept
            self.robots = shown

    def value(self, arm: str, name: str) -> Any:
        if self.row is None:
            raise LinkError("Expected a row from the bridge, got none yet. Call hear first.")
        return self.row.values[f"{arm}.{name}"]

    def force(self, arm: str) -> Force | None:
        """Return the force on an arm: from its controller's estimate, else from a model, else from the sensor."""
        recorded = self.value(arm, "wrench_hat")
        if np.isfinite(recorded).all():
            return Force(recorded, self.value(arm, "wrench_hat_cov"), "estimate of the controller")
        if arm in self._estimates:
            return self._estimates[arm].force
        measured = self.value(arm, "wrench")
        return Force(measured, None, "force sensor") if np.isfinite(measured).all() else None


class _Estimate:
    """Force estimate of an arm from a torque model, updated by each packet."""

    def __init__(self, model: TorqueModel, robot: Robot) -> None:
        self._name, self._estimator = robot.name, Estimator(model, robot)
        self._t, self._session = math.nan, -1
        self.force: Force | None = None

    def take(self, row: Row) -> None:
        t, dt, session, fresh, q, qd, tau = (
            row.values[f"{self._name}.{what}"] for what in ("session_t", "dt", "session", "fresh", "q", "qd", "tau")
        )
        if not fresh:
            return
        if session != self._session:
            self._estimator.reset()
        elif t > self._t:
            dt = t - self._t  # because intermediate rows may have been dropped
            if dt > _ESTIMATE_GAP:
                self._estimator.reset()
        self._t, self._session = t, session
        found = self._estimator.step(State(t, dt, q, qd, tau, robot=self._name))
        self.force = Force(found.wrench, found.cov, "estimate from the model")


def _estimates(models: Sequence[TorqueModel], arms: Mapping[str, Robot]) -> dict[str, _Estimate]:
    found = {}
    for model in models:
        if model.robot_name not in arms:
            raise ModelMismatchError(
                f"Expected a model of {' or '.join(arms)}, got a model "
                f"of {model.robot_name!r}. Pass a model for this arm."
            )
        found[model.robot_name] = _Estimate(model, arms[model.robot_name])
    return found


_FRAME = 1.0 / 30.0  # s
_WORDS = 0.25  # s between updates of the text
_TRACE = 0.1  # s between updates of the tool path
_PATH = 10.0  # s, length of the tool path shown
_GAP = 0.5  # s without rows, after which curves and paths are interrupted


def watch(
    robot: str | None = None,
    *,
    cell: str = "",
    zenoh: str = "",
    models: Sequence[TorqueModel] = (),
    described: Sequence[Robot] = (),
    meshes: Sequence[Path] = (),
    port: int | None = None,
    opened: Callable[[str], None] = lambda url: None,
    tell: Callable[[str], None] = lambda sentence: None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Show a bridge in the browser, even before it starts and after it ends, until `over` is true or Ctrl-C is pressed.

    The descriptions in `described` add meshes, whose files are searched for in the folders `meshes`.
    """
    server = start(port)
    running = Running(robot, cell, zenoh=zenoh, rate=1.0 / _FRAME, models=models, described=described)
    try:
        opened(address(server))
        view, said = RunningView(server, running, meshes), ""
        while not over():
            began = time.monotonic()
            running.hear(_WORDS)
            if running.state != said:
                said = running.state
                tell(said)
            if server.get_clients():
                view.draw()
            else:
                view.take()  # so a new viewer receives the stored curves
            time.sleep(max(began + _FRAME - time.monotonic(), 0.0))
    finally:
        running.close()
        stop(server)


class RunningView:
    """Scene and panel of a running bridge, drawn frame by frame."""

    def __init__(self, server: ViserServer, running: Running, meshes: Sequence[Path] = ()) -> None:
        self._server, self._running, self._meshes = server, running, meshes
        self._robots: Mapping[str, Robot] | None = None
        self._row: Row | None = None
        self._drawn: Row | None = None
        self._due = self._start = self._stamp = 0.0
        self._parts: list[Any] = []
        self._build()

    def take(self) -> None:
        """Store the newest row for curves and paths."""
        running = self._running
        if running.robots is not self._robots:
            self._build()
        if running.row is not None and running.row is not self._row:
            t, follows = self._time(running.row)
            self._row = running.row
            for arm in self._arms.values():
                arm.take(running, t, follows)

    def draw(self) -> None:
        """Draw the newest row, and update the text four times per second."""
        self.take()
        with self._server.atomic():
            if self._row is not self._drawn:
                self._drawn = self._row
                for arm in self._arms.values():
                    arm.draw()
            if time.monotonic() >= self._due:
                self._due = time.monotonic() + _WORDS
                self._say()

    def _build(self) -> None:
        """Create the scene and panel for the arms of this bridge, replacing the previous ones."""
        running, server = self._running, self._server
        for part in self._parts:
            part.remove()
        server.scene.reset()
        self._robots, self._row, self._drawn = running.robots, None, None
        self._arms: dict[str, _ArmView] = {}
        self._state = Lines(server.gui)
        self._parts = [self._state]
        if running.robots:
            scene = RobotScene(server, running.robots.values(), meshes=self._meshes)
            self._parts += [arrow_slider(server.gui, scene), tabs := server.gui.add_tab_group()]
            for name, robot in running.robots.items():
                with tabs.add_tab(name):
                    self._arms[name] = _ArmView(scene, ArmPanel(server.gui, robot), robot)
        self._notes = Lines(server.gui)
        self._parts.append(self._notes)

    def _time(self, row: Row) -> tuple[float, bool]:
        """Return the time of a row since the first row [s], and whether it follows the last row without a gap.

        The time is robot time, which differs from wall time in lockstep. Gaps are measured on the monotonic clock. If
        the clock is set back, the displayed time restarts at zero.
        """
        last, stamp = self._row, 1e-9 * row.wall_ns
        if last is None or stamp < self._stamp - _GAP:
            self._start = stamp
        elif stamp < self._stamp:  # in lockstep, each arm has its own clock
            stamp = self._stamp
        self._stamp = stamp
        return stamp - self._start, last is not None and row.mono_ns - last.mono_ns < 1e9 * _GAP

    def _say(self) -> None:
        watch = self._running.watch
        self._state.show(self._running.state)
        for words in watch.arms(time.time_ns()):
            self._arms[words.pop("arm")].say(words)
        self._notes.show("\n".join(watch.notes() if self._arms else []))


class _ArmView:
    """Scene and panel of an arm."""

    def __init__(self, scene: RobotScene, panel: ArmPanel, robot: Robot) -> None:
        self._scene, self._panel, self._robot = scene, panel, robot
        self._torque, self._force, self._moment = (Window(one) for one in (panel.torque, panel.force, panel.moment))
        self._path = RingBuffer(3, _PATH)
        self._t, self._traced, self._origin = -np.inf, -np.inf, "-"
        self._picture: tuple[np.ndarray, np.ndarray | None, np.ndarray | None] | None = None

    def take(self, running: Running, t: float, follows: bool) -> None:
        """Store the newest row with its time t [s]; `follows`: True if no gap separates it from the last row."""
        name = self._robot.name
        q, tau, force = running.value(name, "q"), running.value(name, "tau"), running.force(name)
        if running.value(name, "age") > _GAP:  # outdated values of an arm that is silent while another arm sends
            tau, force = np.full_like(tau, np.nan), None
        wrench, covariance, self._origin = (None, None, "-") if force is None else force
        self._picture = (q, wrench, covariance)
        if t < self._t or not follows:
            self._path.clear()
        if not follows and t > self._t >= 0.0:  # break the curves at missing rows
            self._push(0.5 * (self._t + t), np.full_like(tau, np.nan))
        if t != self._t:
            self._path.add(t, forward(self._robot, q)[:3, 3])
            self._push(t, tau, wrench, covariance)
        self._t = t

    def _push(
        self, t: float, tau: np.ndarray, wrench: np.ndarray | None = None, covariance: np.ndarray | None = None
    ) -> None:
        values = np.full(6, np.nan) if wrench is None else wrench
        half = np.full(6, np.nan) if covariance is None else 2.0 * np.sqrt(np.diag(covariance))
        self._torque.push(t, tau)
        self._force.push(t, values[:3], half[:3])
        self._moment.push(t, values[3:], half[3:])

    def draw(self) -> None:
        """Draw the stored row; curves and the tool path are drawn ten times per second."""
        if self._picture is None:
            return
        self._scene.show(self._robot.name, *self._picture)
        for window in (self._torque, self._force, self._moment):
            window.draw()
        if not self._traced <= self._t < self._traced + _TRACE:
            self._traced = self._t
            self._scene.trace(self._robot.name, self._path.values)

    def say(self, words: dict[str, str]) -> None:
        self._panel.say({**words, "force from": self._origin})
