"""Real-time loop between a Python controller and a robot."""

from armlab.bridge.control.limits import Limits
from armlab.bridge.control.run import Run
from armlab.bridge.inputs.fusion import Held
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.inputs.sources import (
    CallableSource,
    Reading,
    ReplaySource,
    Source,
    ThreadSource,
    TimerSource,
    UdpSource,
)
from armlab.bridge.link import Link, connect

__all__ = [
    "CallableSource",
    "Held",
    "Limits",
    "Link",
    "Parameter",
    "Parameters",
    "Reading",
    "ReplaySource",
    "Run",
    "Source",
    "ThreadSource",
    "TimerSource",
    "UdpSource",
    "connect",
]
