"""URDF: parse a file or string into a tree of links and joints, and extract serial arms."""

from armlab.robots.urdf.reading import parse, read
from armlab.robots.urdf.tree import Mimic, Tree

__all__ = ["Mimic", "Tree", "parse", "read"]
