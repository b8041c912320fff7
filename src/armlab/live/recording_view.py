"""View of recordings: the data of each arm, and a player with a time slider."""

from __future__ import annotations

import html
import math
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab import log as logs
from armlab import robots as library
from armlab._display import BLUE, ORANGE
from armlab._numbers import number
from armlab.bridge.servers.status import arm_state
from armlab.errors import LogError, ModelMismatchError, RobotError, ShapeError, UnknownName
from armlab.estimation.fit import Fit, value_of
from armlab.kinematics import forward
from armlab.live.curves import ArmPanel, Curves, envelope
from armlab.live.scene import RobotScene, arrow_slider
from armlab.log.reading import in_order_of
from armlab.log.recording.metadata import check_recorded, described
from armlab.robots import Robot
from armlab.robots.comparison import check_same

if TYPE_CHECKING:
    from viser import ViserServer

    from armlab.log import Table
    from armlab.log.recording.metadata import Event, Inspection
    from armlab.models import TorqueModel

_SILENT = 0.5  # s without packets before an arm counts as silent
_RATE_SPAN, _TRIP_SPAN = 1.0, 10.0  # s, windows for the packet rate and the round-trip times
_CLOCK = "joint_states"  # topic of every recorded arm
_LIMITS = {1: "position", 2: "velocity", 4: "acceleration", 8: "braking", 16: "torque", 32: "torque rate"}


@dataclass(frozen=True, eq=False)
class Recorded:
    """Log of an arm: a table with q (N, n), and the times t (N,) of its rows from the start of the view [s]."""

    robot: Robot
    table: Table
    t: np.ndarray
    events: tuple[tuple[float, str], ...] = ()

    @cached_property
    def tool(self) -> np.ndarray:
        """Path of the tool point (N, 3) in base axes [m]."""
        return forward(self.robot, np.ascontiguousarray(self.table["q"]))[:, :3, 3]

    @cached_property
    def torque(self) -> np.ndarray | None:
        """Measured torques (N, n), or None."""
        return self.table.values.get("tau")

    @cached_property
    def wrench(self) -> np.ndarray | None:
        """Wrench (N, 6) in base axes at the tool point: the estimate, else the sensor reading, else None."""
        name = next((name for name in ("wrench_hat", "wrench") if name in self.table), None)
        return None if name is None else self.table[name]

    @cached_property
    def covariance(self) -> np.ndarray | None:
        """Covariance (N, 6, 6) of the estimated wrench, or None."""
        return self.table["wrench_hat_cov"] if {"wrench_hat", "wrench_hat_cov"} <= set(self.table.names) else None

    @cached_property
    def sigma(self) -> np.ndarray | None:
        """Standard deviations (N, 6) of the wrench, or None."""
        return None if self.covariance is None else np.sqrt(np.einsum("kii->ki", self.covariance))

    def row(self, t: float) -> int:
        """Return the index of the last row at or before time t [s], or 0 if no row is that early."""
        return max(int(np.searchsorted(self.t, t, side="right")) - 1, 0)

    def span(self, t: float, seconds: float) -> slice:
        """Return the rows in the last `seconds` before time t [s], at least one row."""
        last = self.row(t)
        return slice(min(int(np.searchsorted(self.t, t - seconds)), last), last + 1)

    def words(self, t: float) -> dict[str, str]:
        """Return the connection status at time t [s]: state, rate, round-trip times, active limits, lost packets."""
        k = self.row(t)
        times = self.t[self.span(t, _RATE_SPAN)]
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else math.nan
        return {
            "state": self._state(k, t),
            "rate": f"{rate:.1f} Hz" if math.isfinite(rate) else "-",
            "latency": self._latency(self.span(t, _TRIP_SPAN)),
            "clamps": self._clamps(k),
            "drops": " ".join(self._lost(k)) or "-",
        }

    def _state(self, k: int, t: float) -> str:
        age = t - self.t[k]
        if not 0.0 <= age <= _SILENT:
            return "not started" if age < 0.0 else f"no packet for {age:.1f} s"
        if not {"motors", "rapid", "mci"} <= set(self.table.names):
            return "recorded"
        is_answered = "seq_sent" not in self.table or bool(self.table["seq_sent"][k] >= 0)
        asked = [name for name in ("q_ref", "qd_ref", "tau_ref") if name in self.table]
        is_asked = any(np.isfinite(self.table[name][k]).any() for name in asked)
        motors, rapid, mci = (self.table[name][k] for name in ("motors", "rapid", "mci"))
        return arm_state(motors, rapid, mci, is_answered, is_asked)

    def _latency(self, rows: slice) -> str:
        if not {"receive_ns", "send_ns"} <= set(self.table.names):
            return "-"
        trips = 1e-3 * (self.table["send_ns"][rows] - self.table["receive_ns"][rows])
        trips = trips[np.isfinite(trips) & (trips > 0.0)]
        if not len(trips):
            return "-"
        p50, p99 = np.percentile(trips, (50.0, 99.0))
        return f"p50 {p50:.0f} µs, p99 {p99:.0f} µs"

    def _clamps(self, k: int) -> str:
        """Return the active limits of each joint, and the number of rows so far with an active limit."""
        if "clamped" not in self.table:
            return "-"
        word = np.nan_to_num(self.table["clamped"][k]).astype(int)
        now = [
            f"{name} of joint {' '.join(str(i + 1) for i in np.flatnonzero(word & bit))}"
            for bit, name in _LIMITS.items()
            if (word & bit).any()
        ]
        return f"{', '.join(now) or 'none'} ({self._clamped_rows[k]} rows so far)"

    @cached_property
    def _clamped_rows(self) -> np.ndarray:
        return np.cumsum((np.nan_to_num(self.table["clamped"]) != 0).any(axis=1))

    def _lost(self, k: int) -> list[str]:
        found = []
        if "missed" in self.table:
            found.append(f"{self._missed[k]:.0f} missed,")
        if "drops" in self.table:
            found.append(f"{np.nan_to_num(self.table['drops'][k]):.0f} refused")
        return found

    @cached_property
    def _missed(self) -> np.ndarray:
        return np.nancumsum(self.table["missed"])


