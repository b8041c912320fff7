"""The same jobs over many logs and many robots."""

from armlab.fleet.discovery import FleetRobot, Router, list_robots
from armlab.fleet.estimation import Estimated, estimate
from armlab.fleet.identification import Identified, identify
from armlab.fleet.logs import export
from armlab.fleet.recorder import FleetRecorder

__all__ = [
    "Estimated",
    "FleetRecorder",
    "FleetRobot",
    "Identified",
    "Router",
    "estimate",
    "export",
    "identify",
    "list_robots",
]
