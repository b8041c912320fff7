"""What each port of a LabComm server sends and accepts: `ArmChannel`, `FusedChannel`; see also `parameter_channel`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from armlab.bridge.labcomm.peer import Peer
from armlab.bridge.labcomm.rows import Order, Row, RowTypes
from armlab.errors import ConfigError, LabCommError
from armlab.wire.labcomm import Event, Sample, SampleType, idl
from armlab.wire.labcomm.dialects import dialect_named

__all__ = ["ArmChannel", "Channel", "FusedArm", "FusedChannel", "FusedSource", "OnCommand"]

OnCommand = Callable[[str, Row, str], None]
"""Called with the name of the channel, a valid command and the address of its client."""


class Channel:
    """One port.

    Parameters
    ----------
    name, port : port 0 lets the system choose. dialect : that the server speaks.
    follows_client : wait up to 200 ms for the client's first packets and speak their dialect.

    Attributes
    ----------
    counts : what was ignored or refused, by reason.
    """

    def __init__(self, name: str, port: int, dialect: str = "2014v1", follows_client: bool = False) -> None:
        self.name, self.port, self.follows_client = name, port, follows_client
        self.dialect = dialect_named(dialect).name
        self.counts: Counter[str] = Counter()

    def greet(self, peer: Peer) -> None:
        """Queue what a client gets on accept.

        Parameters
        ----------
        peer : whose encoder is set.
        """
        if peer.encoder is not None:
            peer.push(peer.encoder.version(), may_drop=False)

    def take(self, peer: Peer, event: Event, peers: Iterable[Peer]) -> None:
        """Take one event of a client; by default data is read and dropped.

        Parameters
        ----------
        peer : the client. event : from its stream. peers : all of this channel.
        """
        self.counts["ignored"] += isinstance(event, Sample)

    def left(self, peer: Peer) -> None:
        """Forget a client that is gone.

        Parameters
        ----------
        peer : the client.
        """

    def put(self, item: Any, peers: Iterable[Peer]) -> None:
        """Queue what the bridge publishes for all clients.

        Parameters
        ----------
        item : what the channel's maker passes. peers : all of this channel.
        """
        raise NotImplementedError


def _send(sample: SampleType, value: Any, peers: Iterable[Peer]) -> None:
    """Queue a value of the one type of a port; it has the same bytes in every stream of a dialect."""
    packets: dict[str, bytes] = {}
    for peer in peers:
        if peer.encoder is not None:
            dialect = peer.encoder.dialect
            if dialect not in packets:
                packets[dialect] = peer.encoder.data(sample, value)
            peer.push(packets[dialect])


class ArmChannel(Channel):
    """Rows of one arm out, commands in.

    Which client may command is not decided here: see `rights.Arbiter`.

    Parameters
    ----------
    name : of the arm. port : 7511 for a left arm, 7512 for a right one.
    on_command, on_left : called in the server's thread; the second with the address of a client that is gone.
    axes, order, types : see `RowTypes`. dialect, follows_client : see `Channel`.
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
        self.types = RowTypes(axes, order, types)
        self._on_command, self._on_left = on_command, on_left

    def greet(self, peer: Peer) -> None:
        """Queue VERSION and the definition of the row; rows follow."""
        super().greet(peer)
        if peer.encoder is not None:
            peer.push(peer.encoder.define(self.types.sent), may_drop=False)

    def put(self, item: Row, peers: Iterable[Peer]) -> None:
        """Queue one row for all clients."""
        _send(self.types.sent, self.types.value(item), peers)

    def take(self, peer: Peer, event: Event, peers: Iterable[Peer]) -> None:
        """Take a command; what is none is counted, and told by the server.

        Raises
        ------
        LabCommError : a sample of another type, or values that are no command.
        """
        if not isinstance(event, Sample):
            return
        if not self.types.accepts(SampleType(event.name, event.type)):
            self.counts["other type"] += 1
            raise LabCommError(f"Expected {self.types.accepted.name} on this port, got a sample {event.name!r}.")
        try:
            row = self.types.command(event.value)
        except LabCommError:
            self.counts["refused"] += 1
            raise
        self.counts["commands"] += 1
        if self._on_command is not None:
            self._on_command(self.name, row, peer.address)

    def left(self, peer: Peer) -> None:
        """Tell that a client is gone."""
        self._on_left(peer.address)


class FusedArm(NamedTuple):
    """An arm in a fused row: name, clock of the bridge at its arrival [µs], and its row."""

    name: str
    t_us: int
    row: Row


class FusedSource(NamedTuple):
    """A source in a fused row: name, clock of the bridge at its arrival [µs], and its values."""

    name: str
    t_us: int
    value: Sequence[float] | np.ndarray


class FusedChannel(Channel):
    """Rows of all arms and sources out; what clients send is dropped.

    Parameters
    ----------
    port : 7514 by default. axes, order, dialect, follows_client : as of `ArmChannel`.
    """

    def __init__(
        self,
        port: int = 7514,
        axes: Sequence[int] = (1, 2, 7, 3, 4, 5, 6),
        order: Order = "abb",
        dialect: str = "2014v1",
        follows_client: bool = False,
    ) -> None:
        super().__init__("fused", port, dialect, follows_client)
        self._sample = idl.samples("armlab")["fused_row"]
        self._types = RowTypes(axes, order)
        if self._types.n != 7:
            raise ConfigError(f"Expected arms of 7 joints for fused rows, got {self._types.n}.")

    def greet(self, peer: Peer) -> None:
        """Queue VERSION and the definition of the row; rows follow."""
        super().greet(peer)
        if peer.encoder is not None:
            peer.push(peer.encoder.define(self._sample), may_drop=False)

    def put(self, item: tuple[int, Sequence[FusedArm], Sequence[FusedSource]], peers: Iterable[Peer]) -> None:
        """Queue one fused row for all clients: (t_us, arms, sources)."""
        t_us, arms, sources = item
        value = {
            "t_us": t_us,
            "arm": [{"name": one.name, "t_us": one.t_us, **self._types.value(one.row)} for one in arms],
            "source": [one._asdict() for one in sources],
        }
        _send(self._sample, value, peers)
