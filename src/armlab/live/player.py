"""The view of a log: play, pause, speed, slider, the whole run with a cursor, the next event."""

from __future__ import annotations

import html
import math
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number
from armlab._palette import BLUE, ORANGE
from armlab.errors import LogError, ShapeError
from armlab.live.curves import Curves, envelope
from armlab.live.panel import ArmPanel
from armlab.live.recorded import Recorded
from armlab.live.scene import Scene

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["Player"]

_WINDOW = 10.0  # s of curves and path
_FRAMES, _CURVES = 30.0, 10.0  # pictures per second, of the arms and of the panel
_SPEEDS, _ARROWS = (0.1, 4.0), (1.0, 50.0)  # of the sliders; the latter in mm/N
_ARM_COLORS = (BLUE, ORANGE)  # of the whole run


class Player:
    """Shows recorded arms, and moves through their log when asked to, by its methods or in the browser.

    Parameters
    ----------
    server : of `start`.
    arms : of `read_arms`.
    T_world_base, meshes : as of `Scene`.

    Attributes
    ----------
    scene : its `Scene`. t : instant shown [s]. duration : end of the log [s]. playing : whether time goes on.
    speed : log seconds per second, 0.1 to 4.

    Raises
    ------
    LogError : no arm. RobotError, UnknownName, ShapeError : as of `Scene`.
    """

    def __init__(
        self,
        server: ViserServer,
        arms: Sequence[Recorded],
        T_world_base: Mapping[str, ArrayLike] | None = None,
        *,
        meshes: Sequence[Path] = (),
    ) -> None:
        if not arms:
            raise LogError("Expected at least one recorded arm to play, got none. See read_arms.")
        self.scene = Scene(server, [arm.robot for arm in arms], T_world_base, meshes=meshes)
        self.t, self.playing, self.speed = 0.0, False, 1.0
        self.duration = max(float(arm.t[-1]) for arm in arms)
        self._server, self._arms = server, list(arms)
        self._events = sorted({event for arm in arms for event in arm.events})
        self._lock = threading.Lock()  # the browser asks in threads of the server
        self._stale, self._panel_due = True, -math.inf
        self._controls = _Controls(server.gui, self)
        self._run, self._overview = self._whole_run(server.gui)
        self._panels = self._arm_panels(server.gui)
        self.draw()

    def play(self) -> None:
        """Let time go on; from the beginning when it was at the end."""
        with self._lock:
            self.t = 0.0 if self.t >= self.duration else self.t
            self.playing = self._stale = True

    def pause(self) -> None:
        """Let time stand still."""
        with self._lock:
            self.playing, self._stale = False, True

    def seek(self, t: float) -> None:
        """Go to an instant.

        Parameters
        ----------
        t : [s]; before the beginning and after the end are those.

        Raises
        ------
        ShapeError : no finite number.
        """
        t = number(t, "the time to go to [s]")
        if not math.isfinite(t):
            raise ShapeError(f"Expected a finite time to go to, got {t}. The log ends at {self.duration:g} s.")
        with self._lock:
            self.t, self._stale = min(max(t, 0.0), self.duration), True

    def next_event(self) -> None:
        """Go to the next event after this instant, from the last one to the first."""
        later = [t for t, _ in self._events if t > self.t + 1e-9]
        if self._events:
            self.seek(later[0] if later else self._events[0][0])

    def advance(self, seconds: float) -> None:
        """Let so much time pass before the screen and draw what changed.

        Parameters
        ----------
        seconds : since the last call; nothing moves while paused.
        """
        with self._lock:
            if self.playing:
                self.t = min(self.t + self.speed * seconds, self.duration)
                self.playing, self._stale = self.t < self.duration, True
            stale = self._stale
        if stale:
            self.draw()

    def run(self, seconds: float | None = None) -> None:
        """Play for people: thirty pictures a second, until Ctrl-C.

        Parameters
        ----------
        seconds : after which to end all the same.
        """
        last = time.monotonic()
        end = math.inf if seconds is None else last + seconds
        while last < end:
            time.sleep(1.0 / _FRAMES)
            now = time.monotonic()
            self.advance(now - last)
            last = now

    def draw(self) -> None:
        """Draw the arms at this instant; the panel at most ten times a second while playing."""
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
        """Return the plot of the whole run and what it shows: size of the force, else speed of the tool."""
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
        title = "whole run: force [N]" if forces else "whole run: speed of the tool [m/s]"
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
    """Buttons and sliders; what the user does goes to the player, what the player does is shown."""

    def __init__(self, gui: Any, player: Player) -> None:
        actions = {"Play": player.play, "Pause": player.pause, "Next event": player.next_event}
        buttons = gui.add_button_group("log", tuple(actions))
        self._slider = gui.add_slider("time [s]", 0.0, max(math.ceil(100.0 * player.duration), 1) / 100.0, 0.01, 0.0)
        speed = gui.add_slider("speed", *_SPEEDS, 0.1, 1.0)
        arrow = gui.add_slider("force [mm/N]", *_ARROWS, 1.0, round(1e3 * player.scene.arrow))
        self._said = gui.add_html("")
        buttons.on_click(lambda one: actions[one.target.value]())
        self._slider.on_update(lambda one: player.seek(one.target.value) if one.client_id is not None else None)

        @speed.on_update
        def _(_: Any) -> None:
            player.speed = float(speed.value)

        @arrow.on_update
        def _(_: Any) -> None:
            player.scene.arrow = 1e-3 * float(arrow.value)
            player.seek(player.t)

    def show(self, t: float, last: tuple[float, str] | None) -> None:
        self._slider.value = round(t, 2)
        said = "" if last is None else f"{last[0]:.2f} s: {html.escape(last[1])}"
        words = f"<div style='font-size:0.8em;margin:0 1em'>{said}</div>"
        if self._said.content != words:
            self._said.content = words


def _panel(gui: Any, arm: Recorded) -> ArmPanel:
    """Make the panel of an arm, its scales those of the whole log."""
    limits = {}
    wrench, no_wrench = arm.wrench, arm.wrench is None
    for name, values in (
        ("torque", arm.torque),
        ("force", None if wrench is None else wrench[:, :3]),
        ("moment", None if wrench is None else wrench[:, 3:]),
    ):
        if values is not None and np.isfinite(values).any():
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            room = 0.15 * (high - low) or 1.0
            limits[name] = (low - room, high + room)
    panel = ArmPanel(gui, arm.robot, limits)
    for curves, missing in ((panel.torque, arm.torque is None), (panel.force, no_wrench), (panel.moment, no_wrench)):
        if missing:
            curves.hide()
    return panel


def _draw_panel(panel: ArmPanel, arm: Recorded, t: float, rows: slice) -> None:
    panel.say(arm.words(t))
    times = arm.t[rows]
    if arm.torque is not None:
        panel.torque.show(times, arm.torque[rows])
    if arm.wrench is not None:
        half = None if arm.sigma is None else 2.0 * arm.sigma[rows]
        for k, plot in ((0, panel.force), (3, panel.moment)):
            part = slice(k, k + 3)
            plot.show(times, arm.wrench[rows, part], None if half is None else half[:, part])
