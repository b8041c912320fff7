"""Channels of a LabComm server, one per port, and `Peer`, a connection with a queue and timeouts."""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from armlab.bridge.servers.labcomm.rows import Order, Row, RowTypes
from armlab.errors import ConfigError, LabCommError
from armlab.wire.labcomm import Decoder, Encoder, Sample, idl
from armlab.wire.labcomm.types import PRIMS, Array, Definition, Event, SampleType, Type, dialect_named

QUEUE = 64
"""Maximum number of packets queued for a slow peer; beyond this limit, the oldest data packets are dropped."""

_AT_ONCE = 65_536  # bytes per read
_PATIENCE = 5.0  # s: time limit for a packet to be completed, and for a peer to read
_KERNEL = 65_536  # bytes of the kernel's send buffer; small, so a slow peer gets recent rows


class Peer:
    """Connection with a queue; the encoder is None until the peer's dialect is known."""

    address: str
    encoder: Encoder | None
    decoder: Decoder
    sent: int
    dropped: int
    refused: int
    began: float
    reported: float

    def __init__(self, connection: socket.socket, address: str, encoder: Encoder | None) -> None:
        self.socket: socket.socket = connection
        self.address, self.encoder = address, encoder
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.decoder, self.sent, self.dropped, self.refused = Decoder(), 0, 0, 0
        self.began, self.reported = time.monotonic(), -math.inf
        self._queue: deque[tuple[bytes, bool]] = deque()  # packet, and whether it may be dropped
        self._rest = b""  # remainder of a partly sent packet
        self._stuck: float | None = None  # time of the first failed send since the last success
        self._packet = (0, self.began)  # position and start of an incomplete packet

    @property
    def is_waiting(self) -> bool:
        return bool(self._rest or self._queue)

    @property
    def is_stuck(self) -> bool:
        return self._stuck is not None

    def push(self, packet: bytes, may_drop: bool = True) -> None:
        """Queue one packet; if the queue is full, its oldest droppable packet is dropped."""
        queue = self._queue
        if len(queue) >= QUEUE:
            oldest = next((index for index, (_, droppable) in enumerate(queue) if droppable), None)
            if oldest is not None:
                del queue[oldest]
                self.dropped += 1
            elif may_drop:
                self.dropped += 1
                return
        queue.append((packet, may_drop))

    def clear(self) -> None:
        kept = [entry for entry in self._queue if not entry[1]]
        self.dropped += len(self._queue) - len(kept)
        self._queue = deque(kept)

    def flush(self) -> bool:
        """Send while the socket accepts data, one write per packet; return False if the connection is closed."""
        while self._rest or self._queue:
            data, is_row = (self._rest, False) if self._rest else self._queue.popleft()
            self.sent += is_row
            try:
                sent = self.socket.send(data)
            except (BlockingIOError, InterruptedError):
                self._rest = data
                self._stuck = self._stuck or time.monotonic()
                return True
            except OSError:
                return False
            self._rest, self._stuck = data[sent:], None
        return True

    def read(self, most: int = _AT_ONCE) -> list[Event] | None:
        """Read once and return the events, or None once the peer has closed the connection."""
        try:
            data = self.socket.recv(most)
        except (BlockingIOError, InterruptedError):
            return []
        except OSError:
            return None
        if not data:
            self.decoder.close()
            return None
        return self.decoder.feed(data)

    def overdue(self, now: float) -> str:
        """Return the reason for closing the connection at `now` (monotonic) [s], or "" to keep it open."""
        if self.decoder.pending:
            position, since = self._packet
            if position != self.decoder.offset:
                self._packet = (self.decoder.offset, now)
            elif now - since > _PATIENCE:
                return f"a packet was not complete after {_PATIENCE:g} s"
        else:
            self._packet = (self.decoder.offset, now)
        if self._stuck is not None and now - self._stuck > _PATIENCE:
            return f"the client read nothing for {_PATIENCE:g} s"
        return ""

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.socket.close()


OnCommand = Callable[[str, Row, str], None]
"""Callback that receives the channel name, a valid command and the client address."""


