"""The simulated arm and its EGM controller: the only place that knows a truth. All else sees what the wire carries.

Names are imported when they are first used: the help of ``armlab sim`` shows settings and needs no NumPy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors, what `__getattr__` does when a program runs
    from armlab.sim import two_link
    from armlab.sim.arm.arm import LaggingArm, SimulatedArm, record
    from armlab.sim.arm.mismatch import Mismatch
    from armlab.sim.arm.sensors import SensorReading, TrueState
    from armlab.sim.arm.truth import Truth, synthetic_truth, truth_names
    from armlab.sim.controller.channel import Faults, UdpClient
    from armlab.sim.controller.controller import SimulatedController
    from armlab.sim.controller.cycles import Timing, run
    from armlab.sim.controller.guidance import Guidance
    from armlab.sim.controller.packets import PacketBuilder
    from armlab.sim.controller.settings import ControllerSettings, FaultRates
    from armlab.sim.events import MOTORS, RAPID, AppliedWrench, Grip, HandPath, StateScript, Surroundings
    from armlab.sim.experiments.cell import CalibrationCell, cell

_PLACES = {  # module: its public names
    "arm.arm": ("LaggingArm", "SimulatedArm", "record"),
    "arm.mismatch": ("Mismatch",),
    "arm.sensors": ("SensorReading", "TrueState"),
    "arm.truth": ("Truth", "synthetic_truth", "truth_names"),
    "controller.channel": ("Faults", "UdpClient"),
    "controller.controller": ("SimulatedController",),
    "controller.cycles": ("Timing", "run"),
    "controller.guidance": ("Guidance",),
    "controller.packets": ("PacketBuilder",),
    "controller.settings": ("ControllerSettings", "FaultRates"),
    "events": ("MOTORS", "RAPID", "AppliedWrench", "Grip", "HandPath", "StateScript", "Surroundings"),
    "experiments.cell": ("CalibrationCell", "cell"),
}
__all__ = [
    "MOTORS",
    "RAPID",
    "AppliedWrench",
    "CalibrationCell",
    "ControllerSettings",
    "FaultRates",
    "Faults",
    "Grip",
    "Guidance",
    "HandPath",
    "LaggingArm",
    "Mismatch",
    "PacketBuilder",
    "SensorReading",
    "SimulatedArm",
    "SimulatedController",
    "StateScript",
    "Surroundings",
    "Timing",
    "TrueState",
    "Truth",
    "UdpClient",
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
