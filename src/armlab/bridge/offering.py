"""The rows of runs on the local feed, for a program that runs links itself instead of a cell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from armlab.bridge.feed import OPERATOR, Exchange
from armlab.bridge.local import socket_path
from armlab.bridge.loop import Controller
from armlab.bridge.rights import Arbiter
from armlab.bridge.servers import Servers, server_command
from armlab.robots import Robot
from armlab.state import State

__all__ = ["offered", "stoppable"]


@contextmanager
def offered(robots: Sequence[Robot], cell: str) -> Iterator[Exchange]:
    """Offer the rows of runs to `armlab monitor` and views while the block runs; yields the feed for `Link.run`.

    Clients may stop the arms where the controller is made `stoppable`, and nothing else.

    Parameters
    ----------
    robots : the arms. cell : the name under which the feed is found.

    Raises
    ------
    LinkError : another bridge has this name, or the server of the feed cannot be started.
    """
    exchange = Exchange(robots, [OPERATOR], about={"cell": cell})
    exchange.arbiter.reserve("the controller of the run")
    with Servers(exchange, {OPERATOR: server_command(OPERATOR, {"path": str(socket_path(cell))})}) as servers:
        servers.ready()
        yield exchange


def stoppable(controller: Controller, arbiter: Arbiter) -> Controller:
    """Return the controller that holds while somebody has stopped the arms.

    Parameters
    ----------
    controller : of the run. arbiter : of the exchange that the run feeds.
    """

    def controlled(state: State) -> Any:
        arbiter.poll()
        return None if arbiter.stopped else controller(state)

    return controlled
