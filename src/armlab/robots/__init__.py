"""Robots: the frozen description of an arm, its builders, files and library."""

from armlab.robots.build import Details, from_dh, from_links
from armlab.robots.files import load, names
from armlab.robots.robot import Robot

__all__ = ["Details", "Robot", "from_dh", "from_links", "load", "names"]
