"""The real-time loop between a controller in Python and a robot."""

from armlab.bridge.fusion import Fusion, Held
from armlab.bridge.limits import Limits
from armlab.bridge.link import Link, connect
from armlab.bridge.order import Order
from armlab.bridge.parameters import Parameter, Parameters
from armlab.bridge.replay import ReplaySource
from armlab.bridge.rights import Arbiter
from armlab.bridge.run import Run
from armlab.bridge.sources import CallableSource, Reading, Source, TimerSource
from armlab.bridge.udp import UdpSource

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
