"""`Ports`: the sockets of a LabComm server, its listeners and their clients, served turn by turn by one thread.

No client, slow, silent, hostile or gone, is ever waited for. A fault closes the connection that made it, with one
sentence.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from armlab.bridge.net.events import Tell
from armlab.bridge.net.sockets import listening_socket
from armlab.bridge.servers.labcomm.channels import Channel
from armlab.bridge.servers.labcomm.connection import Peer
from armlab.bridge.servers.labcomm.rows import STOP
from armlab.errors import LabCommError, LinkError
from armlab.wire.labcomm import Encoder, Sample
from armlab.wire.labcomm.types import Definition, Event

__all__ = ["Ports"]

_CLIENTS = 8  # per port
_KEPT = 100  # clients that have left, of which is known what they got
_LOOK = 0.05  # s between two looks at what is overdue
_TURN = 4096  # bytes that a turn reads of all clients together: what they send in it delays everything else
_LEAST = 256  # of them for each
_EVERY = 1.0  # s between two sentences on what a client sent and was not taken
_SNIFF = 0.2  # s that a port which follows its client waits for the first packets


class Ports:
    """Serves channels, a turn at a time.

    on_stop : called with the address of a client that sent the sample ``void stop``, on any port.

    Raises
    ------
    LinkError : a port cannot be bound.

    Notes
    -----
    `counts` and `clients` may be read from any thread, everything else is for one.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        host: str,
        on_event: Tell,
        on_stop: Callable[[str], None],
        beside: Any,
    ) -> None:
        self._channels = {channel.name: channel for channel in channels}
        self._peers: dict[str, list[Peer]] = {name: [] for name in self._channels}
        self._on_event, self._on_stop = on_event, on_stop
        self._selector = selectors.DefaultSelector()
        self._listeners: list[socket.socket] = []
        self.numbers: dict[str, int] = {}
        self._gone: dict[str, tuple[int, int]] = {}
        self._unknown: list[tuple[Channel, Peer, float]] = []  # clients whose dialect is awaited
        self._full: set[Peer] = set()  # clients for whom something waits until the system takes it
        self._looked = time.monotonic()
        try:
            for channel in channels:
                self._listen(channel, host)
        except LinkError:
            self.close()
            raise
        self._selector.register(beside, selectors.EVENT_READ)

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Clients, packets dropped for slow ones, and what was ignored or refused, by channel."""
        return {
            name: {
                "clients": len(self._peers[name]),
                "dropped": sum(peer.dropped for peer in list(self._peers[name])),
                **channel.counts,
            }
            for name, channel in self._channels.items()
        }

    @property
    def clients(self) -> dict[str, tuple[int, int]]:
        """Data packets sent to each client and dropped for it, by channel and address; also of those that have left."""
        here = {
            f"{name} {peer.address}": (peer.sent, peer.dropped)
            for name in self._channels
            for peer in list(self._peers[name])
        }
        return {**self._gone, **here}

    def has_clients(self, name: str) -> bool:
        """Return whether anybody would get what is published on a channel; False when there is none of that name."""
        return bool(self._peers.get(name))

    def put(self, name: str, item: Any) -> None:
        """Send what the bridge publishes to the clients of a channel."""
        channel = self._channels[name]
        try:
            channel.put(item, self._peers[name])
        except Exception as error:  # a row of another shape: the server goes on for the next
            self._tell(f"{name}: a row was not sent, {type(error).__name__}: {error}", warn=True)
        self._flush_all(channel)

    def turn(self) -> bool:
        """Wait until something comes, 50 ms at most, and serve the clients it comes from; return whether any did.

        A little of each: who sends without pause has a share of the turn, and costs the others no more than that.
        """
        ready = self._selector.select(_LOOK)
        served, most = False, max(_TURN // max(len(ready), 1), _LEAST)
        for key, mask in ready:
            if key.data is None:
                continue
            served = True
            if isinstance(key.data, Channel):
                self._accept(key.fileobj, key.data)
            else:
                channel, peer = key.data
                self._serve(channel, peer, mask, most)
        now = time.monotonic()
        if now - self._looked > _LOOK or self._unknown:
            self._looked = now
            self._look(now)
        return served

    def close(self) -> None:
        """Close all connections and ports."""
        for peers in self._peers.values():
            for peer in peers:
                peer.close()
        for one in self._listeners:
            one.close()
        self._selector.close()

    def _listen(self, channel: Channel, host: str) -> None:
        listener = listening_socket(host, channel.port, channel.name, 2 * _CLIENTS)
        self._listeners.append(listener)
        self.numbers[channel.name] = listener.getsockname()[1]
        self._selector.register(listener, selectors.EVENT_READ, channel)

    def _accept(self, listener: Any, channel: Channel) -> None:
        try:
            connection, (host, port, *_) = listener.accept()
        except OSError:
            return
        address, peers = f"{host}:{port}", self._peers[channel.name]
        if len(peers) >= _CLIENTS:
            connection.close()
            self._tell(f"{channel.name}: {address} was closed, {_CLIENTS} clients are connected.", warn=True)
            return
        peer = Peer(connection, address, None if channel.follows_client else Encoder(channel.dialect))
        peers.append(peer)
        self._selector.register(connection, selectors.EVENT_READ, (channel, peer))
        self._tell(f"{channel.name}: {address} connected.")
        if peer.encoder is None:
            self._unknown.append((channel, peer, peer.began + _SNIFF))
        else:
            channel.greet(peer)
            self._flush(channel, peer)

    def _serve(self, channel: Channel, peer: Peer, mask: int, most: int) -> None:
        """Read from and write to one client, once."""
        if mask & selectors.EVENT_READ:
            reason = ""
            try:
                events = peer.read(most)
            except LabCommError as error:
                events, reason = error.events, f"offset {error.offset}: {error}"
            self._take(channel, peer, events or ())
            if events is None or reason:
                self._drop(channel, peer, reason)
            if events:
                self._flush_all(channel)
        if mask & selectors.EVENT_WRITE:
            self._flush(channel, peer)

    def _take(self, channel: Channel, peer: Peer, events: Iterable[Event]) -> None:
        has_stopped = False  # one stop of a read is enough
        for event in events:
            self._settle(channel, peer, isinstance(event, Definition))
            try:
                if isinstance(event, Sample) and (event.name, event.type) == (STOP.name, STOP.type):
                    if not has_stopped:
                        self._on_stop(peer.address)
                    has_stopped = True
                else:
                    channel.take(peer, event, self._peers[channel.name])
            except Exception as error:  # of the user's callback: other clients are served too
                self._refused(channel, peer, error)

    def _refused(self, channel: Channel, peer: Peer, error: Exception) -> None:
        """Count what was not taken; tell the newest, once a second for each client."""
        peer.refused += 1
        now = time.monotonic()
        if now - peer.told >= _EVERY:
            peer.told = now
            what = f"{type(error).__name__}: {error}"
            text = f"{channel.name}: what {peer.address} sent was not taken ({peer.refused} so far), {what}"
            self._tell(text, warn=True)

    def _look(self, now: float) -> None:
        """Close whom patience has ended for; speak to clients whose dialect was awaited."""
        for channel, peer, until in list(self._unknown):
            if now > until:
                self._settle(channel, peer, is_over=True)
                self._flush(channel, peer)
        for name, peers in self._peers.items():
            for peer in list(peers):
                reason = peer.overdue(now)
                if reason:
                    self._drop(self._channels[name], peer, reason)

    def _settle(self, channel: Channel, peer: Peer, is_over: bool) -> None:
        """Choose the dialect for a client of a port that follows it, once a definition or the time tells."""
        if peer.encoder is None and is_over:
            self._unknown = [entry for entry in self._unknown if entry[1] is not peer]
            peer.encoder = Encoder(peer.decoder.dialect or channel.dialect)
            channel.greet(peer)

    def _flush_all(self, channel: Channel) -> None:
        """Send what is queued to all clients of a port but those that take nothing now."""
        for peer in list(self._peers[channel.name]):
            if not peer.is_stuck:
                self._flush(channel, peer)

    def _flush(self, channel: Channel, peer: Peer) -> None:
        if not peer.flush():
            self._drop(channel, peer, "")
        elif peer.is_waiting != (peer in self._full):
            self._full ^= {peer}
            wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if peer.is_waiting else 0)
            self._selector.modify(peer.socket, wanted, (channel, peer))

    def _drop(self, channel: Channel, peer: Peer, reason: str) -> None:
        peers = self._peers[channel.name]
        if peer not in peers:
            return
        self._gone[f"{channel.name} {peer.address}"] = (peer.sent, peer.dropped)
        if len(self._gone) > _KEPT:
            del self._gone[next(iter(self._gone))]
        peers.remove(peer)
        self._full.discard(peer)
        self._unknown = [entry for entry in self._unknown if entry[1] is not peer]
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(peer.socket)
        peer.close()
        channel.left(peer)
        why = f" was closed, {reason.rstrip('.')}" if reason else " left"
        lost = f"; {peer.dropped} packets were dropped for it" if peer.dropped else ""
        refused = f"; {peer.refused} samples of it were not taken" if peer.refused else ""
        self._tell(f"{channel.name}: {peer.address}{why}{lost}{refused}.", warn=bool(reason))

    def _tell(self, text: str, warn: bool = False) -> None:
        with contextlib.suppress(Exception):  # who cannot log must not end the server
            self._on_event(text, warn)
