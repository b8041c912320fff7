"""armlab: a robotics laboratory for robot arms.

A robot and a log go in; a model file comes out; the model file runs the robot; running the robot makes a log.
Subpackages, and NumPy with them, are imported on first use: ``armlab --help`` needs none.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from armlab.errors import ArmlabError

if TYPE_CHECKING:  # for type checkers and editors, what `__getattr__` does when a program runs
    from armlab import (
        bridge,
        calibrate,
        contact,
        errors,
        estimation,
        frames,
        glossary,
        identify,
        kernels,
        kinematics,
        lie,
        live,
        log,
        models,
        motion,
        plots,
        robots,
        signals,
        sim,
        state,
        wire,
    )
    from armlab.state import Command, State

__version__ = "0.1.0"

__all__ = [
    "ArmlabError", "Command", "State", "__version__", "bridge", "calibrate", "contact", "errors", "estimation",
    "frames", "glossary", "identify", "kernels", "kinematics", "lie", "live", "log", "models", "motion", "plots",
    "robots", "signals", "sim", "state", "wire",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a subpackage, or what a controller takes and returns, when it is first used."""
    if name in ("Command", "State"):
        return getattr(import_module("armlab.state"), name)
    if name in __all__:
        return import_module(f"armlab.{name}")
    raise AttributeError(f"module 'armlab' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, subpackages included."""
    return sorted(__all__)