def read_arms(
    paths: Iterable[str | Path],
    robots: Sequence[Robot] = (),
    models: Sequence[TorqueModel | Fit[TorqueModel]] = (),
    *,
    force: bool = False,
    columns: str | None = None,
) -> list[Recorded]:
    """Return the arms recorded in one or several files, on a common clock that begins at 0.

    armlab recordings contain their robot descriptions. For other files, pass descriptions in `robots`, which are
    matched by name or, for files without robot names, by the order of the files.

    Parameters
    ----------
    paths : logs of any format supported by `log.read`.
    robots : descriptions of robots.
    models : torque models, or their fits, to estimate the wrench of their arms if the log has no estimate.
    force : accept recordings made with another description of the arm.
    columns : column names in files from other programs; see `log.read`.

    Raises
    ------
    LogError : no file is given, a file is unreadable or has no q of its robot, or two files contain the same arm.
    RobotError : a robot is neither described nor in the library.
    ModelMismatchError : a given robot differs from the recorded robot, or a model belongs to another arm.
    """
    known = [value_of(model) for model in models]
    given = {robot.name: robot for robot in robots}
    waiting = list(robots)
    found: list[tuple[Robot, Table, tuple[Event, ...]]] = []
    for path in map(Path, paths):
        for name, table, held in _tables(path, given, waiting, columns):
            robot = _robot(path, name, given, waiting, held, force)
            table = table if columns is None else in_order_of(robot, table, path)
            if not len(table):
                raise LogError(f"Expected rows of {robot.name} in {path}, got an empty log. Pass another log.")
            if "q" not in table or table["q"].shape[1] != robot.n:
                got = table["q"].shape if "q" in table else ", ".join(table.names)
                raise LogError(f"Expected positions q (N, {robot.n}) of {robot.name} in {path}, got {got}.")
            if any(robot.name == other.name for other, _, _ in found):
                raise LogError(f"Expected each arm only once, got {robot.name} also in {path}. Pass one log per arm.")
            found.append((robot, _with_wrench(table, robot, known, force), held.events if held else ()))
    if not found:
        raise LogError("Expected at least one log to view, got no path. Pass the path of a recording.")
    for robot in waiting:
        shown = found[0][0]
        check_same(
            robot, "a recording", shown.name, shown.hash, shown, f"Omit --robot {robot.name}, or override with --force."
        )
    if not force:
        _check_models(known, [robot for robot, _, _ in found])
    start = _start([table for _, table, _ in found])
    return [_recorded(*one, start) for one in found]


