"""armlab: a robotics laboratory for robot arms.

A robot and a log go in; a model file comes out; the model file runs the robot; running the robot makes a log.
Subpackages, and NumPy with them, are imported on first use: ``armlab --help`` needs none.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from armlab.errors import ArmlabError

if TYPE_CHECKING:
    from armlab.state import Command, State

__version__ = "0.1.0"

_SUBPACKAGES = (
    "bridge",
    "calibrate",
    "contact",
    "errors",
    "estimation",
    "frames",
    "glossary",
    "identify",
    "kernels",
    "kinematics",
    "lie",
    "log",
    "models",
    "motion",
    "plots",
    "robots",
    "signals",
    "sim",
    "state",
    "wire",
)
_OF_STATE = ("Command", "State")
__all__ = ["ArmlabError", "Command", "State", "__version__", *_SUBPACKAGES]


def __getattr__(name: str) -> Any:
    """Import a subpackage, or what a controller takes and returns, when it is first used."""
    if name in _SUBPACKAGES:
        return import_module(f"armlab.{name}")
    if name in _OF_STATE:
        return getattr(import_module("armlab.state"), name)
    raise AttributeError(f"module 'armlab' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, subpackages included."""
    return sorted(__all__)
