"""armlab: a robotics laboratory for robot arms.

Identification turns a robot description and a log into a model file, which controllers use. Every run records a log.
Subpackages and NumPy are imported on first use, so ``armlab --help`` starts quickly.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from armlab.errors import ArmlabError

if TYPE_CHECKING:  # mirrors `__getattr__` for type checkers and editors
    from armlab import (
        bridge,
        calibrate,
        contact,
        dynamics,
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
    "ArmlabError", "Command", "State", "__version__", "bridge", "calibrate", "contact", "dynamics", "errors",
    "estimation", "frames", "glossary", "identify", "kernels", "kinematics", "lie", "live", "log", "models", "motion",
    "plots", "robots", "signals", "sim", "state", "wire",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a subpackage, `State` or `Command` on first use."""
    if name in ("Command", "State"):
        return getattr(import_module("armlab.state"), name)
    if name in __all__:
        return import_module(f"armlab.{name}")
    raise AttributeError(f"module 'armlab' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names, including subpackages."""
    return sorted(__all__)
