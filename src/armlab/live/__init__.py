"""The view in the browser: arms, forces with their uncertainty, curves; of a log, a bridge that runs, or many robots.

It needs viser (extra `live`), which loads on first use. Everything stays on this computer.
"""

from __future__ import annotations

from armlab.live.curves import ArmPanel, Curves, Window
from armlab.live.fleet_view import FleetRows, FleetView, SeenRobot, watch_fleet
from armlab.live.live_bridge import Force, Running, RunningView, watch
from armlab.live.recording_view import Player, Recorded, read_arms
from armlab.live.scene import Scene
from armlab.live.server import address, start, stop

__all__ = [
    "ArmPanel",
    "Curves",
    "FleetRows",
    "FleetView",
    "Force",
    "Player",
    "Recorded",
    "Running",
    "RunningView",
    "Scene",
    "SeenRobot",
    "Window",
    "address",
    "read_arms",
    "start",
    "stop",
    "watch",
    "watch_fleet",
]
