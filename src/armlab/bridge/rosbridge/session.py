"""`Session`: what is known of one client, and what it is told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec

from armlab.bridge.rosbridge.operations import Level
from armlab.bridge.rosbridge.outbox import Outbox
from armlab.bridge.rosbridge.subscription import Subscription

__all__ = ["Session", "Setting"]

_LEVELS = ("info", "warning", "error", "none")


@dataclass(frozen=True)
class Setting:
    """A parameter that a client has set by a service, until the loop has answered.

    Attributes
    ----------
    service : name of the service as the client spells it. id : of the call. parameter, value : what it sets.
    until_ns : how long to wait.
    sequence : of the parameter's last change when the loop was asked; None while an earlier setting of it waits, as
        the loop's answers name the parameter, not the call.
    """

    service: str
    id: str | int | None
    parameter: str
    value: Any
    until_ns: int
    sequence: int | None = None


class Session:
    """One client.

    Parameters
    ----------
    name : its identity. may_ask : whether it may command and set; everyone may read and stop.

    Attributes
    ----------
    name, may_ask : as given. outbox : what waits for it. subscriptions : by the topic's name as the client spells it.
    advertised : topics that it said it would publish on. warned : topics of whose messages it was warned.
    settings : that the loop has not answered. level : the least of what it is told.
    """

    def __init__(self, name: str, may_ask: bool) -> None:
        self.name, self.may_ask = name, may_ask
        self.outbox = Outbox()
        self.subscriptions: dict[str, Subscription] = {}
        self.advertised: set[str] = set()
        self.warned: set[str] = set()
        self.settings: list[Setting] = []
        self.level: Level = "error"  # of the protocol

    def status(self, level: Level, text: str, now_ns: int, id_: str | int | None = None) -> None:
        """Tell the client what happened, if it wants to hear of it.

        Parameters
        ----------
        level, text : what. now_ns : monotonic clock. id_ : of the operation that it is about.
        """
        if _LEVELS.index(level) >= _LEVELS.index(self.level):
            about = {} if id_ is None else {"id": id_}
            self._send({"op": "status", **about, "level": level, "msg": text}, now_ns)

    def response(self, service: str, id_: str | int | None, values: Any, is_done: bool, now_ns: int) -> None:
        """Answer the call of a service.

        Parameters
        ----------
        service, id_ : of the call, as the client spells them. values : of the answer, or why not.
        is_done : whether it is one. now_ns : monotonic clock.
        """
        about = {} if id_ is None else {"id": id_}
        message = {"op": "service_response", **about, "service": service, "values": values, "result": is_done}
        self._send(message, now_ns)

    def _send(self, message: dict[str, Any], now_ns: int) -> None:
        self.outbox.put(msgspec.json.encode(message), now_ns)
