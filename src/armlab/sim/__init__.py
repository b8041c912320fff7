"""Simulated arm and EGM controller with known ground truth; only measurements are transmitted.

Names are imported on first use, so the help of ``armlab sim`` can show settings without importing NumPy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors; at run time, `__getattr__` imports the names
    from armlab.sim import two_link
    from armlab.sim.arm.arm import SimulatedArm, record
    from armlab.sim.arm.mismatch import Mismatch
    from armlab.sim.arm.truth import Truth, synthetic_truth
    from armlab.sim.experiments.cell import CalibrationCell, cell

__all__ = ["CalibrationCell", "Mismatch", "SimulatedArm", "Truth", "cell", "record", "synthetic_truth", "two_link"]

_PLACES = {
    "CalibrationCell": "experiments.cell",
    "Mismatch": "arm.mismatch",
    "SimulatedArm": "arm.arm",
    "Truth": "arm.truth",
    "cell": "experiments.cell",
    "record": "arm.arm",
    "synthetic_truth": "arm.truth",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name == "two_link":
        return import_module("armlab.sim.two_link")
    if name in _PLACES:
        return getattr(import_module(f"armlab.sim.{_PLACES[name]}"), name)
    raise AttributeError(f"module 'armlab.sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
