"""The same jobs over many logs and many robots."""

from armlab.fleet.estimation import Estimated, estimate
from armlab.fleet.exporting import export
from armlab.fleet.identification import Identified, identify
from armlab.fleet.record import FleetRecorder
from armlab.fleet.robots import FleetRobot, list_robots
from armlab.fleet.router import Router

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
