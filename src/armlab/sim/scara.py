"""`scara`: an invented four-axis SCARA robot, so that its messages can be tried: two turns, a slide, a turn."""

from __future__ import annotations

from armlab.robots import Robot
from armlab.robots.build import from_dh

__all__ = ["scara"]


def scara() -> Robot:
    """Return the robot. Its numbers are round ones; no manufacturer builds it."""
    return from_dh(
        "scara",
        alpha=[0.0, 3.141592653589793, 0.0, 0.0],
        a=[0.3, 0.25, 0.0, 0.0],
        d=[0.2, 0.0, 0.0, 0.05],
        prismatic=[False, False, True, False],
        q_min=[-2.4, -2.6, 0.0, -6.9],
        q_max=[2.4, 2.6, 0.18, 6.9],
        qd_max=[6.0, 6.0, 1.0, 20.0],
        q_home=[0.2, 0.4, 0.09, 0.0],
        source="invented; axes as of ABB's four-axis robots",
    )
