"""The real-time loop between a controller in Python and a robot."""

from armlab.bridge.limits import Limits
from armlab.bridge.link import Link, connect
from armlab.bridge.parameters import Parameter, Parameters
from armlab.bridge.rights import Arbiter, Order
from armlab.bridge.run import Run

__all__ = ["Arbiter", "Limits", "Link", "Order", "Parameter", "Parameters", "Run", "connect"]
