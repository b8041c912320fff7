"""Batch processing of many logs, and recording of many robots."""

from armlab.fleet.discovery import Router, list_robots
from armlab.fleet.identification import Identified, identify
from armlab.fleet.logs import estimate, export
from armlab.fleet.recorder import FleetRecorder

__all__ = ["FleetRecorder", "Identified", "Router", "estimate", "export", "identify", "list_robots"]
