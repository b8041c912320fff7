"""`ParameterChannel`: the port on which clients ask for parameters and set them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from armlab.bridge.labcomm.channels import Channel
from armlab.bridge.labcomm.peer import Peer
from armlab.errors import ConfigError
from armlab.wire.labcomm import PRIMS, Array, Definition, Event, Sample, SampleType
from armlab.wire.labcomm.types import Type

__all__ = ["OnSet", "ParameterChannel", "Value"]

Value = float | bool | str | Sequence[float] | np.ndarray
"""Of a parameter."""

OnSet = Callable[[str, Any, str], Any]
"""Called with the name of a parameter, the value asked for and who asks. Returns the value now in force, or None when
`LabCommServer.parameter` will tell it later."""


class ParameterChannel(Channel):
    """Parameters: one sample each, set by sending, echoed to all who asked, in the type that they asked for.

    A number is ``double name``, a list ``double name[_]`` or with its size, a truth value ``boolean name``, a text
    ``string name``.

    Parameters
    ----------
    values : of each name, in force at the start. port : 7513 by default. on_set : asked before a value
        is in force; None takes every finite one. mode : "asked" sends a parameter to a client that has defined or
        referred to it, "all" sends all on accept. dialect, follows_client : see `Channel`.
    """

    def __init__(
        self,
        values: Mapping[str, Value],
        port: int = 7513,
        on_set: OnSet | None = None,
        mode: Literal["asked", "all"] = "asked",
        dialect: str = "2014v1",
        follows_client: bool = False,
    ) -> None:
        super().__init__("parameters", port, dialect, follows_client)
        if mode not in ("asked", "all"):
            raise ConfigError(f'Expected mode to be "asked" or "all", got {mode!r}.')
        self._values, self._on_set, self._mode = dict(values), on_set, mode
        self._asked: dict[Peer, dict[str, Type]] = {}

    def greet(self, peer: Peer) -> None:
        """Queue VERSION, and in mode "all" every parameter."""
        super().greet(peer)
        if self._mode == "all":
            for name in self._values:
                self._ask(peer, name, self._types(name)[0])

    def put(self, item: tuple[str, Value], peers: Iterable[Peer]) -> None:
        """Queue the value now in force, (name, value), for all who asked for it."""
        name, value = item
        self._values[name] = value
        for peer in peers:
            if name in self._asked.get(peer, ()):
                self._tell(peer, name)

    def take(self, peer: Peer, event: Event, peers: Iterable[Peer]) -> None:
        """Take a definition of, a reference to, or a value for a parameter."""
        if not isinstance(event, Definition | Sample) or (isinstance(event, Definition) and event.kind == "type"):
            return
        if event.type not in self._types(event.name):
            self.counts["other type" if event.name in self._values else "unknown"] += 1
            return
        if isinstance(event, Definition):
            self._ask(peer, event.name, event.type)
            return
        value, now = event.value, self._values[event.name]
        if not _may_be(value):
            self.counts["refused"] += 1
            self.put((event.name, now), peers)
            return
        taken = value if self._on_set is None else self._on_set(event.name, value, peer.address)
        if taken is not None:
            self.counts["set" if taken == value else "refused"] += 1
            self.put((event.name, taken), peers)

    def left(self, peer: Peer) -> None:
        """Forget what a client asked for."""
        self._asked.pop(peer, None)

    def _types(self, name: str) -> tuple[Type, ...]:
        """Return the types that a parameter may have on the wire, none of one that does not exist."""
        value = self._values.get(name)
        if value is None:
            return ()
        if isinstance(value, bool | str):
            return (PRIMS["boolean" if isinstance(value, bool) else "string"],)
        if isinstance(value, Sequence | np.ndarray):
            return Array((0,), PRIMS["double"]), Array((len(value),), PRIMS["double"])
        return (PRIMS["double"],)

    def _ask(self, peer: Peer, name: str, node: Type) -> None:
        asked = self._asked.setdefault(peer, {})
        if peer.encoder is not None and name not in asked:
            asked[name] = node
            peer.push(peer.encoder.define(SampleType(name, node)), may_drop=False)
            self._tell(peer, name)

    def _tell(self, peer: Peer, name: str) -> None:
        if peer.encoder is not None:
            peer.push(peer.encoder.data(SampleType(name, self._asked[peer][name]), self._values[name]))


def _may_be(value: Any) -> bool:
    """Whether a value may be one of a parameter: finite numbers, or a text that all clients can be told."""
    if isinstance(value, str):
        return "\0" not in value and not any("\ud800" <= one <= "\udfff" for one in value)
    return all(math.isfinite(one) for one in (value if isinstance(value, list) else [value]))
