"""armlab: a robotics laboratory for robot arms.

A robot and a log go in; a model file comes out; the model file runs the robot; running the robot makes a log.
Subpackages are imported on first use, so that ``import armlab`` costs little more than NumPy.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from armlab.errors import ArmlabError
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
__all__ = ["ArmlabError", "Command", "State", "__version__", *_SUBPACKAGES]


def __getattr__(name: str) -> ModuleType:
    """Import a subpackage when it is first used."""
    if name in _SUBPACKAGES:
        return import_module(f"armlab.{name}")
    raise AttributeError(f"module 'armlab' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, subpackages included."""
    return sorted(__all__)
