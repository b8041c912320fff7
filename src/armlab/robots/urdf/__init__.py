"""URDF: reading a file or text, the tree of links and joints, and every serial arm in it."""

from armlab.robots.urdf.reading import parse, read
from armlab.robots.urdf.tree import Mimic, Tree

__all__ = ["Mimic", "Tree", "parse", "read"]
