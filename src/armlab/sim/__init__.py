"""The simulated arm and its EGM controller: the only place that knows a truth. All else sees what the wire carries.

Names are imported when they are first used: the help of ``armlab sim`` shows settings and needs no NumPy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors, what `__getattr__` does when a program runs
    from armlab.sim import two_link
    from armlab.sim.arm.arm import Arm, LaggingArm, Sample, record
    from armlab.sim.arm.mismatch import Mismatch
    from armlab.sim.arm.sensors import Measurement
    from armlab.sim.arm.truth import Truth, synthetic_truth, truth_names
    from armlab.sim.controller.channel import Channel, Faults
    from armlab.sim.controller.controller import Controller
    from armlab.sim.controller.cycles import Pace, run
    from armlab.sim.controller.guidance import Guidance
    from armlab.sim.controller.packets import Packets
    from armlab.sim.controller.settings import FaultRates, Settings
    from armlab.sim.events import MOTORS, RAPID, Grip, HandPath, Operator, Scene, Script
    from armlab.sim.experiments.cell import Cell, cell

_PLACES = {  # module: its public names
    "arm.arm": ("Arm", "LaggingArm", "record"),
    "arm.mismatch": ("Mismatch",),
    "arm.sensors": ("Measurement", "Sample"),
    "arm.truth": ("Truth", "synthetic_truth", "truth_names"),
    "controller.channel": ("Channel", "Faults"),
    "controller.controller": ("Controller",),
    "controller.cycles": ("Pace", "run"),
    "controller.guidance": ("Guidance",),
    "controller.packets": ("Packets",),
    "controller.settings": ("FaultRates", "Settings"),
    "events": ("MOTORS", "RAPID", "Grip", "HandPath", "Operator", "Scene", "Script"),
    "experiments.cell": ("Cell", "cell"),
}
__all__ = [
    "MOTORS",
    "RAPID",
    "Arm",
    "Cell",
    "Channel",
    "Controller",
    "FaultRates",
    "Faults",
    "Grip",
    "Guidance",
    "HandPath",
    "LaggingArm",
    "Measurement",
    "Mismatch",
    "Operator",
    "Packets",
    "Pace",
    "Sample",
    "Scene",
    "Script",
    "Settings",
    "Truth",
    "cell",
    "record",
    "run",
    "synthetic_truth",
    "truth_names",
    "two_link",
]


def __getattr__(name: str) -> Any:
    """Import what the package exports when it is first used."""
    if name == "two_link":
        return import_module("armlab.sim.two_link")
    for module, names in _PLACES.items():
        if name in names:
            return getattr(import_module(f"armlab.sim.{module}"), name)
    raise AttributeError(f"module 'armlab.sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
