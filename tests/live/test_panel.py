"""The panel of an arm: its words, and plots with the colours that its joints have in the scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab import robots
from armlab.live.curves import ArmPanel, Lines, Markup


def test_words_are_escaped_and_sent_when_they_change(server: Any) -> None:
    panel = ArmPanel(server.gui, robots.load("irb2400"))
    panel.say({"state": "holding", "why": "<no> packet"})
    text = panel._words._html.content
    assert "holding" in text
    assert "&lt;no&gt; packet" in text
    panel.say({"state": "holding", "why": "<no> packet"})
    assert panel._words._html.content is text


def test_lines_are_text_and_markup_is_not(server: Any) -> None:
    lines, markup = Lines(server.gui), Markup(server.gui)
    lines.show("<b>\nsecond")
    markup.show("<b>bold</b>")
    assert "&lt;b&gt;<br>second" in lines._html.content
    assert markup._html.content == "<b>bold</b>"
    lines.remove()
    markup.remove()


def test_plots_have_one_curve_per_joint_and_axis(server: Any) -> None:
    robot = robots.load("irb2400")
    panel = ArmPanel(server.gui, robot, {"force": (-20.0, 20.0)})
    panel.torque.show([0.0], np.zeros((1, 6)))
    panel.force.show([0.0], np.zeros((1, 3)), np.ones((1, 3)))
    panel.moment.show([0.0], np.zeros((1, 3)))
    plots = [panel.torque._plot, panel.force._plot, panel.moment._plot]
    assert [len(plot.data) for plot in plots] == [7, 10, 10]
    assert [one["stroke"] for one in plots[0].series[1:3]] == ["#0072B2", "#D55E00"]
    assert plots[1].scales["y"]["range"] == (-20.0, 20.0)
