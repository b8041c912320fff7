"""`LabCommServer`: rows, parameters and commands over TCP, for clients in any language that has LabComm.

One thread serves all ports. What the loop publishes goes into a bounded queue and wakes that thread: no client, slow,
silent, hostile or gone, is ever waited for. A fault closes the connection that made it, with one sentence.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

from armlab.bridge.events import Tell, nobody
from armlab.bridge.labcomm.channels import Channel, FusedArm, FusedSource
from armlab.bridge.labcomm.parameter_channel import Value
from armlab.bridge.labcomm.peer import Peer
from armlab.bridge.labcomm.rows import STOP, Row
from armlab.bridge.listening_socket import listening_socket
from armlab.errors import LabCommError, LinkError, UnknownName
from armlab.wire.labcomm import Definition, Encoder, Sample

__all__ = ["LabCommServer"]

_CLIENTS = 8  # per port
_KEPT = 100  # clients that have left, of which is known what they got
_PUBLISHED = 256  # items that wait for the server's thread
_LOOK = 0.05  # s between two looks at what is overdue
_SNIFF = 0.2  # s that a port which follows its client waits for the first packets


class LabCommServer:
    """Serves channels until it is closed; a context manager.

    Parameters
    ----------
    channels : the ports. host : address to listen on, this computer only by default. on_event : told who connects, who
        is closed and why, from the server's thread. on_stop : called there with the address of a client that sent the
        sample ``void stop``, on any port.

    Attributes
    ----------
    ports : the ports bound, by name of the channel. lost : published items that the server's thread was too slow for.

    Raises
    ------
    LinkError : a port cannot be bound.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        host: str = "127.0.0.1",
        on_event: Tell = nobody,
        on_stop: Callable[[str], None] = lambda client: None,
    ) -> None:
        self._channels = {channel.name: channel for channel in channels}
        self._peers: dict[str, list[Peer]] = {name: [] for name in self._channels}
        self._on_event, self._on_stop, self.lost = on_event, on_stop, 0
        self._published: deque[tuple[str, Any]] = deque()
        self._selector = selectors.DefaultSelector()
        self._awake, self._waker = socket.socketpair()
        self._awake.setblocking(False)
        self._waker.setblocking(False)
        self._listeners: list[socket.socket] = []
        self.ports: dict[str, int] = {}
        self._gone: dict[str, tuple[int, int]] = {}
        self._unknown: list[tuple[Channel, Peer, float]] = []  # clients whose dialect is awaited
        self._closing = False
        try:
            for channel in channels:
                self._listen(channel, host)
        except LinkError:
            self._close_sockets()
            raise
        self._selector.register(self._awake, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name="labcomm", daemon=True)
        self._thread.start()

    def __enter__(self) -> LabCommServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def row(self, name: str, row: Row) -> None:
        """Publish a row of an arm. Never waits.

        Parameters
        ----------
        name : of its channel. row : see `Row`.

        Raises
        ------
        UnknownName : no such channel.
        """
        self._publish(name, row)

    def fused(self, t_us: int, arms: Sequence[FusedArm] = (), sources: Sequence[FusedSource] = ()) -> None:
        """Publish a row of all sources. Never waits.

        Parameters
        ----------
        t_us : clock of the bridge [µs]. arms, sources : the newest of each.

        Raises
        ------
        UnknownName : there is no fused channel.
        """
        self._publish("fused", (t_us, tuple(arms), tuple(sources)))

    def parameter(self, name: str, value: Value) -> None:
        """Publish the value of a parameter that is now in force. Never waits.

        Parameters
        ----------
        name : of the parameter. value : as declared.

        Raises
        ------
        UnknownName : there is no parameter channel.
        """
        self._publish("parameters", (name, value))

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

    def close(self) -> None:
        """Close all connections and ports."""
        self._closing = True
        self._wake()
        self._thread.join()

    def _publish(self, name: str, item: Any) -> None:
        if name not in self._channels:
            raise UnknownName.among("channel of this server", name, self._channels)
        if len(self._published) >= _PUBLISHED:
            self.lost += 1
            return
        self._published.append((name, item))
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # a full pipe wakes too
            self._waker.send(b"\0")

    def _listen(self, channel: Channel, host: str) -> None:
        listener = listening_socket(host, channel.port, channel.name, 2 * _CLIENTS)
        self._listeners.append(listener)
        self.ports[channel.name] = listener.getsockname()[1]
        self._selector.register(listener, selectors.EVENT_READ, channel)

    def _serve(self) -> None:
        looked = time.monotonic()
        while not self._closing:
            for key, mask in self._selector.select(_LOOK):
                if key.fileobj is self._awake:
                    with contextlib.suppress(OSError):
                        self._awake.recv(4096)
                elif isinstance(key.data, Channel):
                    self._accept(key.fileobj, key.data)
                else:
                    channel, peer = key.data
                    self._turn(channel, peer, mask)
            self._deliver()
            now = time.monotonic()
            if now - looked > _LOOK or self._unknown:
                looked = now
                self._look(now)
        self._close_sockets()

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

    def _turn(self, channel: Channel, peer: Peer, mask: int) -> None:
        """Read from and write to one client, once."""
        if mask & selectors.EVENT_READ:
            reason = ""
            try:
                events = peer.read()
            except LabCommError as error:
                events, reason = error.events, f"offset {error.offset}: {error}"
            for event in events or ():
                self._settle(channel, peer, isinstance(event, Definition))
                try:
                    if isinstance(event, Sample) and (event.name, event.type) == (STOP.name, STOP.type):
                        self._on_stop(peer.address)
                    else:
                        channel.take(peer, event, self._peers[channel.name])
                except Exception as error:  # of the user's callback: the thread serves other clients too
                    what = f"{type(error).__name__}: {error}"
                    self._tell(f"{channel.name}: what {peer.address} sent was not taken, {what}", warn=True)
            if events is None or reason:
                self._drop(channel, peer, reason)
            if events:
                self._flush_all(channel)
        if mask & selectors.EVENT_WRITE:
            self._flush(channel, peer)

    def _deliver(self) -> None:
        """Queue what was published, and send it."""
        for _ in range(_PUBLISHED):
            if not self._published:
                break
            name, item = self._published.popleft()
            try:
                self._channels[name].put(item, self._peers[name])
            except Exception as error:  # a row of another shape: the thread goes on for the next
                self._tell(f"{name}: a row was not sent, {type(error).__name__}: {error}", warn=True)
            self._flush_all(self._channels[name])

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
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if peer.is_waiting else 0)
        with contextlib.suppress(KeyError):
            if self._selector.get_key(peer.socket).events != wanted:
                self._selector.modify(peer.socket, wanted, (channel, peer))

    def _drop(self, channel: Channel, peer: Peer, reason: str) -> None:
        peers = self._peers[channel.name]
        if peer not in peers:
            return
        self._gone[f"{channel.name} {peer.address}"] = (peer.sent, peer.dropped)
        if len(self._gone) > _KEPT:
            del self._gone[next(iter(self._gone))]
        peers.remove(peer)
        self._unknown = [entry for entry in self._unknown if entry[1] is not peer]
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(peer.socket)
        peer.close()
        channel.left(peer)
        why = f" was closed, {reason.rstrip('.')}" if reason else " left"
        lost = f"; {peer.dropped} packets were dropped for it" if peer.dropped else ""
        self._tell(f"{channel.name}: {peer.address}{why}{lost}.", warn=bool(reason))

    def _tell(self, text: str, warn: bool = False) -> None:
        with contextlib.suppress(Exception):  # who cannot log must not end the server
            self._on_event(text, warn)

    def _close_sockets(self) -> None:
        for peers in self._peers.values():
            for peer in peers:
                peer.close()
        for one in (*self._listeners, self._awake, self._waker):
            one.close()
        self._selector.close()
