"""`UdpSource`: numbers that another program sends to a UDP port."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from armlab.bridge.port import Arrival, Port
from armlab.bridge.sources import Reading, Source, whole
from armlab.errors import ConfigError
from armlab.log import Column

__all__ = ["UdpSource"]

_STAMPS = ("seq", "stamp_ns")
_DRAINED = 64  # datagrams per tick: a flood cannot hold the loop up
_BACKLOG = 2000  # at first: what came before the robot did
_MOST_GAPS = 1 << 53  # whole numbers in the log


class UdpSource(Source):
    """Datagrams on a UDP port of this computer, as numbers in a fixed order or as JSON.

    Every datagram that waits is taken in a tick and the newest that can be read is used; the kernel stamps arrivals.

    Parameters
    ----------
    name, fields, period, options : see `Source`.
    port, host : where to listen, from `start` on; port 0 lets the system choose.
    layout : the numbers in order, name -> NumPy type such as ``"<f8"`` or ``">u4"``: each field once, and if sent
        ``seq`` and ``stamp_ns``. Or "json": one object with these names.

    Attributes
    ----------
    drops : datagrams that could not be read; those before a newer one in the same tick are not looked at.

    Raises
    ------
    ConfigError : a layout without one of the fields, with another name or a type that is no number.
    """

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Column],
        period: float,
        port: int,
        layout: Mapping[str, str] | Literal["json"] = "json",
        host: str = "127.0.0.1",
        **options: Any,
    ) -> None:
        super().__init__(name, fields, period, **options)
        self._layout = None if layout == "json" else self._record(layout)
        self.host, self.port = host, port
        self._port: Port | None = None
        self.drops = 0
        self._newest: Reading | None = None

    def start(self) -> None:
        """Bind the port.

        Raises
        ------
        LinkError : it cannot be bound.
        """
        self._port = Port(self.host, self.port)
        self.port = self._port.port

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def newest(self) -> Reading | None:
        """Return the latest reading, None before the first."""
        waiting: list[Arrival] = []
        most = _BACKLOG if self._newest is None else _DRAINED
        while self._port is not None and len(waiting) < most:
            arrival = self._port.receive()
            if arrival is None:
                break
            waiting.append(arrival)
        while waiting and not self._take(waiting[-1].data, waiting[-1].ns, len(waiting)):
            waiting.pop()
        return self._newest

    def _take(self, data: bytes, receive_ns: int, count: int) -> bool:
        """Read the newest of `count` datagrams, so that those before it cost nothing. Return whether that went well."""
        last = self._newest
        try:
            given = self._json(data) if self._layout is None else self._numbers(data, self._layout)
            seq = whole(given.pop("seq", 0 if last is None else last.seq + count))
            stamp_ns = whole(given.pop("stamp_ns", 0))
            values = self.values(given)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            self.drops += 1
            self.problem = self.problem or f"a datagram could not be read, {type(error).__name__}: {error}"
            return False
        lost = 0 if last is None else max(seq - last.seq - count, 0)  # a restart of the numbers loses nothing
        gaps = 0 if last is None else min(last.gaps + lost, _MOST_GAPS)
        self._newest = Reading(values, stamp_ns, receive_ns, seq, gaps)
        return True

    def _record(self, layout: Mapping[str, str]) -> np.dtype[Any]:
        names = [name for name in layout if name not in _STAMPS]
        if not isinstance(layout, Mapping) or sorted(names) != sorted(self.fields):
            raise ConfigError(
                f"Expected the layout of the source {self.name!r} to hold {', '.join(self.fields)} once each, and "
                f"seq and stamp_ns where they are sent, got {layout!r}."
            )
        try:
            shapes = {name: column.shape for name, column in self.fields.items()}
            record = np.dtype([(name, code, shapes.get(name, ())) for name, code in layout.items()])
        except TypeError as error:
            raise ConfigError(f"Expected types of numbers such as '<f8' in the layout, got {layout!r}.") from error
        if any(record[name].base.kind not in "iuf" for name in layout):
            raise ConfigError(f"Expected types of numbers such as '<f8' in the layout, got {layout!r}.")
        return record

    @staticmethod
    def _numbers(data: bytes, layout: np.dtype[Any]) -> dict[str, Any]:
        if len(data) != layout.itemsize:
            raise ValueError(f"expected {layout.itemsize} bytes, got {len(data)}")
        row = np.frombuffer(data, layout)[0]
        return {name: row[name] for name in layout.names or ()}

    @staticmethod
    def _json(data: bytes) -> dict[str, Any]:
        given = json.loads(data)
        if not isinstance(given, dict):
            raise ValueError("expected a JSON object")
        return given
