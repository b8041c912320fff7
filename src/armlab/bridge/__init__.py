"""The real-time loop between a controller in Python and a robot."""

from armlab.bridge.arbiter import Arbiter, Order
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.run import Run
from armlab.bridge.inputs.fusion import Fusion, Held
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.inputs.sources import CallableSource, Reading, ReplaySource, Source, TimerSource, UdpSource
from armlab.bridge.link import Link, connect

__all__ = [
    "Arbiter",
    "CallableSource",
    "Fusion",
    "Held",
    "Limits",
    "Link",
    "Order",
    "Parameter",
    "Parameters",
    "Reading",
    "ReplaySource",
    "Run",
    "Source",
    "TimerSource",
    "UdpSource",
    "connect",
]
