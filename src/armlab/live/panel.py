"""The panel of one arm: words about its link, torques, forces and moments over time."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from armlab._palette import AXIS_COLORS, COLORS
from armlab.live.curves import Curves
from armlab.robots import Robot

__all__ = ["ArmPanel", "Lines", "Markup"]


class Markup:
    """Words in the panel; the same again sends nothing.

    Parameters
    ----------
    gui : ``server.gui``.
    """

    def __init__(self, gui: Any) -> None:
        self._html, self._shown = gui.add_html(""), ""

    def show(self, content: str) -> None:
        """Show what is HTML already.

        Parameters
        ----------
        content : all of it.
        """
        if content != self._shown:
            self._html.content = self._shown = content

    def remove(self) -> None:
        """Take them away."""
        self._html.remove()


class Lines(Markup):
    """Lines of text in the panel.

    Parameters
    ----------
    gui : ``server.gui``.
    """

    def show(self, content: str) -> None:
        """Show lines.

        Parameters
        ----------
        content : as text.
        """
        text = html.escape(content).replace("\n", "<br>")
        super().show(f"<div style='font-size:0.85em;margin:0.3em 0.8em'>{text}</div>")


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
        self._words = Markup(gui)
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
        key, value = "padding:0 1em 0 0;opacity:0.65", "padding:0"
        rows = "".join(
            f"<tr><td style='{key}'>{html.escape(what)}</td><td style='{value}'>{html.escape(word)}</td></tr>"
            for what, word in words.items()
        )
        self._words.show(f"<table style='font-size:0.8em;line-height:1.3;margin:0 1em'>{rows}</table>")
