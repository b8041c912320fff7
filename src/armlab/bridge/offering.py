"""The rows of a link on the local feed, for a program that runs links itself instead of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from armlab.bridge.feed import OPERATOR, Exchange
from armlab.bridge.local import socket_path
from armlab.bridge.loop import Controller
from armlab.bridge.rights import Arbiter
from armlab.bridge.servers import Servers, server_command
from armlab.robots import Robot
from armlab.state import State

__all__ = ["Offering", "stoppable"]


class Offering:
    """Offers the rows of runs to `armlab monitor` and views until it is closed.

    Clients may stop the arms where the controller is made `stoppable`, and nothing else.

    Parameters
    ----------
    robots : the arms. cell : the name under which the feed is found.

    Attributes
    ----------
    exchange : the feed for `Link.run`.

    Raises
    ------
    LinkError : another bridge has this name, or the server of the feed cannot be started.
    """

    def __init__(self, robots: Sequence[Robot], cell: str) -> None:
        self.exchange = Exchange(robots, [OPERATOR], about={"cell": cell})
        self.exchange.arbiter.reserve("the controller of the run")
        self._servers = Servers(self.exchange, {OPERATOR: server_command(OPERATOR, {"path": str(socket_path(cell))})})
        self._servers.__enter__()
        try:
            self._servers.ready()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the feed; its clients are told that it has ended."""
        self._servers.close()


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
