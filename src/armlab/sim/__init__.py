"""The simulated arm and its EGM controller: the only place that knows a truth. All else sees what the wire carries."""

from armlab.sim import two_link
from armlab.sim.arm import Arm, Sample
from armlab.sim.cell import Cell, cell
from armlab.sim.channel import Channel
from armlab.sim.controller import Controller
from armlab.sim.faults import FaultRates, Faults
from armlab.sim.grip import Grip
from armlab.sim.guidance import Guidance, Settings
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
from armlab.sim.truth import Truth, synthetic_truth, truth_names

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
