"""Robots: immutable descriptions of arms, their builders, files and library."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from armlab.robots import couplings, inertia
from armlab.robots.build import from_dh, from_links, from_local_poe, from_poe, normalise_screw, to_local_poe
from armlab.robots.comparison import differences
from armlab.robots.files import from_toml, load, names, save, to_toml
from armlab.robots.robot import Mesh, Robot

if TYPE_CHECKING:
    from armlab.robots import urdf

__all__ = [
    "Mesh", "Robot", "couplings", "differences", "from_dh", "from_links", "from_local_poe", "from_poe", "from_toml",
    "inertia", "load", "names", "normalise_screw", "save", "to_local_poe", "to_toml", "urdf",
]  # fmt: skip


def __getattr__(name: str) -> ModuleType:
    """Import the URDF reader on first use, because it costs 2 ms and library robots do not need it."""
    if name == "urdf":
        return import_module("armlab.robots.urdf")
    raise AttributeError(f"module 'armlab.robots' has no attribute {name!r}")
