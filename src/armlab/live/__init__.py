"""The view in the browser: arms, forces with their uncertainty, curves; of a log, a bridge that runs, or many robots.

It needs viser (extra `live`), which loads on first use. Everything stays on this computer.
"""

from __future__ import annotations

from armlab.live.curves import Curves, Window
from armlab.live.fleet_rows import FleetRows, SeenRobot
from armlab.live.fleet_view import FleetView, watch_fleet
from armlab.live.panel import ArmPanel
from armlab.live.player import Player
from armlab.live.recorded import Recorded, read_arms
from armlab.live.running import Force, Running
from armlab.live.running_view import RunningView, watch
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
