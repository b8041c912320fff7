"""Colours that most eyes can tell apart: joint i and axis x, y, z have theirs in every figure and in the browser.

Okabe and Ito, "Color Universal Design" (2008), without yellow, which vanishes on white.
"""

from __future__ import annotations

BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, SKY, BLACK = "#CC79A7", "#E69F00", "#56B4E9", "#000000"
GREY = "#4D4D4D"

COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Of joint 1, 2, ..., again from the beginning after seven."""
AXIS_COLORS = (VERMILION, GREEN, BLUE)
"""Of the axes x, y, z."""
