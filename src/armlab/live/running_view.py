"""The view of a bridge that runs: each frame shows the newest row, the panel what there is to say of the arms."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.kinematics import forward
from armlab.live.curves import Window
from armlab.live.panel import ArmPanel, Lines
from armlab.live.recent import Recent
from armlab.live.running import Running
from armlab.live.scene import Scene
from armlab.live.server import address, start, stop
from armlab.models import TorqueModel
from armlab.robots import Robot

if TYPE_CHECKING:
    from viser import ViserServer

    from armlab.bridge.servers.row import Row

__all__ = ["RunningView", "watch"]

_FRAME = 1.0 / 30.0  # s
_WORDS = 0.25  # s between two looks at what there is to say
_TRACE = 0.1  # s between two pictures of the path of a tool
_PATH = 10.0  # s of it
_GAP = 0.5  # s without news that curves and paths do not bridge


def watch(
    robot: str | None = None,
    *,
    cell: str = "",
    zenoh: str = "",
    models: Sequence[TorqueModel] = (),
    port: int | None = None,
    opened: Callable[[str], None] = lambda url: None,
    tell: Callable[[str], None] = lambda sentence: None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Show a bridge that runs in the browser, until `over` or an interrupt: before it starts, and after its end.

    The bridge notices nothing of it: rows come from its local feed or over Zenoh, and nothing is sent back.

    Parameters
    ----------
    robot : this arm only; None for all.
    cell : name of the cell; "" when only one runs.
    zenoh : where a bridge elsewhere is, see `bridge.zenoh.Place.read`; "" for one of this user.
    models : torque models for a bridge that sends no estimate of the force.
    port : of the view on this computer; from 8080 on the first that is free when None.
    opened : told the address to open. tell : told what becomes of the connection.
    over : whether to end; asked at each frame.

    Raises
    ------
    MissingExtra : viser is not installed. ConfigError : a wrong port, or several bridges run and no cell was named.
    LinkError : the port is taken. UnknownName : the arm is not in the cell. ModelMismatchError : a model is of no arm.
    """
    server = start(port)
    running = Running(robot, cell, zenoh=zenoh, rate=1.0 / _FRAME, models=models)
    try:
        opened(address(server))
        view, said = RunningView(server, running), ""
        while not over():
            began = time.monotonic()
            running.hear(_WORDS)
            if running.state != said:
                said = running.state
                tell(said)
            if server.get_clients():
                view.draw()
            else:  # nobody looks: who comes is shown all that was kept
                view.take()
            time.sleep(max(began + _FRAME - time.monotonic(), 0.0))
    finally:
        running.close()
        stop(server)


class RunningView:
    """Scene and panel of a bridge that runs, drawn frame by frame.

    Parameters
    ----------
    server : of `start`. running : the bridge; somebody else lets it hear.
    """

    def __init__(self, server: ViserServer, running: Running) -> None:
        self._server, self._running = server, running
        self._robots: Mapping[str, Robot] | None = None
        self._row: Row | None = None
        self._drawn: Row | None = None
        self._due = self._start = self._stamp = 0.0
        self._parts: list[Any] = []
        self._build()

    def take(self) -> None:
        """Keep the newest row for curves and paths."""
        running = self._running
        if running.robots is not self._robots:
            self._build()
        if running.row is not None and running.row is not self._row:
            t, follows = self._time(running.row)
            self._row = running.row
            for arm in self._arms.values():
                arm.take(running, t, follows)

    def draw(self) -> None:
        """Show the newest row, and four times a second what there is to say."""
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
        """Make scene and panel for the arms of this bridge, in place of those of the last one."""
        running, server = self._running, self._server
        for part in self._parts:
            part.remove()
        server.scene.reset()
        self._robots, self._row, self._drawn = running.robots, None, None
        self._arms: dict[str, _Arm] = {}
        self._state = Lines(server.gui)
        self._parts = [self._state]
        if running.robots:
            scene = Scene(server, running.robots.values())
            self._parts += [_arrow(server.gui, scene), tabs := server.gui.add_tab_group()]
            for name, robot in running.robots.items():
                with tabs.add_tab(name):
                    self._arms[name] = _Arm(scene, ArmPanel(server.gui, robot), robot)
        self._notes = Lines(server.gui)
        self._parts.append(self._notes)

    def _time(self, row: Row) -> tuple[float, bool]:
        """Return the time of a row since the first [s], and whether it follows the last; a clock set back begins anew.

        The time is that of the robot, which in lockstep is not that of the wall; a gap is one for who looks.
        """
        last, stamp = self._row, 1e-9 * row.wall_ns
        if last is None or stamp < self._stamp - _GAP:
            self._start = stamp
        elif stamp < self._stamp:  # in lockstep, each arm has a clock of its own
            stamp = self._stamp
        self._stamp = stamp
        return stamp - self._start, last is not None and row.mono_ns - last.mono_ns < 1e9 * _GAP

    def _say(self) -> None:
        watch = self._running.watch
        self._state.show(self._running.state)
        for words in watch.arms(time.time_ns()):
            self._arms[words.pop("arm")].say(words)
        self._notes.show("\n".join(watch.notes() if self._arms else []))


class _Arm:
    """What is shown of one arm."""

    def __init__(self, scene: Scene, panel: ArmPanel, robot: Robot) -> None:
        self._scene, self._panel, self._robot = scene, panel, robot
        self._torque, self._force, self._moment = (Window(one) for one in (panel.torque, panel.force, panel.moment))
        self._path = Recent(3, _PATH)
        self._t, self._traced, self._origin = -np.inf, -np.inf, "-"
        self._picture: tuple[np.ndarray, np.ndarray | None, np.ndarray | None] | None = None

    def take(self, running: Running, t: float, follows: bool) -> None:
        """Keep the newest row, which may follow the last or come after a gap; its time [s]."""
        name = self._robot.name
        q, tau, force = running.value(name, "q"), running.value(name, "tau"), running.force(name)
        if running.value(name, "age") > _GAP:  # it is silent while another arm sends: its last values are no news
            tau, force = np.full_like(tau, np.nan), None
        wrench, covariance, self._origin = (None, None, "-") if force is None else force
        self._picture = (q, wrench, covariance)
        if t < self._t or not follows:
            self._path.clear()
        if not follows and t > self._t >= 0.0:  # what is missing between interrupts the curves
            self._push(0.5 * (self._t + t), np.full_like(tau, np.nan))
        if t != self._t:
            self._path.add(t, forward(self._robot, q)[:3, 3])
            self._push(t, tau, wrench, covariance)
        self._t = t

    def _push(
        self, t: float, tau: np.ndarray, wrench: np.ndarray | None = None, covariance: np.ndarray | None = None
    ) -> None:
        """Add a sample to the curves."""
        unknown = np.full(6, np.nan)
        values = unknown if wrench is None else wrench
        half = unknown if covariance is None else 2.0 * np.sqrt(np.diag(covariance))
        self._torque.push(t, tau)
        self._force.push(t, values[:3], half[:3])
        self._moment.push(t, values[3:], half[3:])

    def draw(self) -> None:
        """Show what was taken last; curves and path of the tool ten times a second."""
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


def _arrow(gui: Any, scene: Scene) -> Any:
    """Return the slider for the length of a force."""
    slider = gui.add_slider("force [mm/N]", 1.0, 50.0, 1.0, 1e3 * scene.arrow)

    @slider.on_update
    def _(_: Any) -> None:
        scene.arrow = 1e-3 * float(slider.value)

    return slider