def _tables(
    path: Path, given: Mapping[str, Robot], waiting: Sequence[Robot], columns: str | None
) -> Iterable[tuple[str | None, Table, Inspection | None]]:
    """Yield the name, table and inspection of each arm in a file; the name and inspection may be None."""
    from armlab.log.file_formats.opening import format_at
    from armlab.log.topics.reader import is_foreign, read_joints

    if waiting and is_foreign(path):
        named = [name for name in _arms_in(path) if name in given] if format_at(path) == "MCAP" else []
        for name in named or (None,):
            yield name, read_joints(path, waiting[0] if name is None else given[name]), None
        return
    if format_at(path) != "MCAP":
        yield None, logs.read(path, columns), None
        return
    held, names = logs.inspect(path), _arms_in(path)
    if len(names) < 2:
        yield held.metadata.get("armlab", {}).get("robot"), logs.read(path), held
    else:
        yield from ((name, logs.read(path, robot=name), held) for name in names)


def _arms_in(path: Path) -> list[str]:
    """Return the names of the arms from the topics of an MCAP file."""
    topics = [topic.name.strip("/").rpartition("/") for topic in logs.inspect(path).topics]
    return sorted({name for name, _, last in topics if last == _CLOCK and name})


def _robot(
    path: Path,
    name: str | None,
    given: Mapping[str, Robot],
    waiting: list[Robot],
    held: Inspection | None,
    force: bool,
) -> Robot:
    if name is not None and name in given:
        waiting[:] = [robot for robot in waiting if robot.name != name]
        if held and not force:
            check_recorded(held, given[name])
        return given[name]
    if waiting and (name is None or force):
        return waiting.pop(0)
    found = described(held.attachments, name or "", str(path)) if held else None
    if found is not None:
        return found
    try:
        return library.load(name or "")
    except (UnknownName, RobotError):
        said = f"{name!r}, which is not in the library" if name else "a file that names no robot"
        raise RobotError(f"Expected the robot of {path}, got {said}. Pass its description with --robot FILE.") from None


def _check_models(models: Sequence[TorqueModel], arms: Sequence[Robot]) -> None:
    """Reject a model that does not belong to any of the arms."""
    for model in models:
        if model.robot_hash not in {robot.hash for robot in arms}:
            if len(arms) == 1:
                model.check_robot(arms[0])
            raise ModelMismatchError(
                f"Expected a model of {' or '.join(f'{robot.name} ({robot.hash[:12]})' for robot in arms)}, got a "
                f"model of {model.robot_name} ({model.robot_hash[:12]}). Pass the model of this arm."
            )


def _with_wrench(table: Table, robot: Robot, models: Sequence[TorqueModel], force: bool) -> Table:
    """Add an estimated wrench if the log has none and one of the models belongs to this robot (or, with `force`, to a
    robot of the same name)."""
    model = next((model for model in models if model.robot_hash == robot.hash), None)
    if model is None and force:
        model = next((model.moved_to(robot) for model in models if model.robot_name == robot.name), None)
    if model is None or "wrench_hat" in table or "tau" not in table:
        return table
    from armlab.contact import Estimator
    from armlab.identify import with_velocity

    return Estimator(model, robot).run(with_velocity(table))


def _start(tables: Sequence[Table]) -> int:
    """Return the wall-clock time at which the view starts [ns], or 0 if the logs do not overlap in time."""
    ends = [(table.t0_ns + int(1e9 * table.t[0]), table.t0_ns + int(1e9 * table.t[-1])) for table in tables]
    together = max(first for first, _ in ends) <= min(last for _, last in ends)
    return min(first for first, _ in ends) if together and all(table.t0_ns for table in tables) else 0


def _recorded(robot: Robot, table: Table, events: tuple[Event, ...], start: int) -> Recorded:
    shift = 1e-9 * (table.t0_ns - start) if start else -float(table.t[0])
    begin, end = table.t[0] + shift, table.t[-1] + shift
    stamped = ((1e-9 * (event.stamp_ns - table.t0_ns) + shift, event.text) for event in events)
    inside = tuple(sorted((min(max(t, begin), end), text) for t, text in stamped if begin - 1.0 <= t <= end + 1.0))
    return Recorded(robot, table, table.t + shift, inside)


_WINDOW = 10.0  # s, length of the curves and paths shown
_FRAMES, _CURVES = 30.0, 10.0  # updates per second of the arms and of the panel
_SPEEDS = (0.1, 4.0)  # range of the playback speed
_ARM_COLORS = (BLUE, ORANGE)  # arm colours in the plot of the whole run


