"""The panel of one arm: words about its link, torques, forces and moments over time."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from armlab._palette import AXIS_COLORS, COLORS
from armlab.live.curves import Curves
from armlab.robots import Robot

__all__ = ["ArmPanel"]


class ArmPanel:
    """Words and plots of one arm, where ``with`` of a folder or tab of the panel puts them.

    Parameters
    ----------
    gui : ``server.gui``.
    robot : the arm.
    limits : ends of the scales by name of the plot: "torque", "force", "moment"; they follow the data otherwise.

    Attributes
    ----------
    torque, force, moment : plots, see `Curves`: n curves, three with bands, three with bands.
    """

    def __init__(self, gui: Any, robot: Robot, limits: Mapping[str, tuple[float, float]] | None = None) -> None:
        limits = limits or {}
        self._words = gui.add_html("")
        self._shown: Mapping[str, str] = {}
        joints = [COLORS[i % len(COLORS)] for i in range(robot.n)]
        forces, moments = ("f_x", "f_y", "f_z"), ("m_x", "m_y", "m_z")
        self.force = Curves(gui, "force [N]", forces, AXIS_COLORS, band=True, limits=limits.get("force"))
        self.torque = Curves(gui, "torque [N m]", robot.joint_names, joints, limits=limits.get("torque"))
        self.moment = Curves(
            gui, "moment [N m]", moments, AXIS_COLORS, band=True, limits=limits.get("moment"), height=110
        )

    def say(self, words: Mapping[str, str]) -> None:
        """Write what there is to say of the arm: state, rate, latency, clamps, drops; the same again sends nothing.

        Parameters
        ----------
        words : what it is -> its value.
        """
        if dict(words) == self._shown:
            return
        self._shown = dict(words)
        key, value = "padding:0 1em 0 0;opacity:0.65", "padding:0"
        rows = "".join(
            f"<tr><td style='{key}'>{html.escape(what)}</td><td style='{value}'>{html.escape(word)}</td></tr>"
            for what, word in words.items()
        )
        self._words.content = f"<table style='font-size:0.8em;line-height:1.3;margin:0 1em'>{rows}</table>"