class Channel:
    """Port of a LabComm server."""

    name: str
    port: int
    follows_client: bool

    sent: SampleType | None = None  # type of all data sent on the port, if it is unique

    def __init__(self, name: str, port: int, dialect: str = "2014v1", follows_client: bool = False) -> None:
        self.name, self.port, self.follows_client = name, port, follows_client
        self.dialect: str = dialect_named(dialect).name
        self.counts: Counter[str] = Counter()

    def greet(self, peer: Peer) -> None:
        """Queue the first packets for a client: VERSION and the definition of the type that the channel sends."""
        if peer.encoder is not None:
            peer.push(peer.encoder.version(), may_drop=False)
            if self.sent is not None:
                peer.push(peer.encoder.define(self.sent), may_drop=False)

    def take(self, peer: Peer, event: Event, peers: Iterable[Peer]) -> None:
        """Handle one event from a client; by default, data are ignored."""
        self.counts["ignored"] += isinstance(event, Sample)

    def left(self, peer: Peer) -> None:
        """Remove a disconnected client."""

    def put(self, item: Any, peers: Iterable[Peer]) -> None:
        """Queue a published item for all clients."""
        raise NotImplementedError

    def _send(self, value: Any, peers: Iterable[Peer]) -> None:
        """Queue a value of the port's type."""
        for peer in peers:
            if peer.encoder is not None and self.sent is not None:
                peer.push(peer.encoder.data(self.sent, value))


class ArmChannel(Channel):
    """Channel of one arm: rows out, commands in; `bridge.arbiter.Arbiter` selects the commanding client.

    Parameters
    ----------
    name : str
        Name of the arm.
    port : int
        TCP port: 7511 for a left arm, 7512 for a right arm.
    on_command : callable
        Called in the server's thread with the channel name, the row and the client's address.
    axes : sequence of int
        See `RowTypes`.
    order : str
        See `RowTypes`.
    types : str
        See `RowTypes`.
    dialect : str
        See `Channel`.
    follows_client : bool
        See `Channel`.
    on_left : callable
        Called in the server's thread with the address of a disconnected client.
    """

    def __init__(
        self,
        name: str,
        port: int,
        on_command: OnCommand | None = None,
        axes: Sequence[int] = (1, 2, 7, 3, 4, 5, 6),
        order: Order = "abb",
        types: str | None = None,
        dialect: str = "2014v1",
        follows_client: bool = False,
        on_left: Callable[[str], None] = lambda client: None,
    ) -> None:
        super().__init__(name, port, dialect, follows_client)
        self.types: RowTypes = RowTypes(axes, order, types)
        self.sent: SampleType | None = self.types.sent
        self._on_command, self._on_left = on_command, on_left

    def put(self, item: Row, peers: Iterable[Peer]) -> None:
        """Queue one row for all clients."""
        self._send(self.types.value(item), peers)

    def take(self, peer: Peer, event: Event, peers: Iterable[Peer]) -> None:
        """Handle a command; count all other samples for the server's report.

        Raises
        ------
        LabCommError
            A sample of a different type, or an invalid command.
        """
        if not isinstance(event, Sample):
            return
        if not self.types.accepts(SampleType(event.name, event.type)):
            self.counts["other type"] += 1
            raise LabCommError(
                f"Expected {self.types.accepted.name} on this port, got a sample of type {event.name!r}."
            )
        try:
            row = self.types.command(event.value)
        except LabCommError:
            self.counts["refused"] += 1
            raise
        self.counts["commands"] += 1
        if self._on_command is not None:
            self._on_command(self.name, row, peer.address)

    def left(self, peer: Peer) -> None:
        """Report a disconnected client."""
        self._on_left(peer.address)


class FusedArm(NamedTuple):
    """Arm in a fused row: name, arrival time on the bridge's clock [µs], and row."""

    name: str
    t_us: int
    row: Row


class FusedSource(NamedTuple):
    """Source in a fused row: name, arrival time on the bridge's clock [µs], and values."""

    name: str
    t_us: int
    value: Sequence[float] | np.ndarray