class Player:
    """Player of recorded arms, controlled by method calls or from the browser.

    Parameters
    ----------
    server : viser.ViserServer
        Server from `start`.
    arms : sequence
        Recordings from `read_arms`.
    T_world_base : mapping, optional
        Pose (4, 4) of each arm's base in the world, keyed by arm name; default: the identity.
    meshes : sequence of Path, optional
        Folders of the mesh files in the descriptions; default: the current folder.

    Attributes
    ----------
    scene : scene of the arms; ``scene.frame(name, T_world_x)`` adds a named frame.
    t : displayed time of the log [s].
    duration : time of the last row [s].
    playing : whether the player is running.
    speed : playback speed relative to real time, 0.1 to 4.

    Raises
    ------
    LogError : `arms` is empty.
    RobotError : two robots have the same name.
    UnknownName : a base belongs to an unknown arm.
    ShapeError : a pose is invalid.
    """

    t: float
    playing: bool
    speed: float

    def __init__(
        self,
        server: ViserServer,
        arms: Sequence[Recorded],
        T_world_base: Mapping[str, ArrayLike] | None = None,
        *,
        meshes: Sequence[Path] = (),
    ) -> None:
        if not arms:
            raise LogError("Expected at least one recorded arm to play, got an empty list. Use read_arms.")
        self.scene: RobotScene = RobotScene(server, [arm.robot for arm in arms], T_world_base, meshes=meshes)
        self.t, self.playing, self.speed = 0.0, False, 1.0
        self.duration: float = max(float(arm.t[-1]) for arm in arms)
        self._server, self._arms = server, list(arms)
        self._events = sorted({event for arm in arms for event in arm.events})
        self._lock = threading.Lock()  # because callbacks run in server threads
        self._stale, self._panel_due = True, -math.inf
        self._controls = _Controls(server.gui, self)
        self._run, self._overview = self._whole_run(server.gui)
        self._panels = self._arm_panels(server.gui)
        self._draw()

    def play(self) -> None:
        """Start playing, from the beginning if the player is at the end."""
        with self._lock:
            self.t = 0.0 if self.t >= self.duration else self.t
            self.playing = self._stale = True

    def pause(self) -> None:
        """Pause the player."""
        with self._lock:
            self.playing, self._stale = False, True

    def seek(self, t: float) -> None:
        """Go to a time in the log.

        Parameters
        ----------
        t : time [s], which is clipped to the length of the log.

        Raises
        ------
        ShapeError : t is not finite.
        """
        t = number(t, "playback time t [s]")
        if not math.isfinite(t):
            raise ShapeError(f"Expected a finite playback time, got {t}. Pass a time from 0 to {self.duration:g} s.")
        with self._lock:
            self.t, self._stale = min(max(t, 0.0), self.duration), True

    def next_event(self) -> None:
        """Go to the next event; after the last event, go to the first."""
        later = [t for t, _ in self._events if t > self.t + 1e-9]
        if self._events:
            self.seek(later[0] if later else self._events[0][0])

    def advance(self, seconds: float) -> None:
        """Advance the player by wall time and draw the changes.

        Parameters
        ----------
        seconds : wall time since the last call [s]; no effect while paused.
        """
        with self._lock:
            if self.playing:
                self.t = min(self.t + self.speed * seconds, self.duration)
                self.playing, self._stale = self.t < self.duration, True
            stale = self._stale
        if stale:
            self._draw()

    def run(self, seconds: float | None = None) -> None:
        """Run the player in real time at thirty frames per second until Ctrl-C.

        Parameters
        ----------
        seconds : time limit [s]; default: none.
        """
        last = time.monotonic()
        end = math.inf if seconds is None else last + seconds
        while last < end:
            time.sleep(1.0 / _FRAMES)
            now = time.monotonic()
            self.advance(now - last)
            last = now

    def _draw(self) -> None:
        """Draw the arms at the current time; while playing, update the panel at most ten times per second."""
        with self._lock:
            t, playing, self._stale = self.t, self.playing, False
        now = time.monotonic()
        panel = not playing or now >= self._panel_due
        self._panel_due = now + 1.0 / _CURVES if panel else self._panel_due
        with self._server.atomic():
            for arm, words in zip(self._arms, self._panels):
                k, recent = arm.row(t), arm.span(t, _WINDOW)
                self.scene.show(
                    arm.robot.name,
                    arm.table["q"][k],
                    None if arm.wrench is None else arm.wrench[k],
                    None if arm.covariance is None else arm.covariance[k],
                )
                if panel:
                    self.scene.trace(arm.robot.name, arm.tool[recent])
                    _draw_panel(words, arm, t, recent)
            if panel:
                self._run.show(*self._overview, at=t)
                past = [event for event in self._events if event[0] <= t]
                self._controls.show(t, past[-1] if past else None)

    def _whole_run(self, gui: Any) -> tuple[Curves, tuple[np.ndarray, np.ndarray]]:
        """Return the plot of the whole run with its data: force magnitude if known, else tool speed."""
        forces = any(arm.wrench is not None for arm in self._arms)
        t = np.unique(np.concatenate([arm.t for arm in self._arms]))
        columns = []
        for arm in self._arms:
            if forces:
                size = np.full(len(arm.t), np.nan) if arm.wrench is None else np.linalg.norm(arm.wrench[:, :3], axis=1)
            else:
                size = np.linalg.norm(np.gradient(arm.tool, arm.t, axis=0), axis=1) if len(arm.t) > 1 else np.zeros(1)
            columns.append(np.interp(t, arm.t, size, left=np.nan, right=np.nan))
        shown = envelope(t, np.stack(columns, axis=1))
        known = shown[1][np.isfinite(shown[1])]
        limits = (0.0, 1.05 * float(known.max(initial=0.0)) or 1.0)
        title = "whole run: force [N]" if forces else "whole run: tool speed [m/s]"
        names = [arm.robot.name for arm in self._arms]
        colors = [_ARM_COLORS[k % len(_ARM_COLORS)] for k in range(len(names))]
        return Curves(gui, title, names, colors, cursor=True, limits=limits, height=90), shown

    def _arm_panels(self, gui: Any) -> list[ArmPanel]:
        if len(self._arms) == 1:
            return [_panel(gui, self._arms[0])]
        tabs, panels = gui.add_tab_group(), []
        for arm in self._arms:
            with tabs.add_tab(arm.robot.name):
                panels.append(_panel(gui, arm))
        return panels


