"""The simulated arm and its EGM controller: the only place that knows a truth. All else sees what the wire carries.

Names are imported when they are first used: the help of ``armlab sim`` shows settings and needs no NumPy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors, what `__getattr__` does when a program runs
    from armlab.sim import two_link
    from armlab.sim.arm import Arm, Sample
    from armlab.sim.cells import Cell, cell
    from armlab.sim.channel import Channel
    from armlab.sim.controller import Controller
    from armlab.sim.fault_rates import FaultRates
    from armlab.sim.faults import Faults
    from armlab.sim.grip import Grip
    from armlab.sim.guidance import Guidance
    from armlab.sim.hand import HandPath
    from armlab.sim.lagging import LaggingArm
    from armlab.sim.loop import Pace, run
    from armlab.sim.mismatch import Mismatch
    from armlab.sim.operator import Operator
    from armlab.sim.packets import Packets
    from armlab.sim.recording import record
    from armlab.sim.scene import Scene
    from armlab.sim.script import MOTORS, RAPID, Script
    from armlab.sim.sensors import Measurement
    from armlab.sim.settings import Settings
    from armlab.sim.truth import Truth, synthetic_truth, truth_names

_PLACES = {  # module: its public names
    "arm": ("Arm", "Sample"),
    "cells": ("Cell", "cell"),
    "channel": ("Channel",),
    "controller": ("Controller",),
    "fault_rates": ("FaultRates",),
    "faults": ("Faults",),
    "grip": ("Grip",),
    "guidance": ("Guidance",),
    "hand": ("HandPath",),
    "lagging": ("LaggingArm",),
    "loop": ("Pace", "run"),
    "mismatch": ("Mismatch",),
    "operator": ("Operator",),
    "packets": ("Packets",),
    "recording": ("record",),
    "scene": ("Scene",),
    "script": ("MOTORS", "RAPID", "Script"),
    "sensors": ("Measurement",),
    "settings": ("Settings",),
    "truth": ("Truth", "synthetic_truth", "truth_names"),
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