class FusedChannel(Channel):
    """Channel for fused rows of all arms and sources; samples from clients are ignored."""

    def __init__(
        self,
        port: int = 7514,
        axes: Sequence[int] = (1, 2, 7, 3, 4, 5, 6),
        order: Order = "abb",
        dialect: str = "2014v1",
        follows_client: bool = False,
    ) -> None:
        super().__init__("fused", port, dialect, follows_client)
        self.sent: SampleType | None = idl.samples("armlab")["fused_row"]
        self._types = RowTypes(axes, order)
        if self._types.n != 7:
            raise ConfigError(f"Expected arms with 7 joints for fused rows, got {self._types.n}.")

    def put(self, item: tuple[int, Sequence[FusedArm], Sequence[FusedSource]], peers: Iterable[Peer]) -> None:
        """Queue one fused row for all clients: (t_us, arms, sources)."""
        t_us, arms, sources = item
        value = {
            "t_us": t_us,
            "arm": [{"name": one.name, "t_us": one.t_us, **self._types.value(one.row)} for one in arms],
            "source": [one._asdict() for one in sources],
        }
        self._send(value, peers)


Value = float | bool | str | Sequence[float] | np.ndarray
"""Value of a parameter."""

OnSet = Callable[[str, Any, str], Any]
"""Callback that maps a parameter name, the requested value and the client to the new value (None: published later)."""


class ParameterChannel(Channel):
    """Parameter channel: a received sample sets a parameter; each subscriber receives value changes in the type that it
    has defined.

    Types: ``double name``, ``double name[_]`` (or with the array size), ``boolean name`` and ``string name``.
    """

    def __init__(
        self,
        values: Mapping[str, Value],
        port: int = 7513,
        on_set: OnSet | None = None,
        dialect: str = "2014v1",
        follows_client: bool = False,
    ) -> None:
        super().__init__("parameters", port, dialect, follows_client)
        self._values, self._on_set = dict(values), on_set
        self._subscribed: dict[Peer, dict[str, Type]] = {}

    def put(self, item: tuple[str, Value], peers: Iterable[Peer]) -> None:
        """Queue the current value of a parameter for its subscribers; `item` is (name, value)."""
        name, value = item
        self._values[name] = value
        for peer in peers:
            if name in self._subscribed.get(peer, ()):
                self._send_value(peer, name)

    def take(self, peer: Peer, event: Event, peers: Iterable[Peer]) -> None:
        """Handle a parameter definition, which subscribes the client, or a new value."""
        if not isinstance(event, Definition | Sample) or (isinstance(event, Definition) and event.kind == "type"):
            return
        if event.type not in self._types(event.name):
            self.counts["other type" if event.name in self._values else "unknown"] += 1
            return
        if isinstance(event, Definition):
            subscribed = self._subscribed.setdefault(peer, {})
            if peer.encoder is not None and event.name not in subscribed:
                subscribed[event.name] = event.type
                peer.push(peer.encoder.define(SampleType(event.name, event.type)), may_drop=False)
                self._send_value(peer, event.name)
            return
        value, now = event.value, self._values[event.name]
        if not _is_valid(value):
            self.counts["refused"] += 1
            self.put((event.name, now), peers)
            return
        taken = value if self._on_set is None else self._on_set(event.name, value, peer.address)
        if taken is not None:
            self.counts["set" if taken == value else "refused"] += 1
            self.put((event.name, taken), peers)

    def left(self, peer: Peer) -> None:
        self._subscribed.pop(peer, None)

    def _types(self, name: str) -> tuple[Type, ...]:
        """Return the wire types of a parameter; empty for an undeclared parameter."""
        value = self._values.get(name)
        if value is None:
            return ()
        if isinstance(value, bool | str):
            return (PRIMS["boolean" if isinstance(value, bool) else "string"],)
        if isinstance(value, Sequence | np.ndarray):
            return Array((0,), PRIMS["double"]), Array((len(value),), PRIMS["double"])
        return (PRIMS["double"],)

    def _send_value(self, peer: Peer, name: str) -> None:
        if peer.encoder is not None:
            peer.push(peer.encoder.data(SampleType(name, self._subscribed[peer][name]), self._values[name]))


def _is_valid(value: Any) -> bool:
    """Return whether a value consists of finite numbers, or is text that every client can decode."""
    if isinstance(value, str):
        return "\0" not in value and not any("\ud800" <= one <= "\udfff" for one in value)
    return all(math.isfinite(one) for one in (value if isinstance(value, list) else [value]))