class _Controls:
    """Buttons and sliders that control and follow the player."""

    def __init__(self, gui: Any, player: Player) -> None:
        actions = {"Play": player.play, "Pause": player.pause, "Next event": player.next_event}
        buttons = gui.add_button_group("log", tuple(actions))
        self._slider = gui.add_slider("time [s]", 0.0, max(math.ceil(100.0 * player.duration), 1) / 100.0, 0.01, 0.0)
        speed = gui.add_slider("speed", *_SPEEDS, 0.1, 1.0)
        arrow_slider(gui, player.scene, lambda: player.seek(player.t))
        self._said = gui.add_html("")
        buttons.on_click(lambda one: actions[one.target.value]())
        self._slider.on_update(lambda one: player.seek(one.target.value) if one.client_id is not None else None)

        @speed.on_update
        def _(_: Any) -> None:
            player.speed = float(speed.value)

    def show(self, t: float, last: tuple[float, str] | None) -> None:
        self._slider.value = round(t, 2)
        said = "" if last is None else f"{last[0]:.2f} s: {html.escape(last[1])}"
        words = f"<div style='font-size:0.8em;margin:0 1em'>{said}</div>"
        if self._said.content != words:
            self._said.content = words


def _panel(gui: Any, arm: Recorded) -> ArmPanel:
    """Return the panel of an arm, with scales that cover the whole log."""
    limits, wrench = {}, arm.wrench
    force, moment = (None, None) if wrench is None else (wrench[:, :3], wrench[:, 3:])
    plotted = {"torque": arm.torque, "force": force, "moment": moment}
    for name, values in plotted.items():
        if values is not None and np.isfinite(values).any():
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            room = 0.15 * (high - low) or 1.0
            limits[name] = (low - room, high + room)
    panel = ArmPanel(gui, arm.robot, limits)
    for name, values in plotted.items():
        if values is None:
            getattr(panel, name).hide()
    return panel


def _draw_panel(panel: ArmPanel, arm: Recorded, t: float, rows: slice) -> None:
    panel.say(arm.words(t))
    times = arm.t[rows]
    if arm.torque is not None:
        panel.torque.show(times, arm.torque[rows])
    if arm.wrench is not None:
        half = None if arm.sigma is None else 2.0 * arm.sigma[rows]
        for part, plot in ((slice(0, 3), panel.force), (slice(3, 6), panel.moment)):
            plot.show(times, arm.wrench[rows, part], None if half is None else half[:, part])
