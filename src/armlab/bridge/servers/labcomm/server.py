"""LabComm over TCP: `Ports` serves all sockets in one thread, and `LabCommServer` runs it in the background.

The server never waits for a client. A fault closes only the connection that caused it.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

from armlab.bridge.arbiter import Arbiter, Order
from armlab.bridge.net.events import Tell, nobody
from armlab.bridge.net.sockets import listening_socket
from armlab.bridge.servers.labcomm.channels import Channel, FusedArm, FusedSource, OnCommand, Peer, Value
from armlab.bridge.servers.labcomm.rows import STOP, Row
from armlab.errors import LabCommError, LinkError, UnknownName
from armlab.log import Tick
from armlab.state import Command, State
from armlab.wire.labcomm import Encoder, Sample
from armlab.wire.labcomm.types import Definition, Event

_CLIENTS = 8  # maximum number of clients per port
_KEPT = 100  # number of disconnected clients whose counts are kept
_CHECK_EVERY = 0.05  # s between timeout checks
_TURN = 4096  # maximum bytes read per turn from all clients together, because reading delays everything else
_LEAST = 256  # minimum share of each client [bytes]
_EVERY = 1.0  # s between events about refused samples of a client
_SNIFF = 0.15  # s that a port with follows_client waits for the client's first packets


class Ports:
    """Sockets of all channels; only `counts` and `clients` may be read from other threads."""

    def __init__(
        self, channels: Sequence[Channel], host: str, on_event: Tell, on_stop: Callable[[str], None], beside: Any
    ) -> None:
        self._channels = {channel.name: channel for channel in channels}
        self._peers: dict[str, list[Peer]] = {name: [] for name in self._channels}
        self._on_event, self._on_stop = on_event, on_stop
        self._selector = selectors.DefaultSelector()
        self._listeners: list[socket.socket] = []
        self.numbers: dict[str, int] = {}
        self._gone: dict[str, tuple[int, int]] = {}
        self._checked = time.monotonic()
        try:
            for channel in channels:
                self._listen(channel, host)
        except LinkError:
            self.close()
            raise
        self._selector.register(beside, selectors.EVENT_READ)

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Counts of clients, packets dropped for slow clients, and ignored and refused samples, by channel."""
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
        """Counts of data packets sent and dropped, by channel and address; includes disconnected clients."""
        here = {
            f"{name} {peer.address}": (peer.sent, peer.dropped)
            for name in self._channels
            for peer in list(self._peers[name])
        }
        return {**self._gone, **here}

    def has_clients(self, name: str) -> bool:
        """Return whether a channel has clients (False for an unknown channel)."""
        return bool(self._peers.get(name))

    def put(self, name: str, item: Any) -> None:
        """Send a published item to the clients of a channel."""
        channel = self._channels[name]
        try:
            channel.put(item, self._peers[name])
        except Exception as error:  # such as a row of the wrong shape; the next rows may be valid
            self._report(f"{name}: a row was not sent, {type(error).__name__}: {error}", warn=True)
        self._flush_all(channel)

    def turn(self) -> bool:
        """Wait at most 50 ms for client events, read a limited number of bytes per client, and return whether any event
        arrived."""
        ready = self._selector.select(_CHECK_EVERY)
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
        if now - self._checked > _CHECK_EVERY:
            self._checked = now
            self._check(now)
        return served

    def close(self) -> None:
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
            self._report(
                f"{channel.name}: the connection from {address} was closed, because {_CLIENTS} clients are connected.",
                warn=True,
            )
            return
        peer = Peer(connection, address, None if channel.follows_client else Encoder(channel.dialect))
        peers.append(peer)
        self._selector.register(connection, selectors.EVENT_READ, (channel, peer))
        self._report(f"{channel.name}: {address} connected.")
        channel.greet(peer)
        self._flush(channel, peer)

    def _serve(self, channel: Channel, peer: Peer, mask: int, most: int) -> None:
        """Read from and write to a client, once each."""
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
        if mask & selectors.EVENT_WRITE and peer in self._peers[channel.name]:
            self._flush(channel, peer)

    def _take(self, channel: Channel, peer: Peer, events: Iterable[Event]) -> None:
        has_stopped = False  # one stop per read is enough
        for event in events:
            if isinstance(event, Definition):
                self._settle(channel, peer)
            try:
                if isinstance(event, Sample) and (event.name, event.type) == (STOP.name, STOP.type):
                    if not has_stopped:
                        self._on_stop(peer.address)
                    has_stopped = True
                else:
                    channel.take(peer, event, self._peers[channel.name])
            except Exception as error:  # from the user's callback; keep serving the other clients
                self._refused(channel, peer, error)

    def _refused(self, channel: Channel, peer: Peer, error: Exception) -> None:
        """Count a refused sample; report the newest at most once per second for each client."""
        peer.refused += 1
        now = time.monotonic()
        if now - peer.reported >= _EVERY:
            peer.reported = now
            what = f"{type(error).__name__}: {error}"
            text = f"{channel.name}: a sample of {peer.address} was refused ({peer.refused} so far), {what}"
            self._report(text, warn=True)

    def _check(self, now: float) -> None:
        """Close clients that have timed out; greet clients whose dialect is still unknown after a timeout."""
        for name, peers in self._peers.items():
            channel = self._channels[name]
            for peer in list(peers):
                reason = peer.overdue(now)
                if reason:
                    self._drop(channel, peer, reason)
                elif peer.encoder is None and now - peer.began > _SNIFF:
                    self._settle(channel, peer)
                    self._flush(channel, peer)

    def _settle(self, channel: Channel, peer: Peer) -> None:
        """Choose the dialect of a client on a follows_client port, after its first definition or the timeout."""
        if peer.encoder is None:
            peer.encoder = Encoder(peer.decoder.dialect or channel.dialect)
            channel.greet(peer)

    def _flush_all(self, channel: Channel) -> None:
        """Send queued packets to all clients of a port, except blocked ones."""
        for peer in list(self._peers[channel.name]):
            if not peer.is_stuck:
                self._flush(channel, peer)

    def _flush(self, channel: Channel, peer: Peer) -> None:
        if not peer.flush():
            self._drop(channel, peer, "")
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if peer.is_waiting else 0)
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
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(peer.socket)
        peer.close()
        channel.left(peer)
        why = f" was closed, {reason.rstrip('.')}" if reason else " disconnected"
        lost = f"; {peer.dropped} packets to this client were dropped" if peer.dropped else ""
        refused = f"; {peer.refused} samples from this client were refused" if peer.refused else ""
        self._report(f"{channel.name}: {peer.address}{why}{lost}{refused}.", warn=bool(reason))

    def _report(self, text: str, warn: bool = False) -> None:
        with contextlib.suppress(Exception):  # a failing callback must not end the server
            self._on_event(text, warn)


_PUBLISHED = 256  # maximum number of items queued for the server's thread


class LabCommServer:
    """LabComm server that serves its channels in a background thread until closed; use it as a context manager.

    Parameters
    ----------
    channels : sequence of Channel
        One channel per port.
    host : str
        Address to listen on; default: this computer only.
    on_event : callable
        Called in the server's thread with a message when a client connects or disconnects.
    on_stop : callable
        Called in the server's thread with the address of a client that sent ``void stop`` on any port.

    Attributes
    ----------
    ports : dict
        Port numbers by channel name.
    lost : int
        Published items dropped because the server's thread was too slow.

    Raises
    ------
    LinkError
        A port cannot be bound.
    """

    lost: int = 0

    def __init__(
        self,
        channels: Sequence[Channel],
        host: str = "127.0.0.1",
        on_event: Tell = nobody,
        on_stop: Callable[[str], None] = lambda client: None,
    ) -> None:
        self._published: deque[tuple[str, Any]] = deque()
        self._awake, self._waker = socket.socketpair()
        self._awake.setblocking(False)
        self._waker.setblocking(False)
        self._closing = False
        try:
            self._ports = Ports(channels, host, on_event, on_stop, self._awake)
        except LinkError:
            self._close_waker()
            raise
        self.ports: dict[str, int] = self._ports.numbers
        self._thread = threading.Thread(target=self._serve, name="labcomm", daemon=True)
        self._thread.start()

    def __enter__(self) -> LabCommServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def row(self, name: str, row: Row) -> None:
        """Publish a row of an arm without blocking.

        Parameters
        ----------
        name : str
            Name of the arm's channel.
        row : Row
            The row.

        Raises
        ------
        UnknownName
            Unknown channel.
        """
        self._publish(name, row)

    def fused(self, t_us: int, arms: Sequence[FusedArm] = (), sources: Sequence[FusedSource] = ()) -> None:
        """Publish a row of all arms and sources; never block.

        Parameters
        ----------
        t_us : int, µs
            Time on the bridge clock.
        arms : sequence of FusedArm
            The newest row of each arm.
        sources : sequence of FusedSource
            The newest reading of each source.

        Raises
        ------
        UnknownName
            The server has no fused channel.
        """
        self._publish("fused", (t_us, tuple(arms), tuple(sources)))

    def parameter(self, name: str, value: Value) -> None:
        """Publish a parameter value that has taken effect, without blocking.

        Parameters
        ----------
        name : str
            Name of the parameter.
        value : float, bool, str or sequence of float
            New value, of the declared type.

        Raises
        ------
        UnknownName
            The server has no parameter channel.
        """
        self._publish("parameters", (name, value))

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Counts of clients, packets dropped for slow clients, and ignored and refused samples, by channel."""
        return self._ports.counts

    @property
    def clients(self) -> dict[str, tuple[int, int]]:
        """Counts of data packets sent and dropped, by channel and address; includes disconnected clients."""
        return self._ports.clients

    def close(self) -> None:
        """Close all connections and ports."""
        self._closing = True
        self._wake()
        self._thread.join()

    def _publish(self, name: str, item: Any) -> None:
        if name not in self.ports:
            raise UnknownName.among("channel of this server", name, self.ports)
        if len(self._published) >= _PUBLISHED:
            self.lost += 1
            return
        self._published.append((name, item))
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # a full pipe wakes the thread too
            self._waker.send(b"\0")

    def _serve(self) -> None:
        while not self._closing:
            self._ports.turn()
            with contextlib.suppress(BlockingIOError):
                self._awake.recv(4096)
            for _ in range(_PUBLISHED):
                if not self._published:
                    break
                self._ports.put(*self._published.popleft())
        self._ports.close()
        self._close_waker()

    def _close_waker(self) -> None:
        for one in (self._awake, self._waker):
            one.close()


class RowFeed:
    """Feed that publishes each row of a run; see `recording.Feed`. Torques are taken from the state.

    Parameters
    ----------
    server : LabCommServer
        Server that publishes the rows.
    channels : mapping
        Channel name by robot name. With each row of the first arm, a channel named "fused" receives the newest rows of
        all arms.
    """

    def __init__(self, server: LabCommServer, channels: Mapping[str, str]) -> None:
        self._server, self._channels = server, dict(channels)
        self._fused = "fused" in server.ports
        self._newest: dict[str, FusedArm] = {}

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Publish one row.

        Parameters
        ----------
        state : State
            State of the arm.
        command : Command
            Ignored.
        tick : Tick
            Ignored.
        """
        name = self._channels.get(state.robot)
        if name is None:
            return
        tm = state.robot_ns // 10**6 if state.robot_ns else round(1e3 * state.t)
        row = Row(tm, state.q, state.qd, state.tau)
        self._server.row(name, row)
        if self._fused:
            t_us = state.t_receive // 1000
            self._newest[name] = FusedArm(name, t_us, row)
            if name == next(iter(self._channels.values())):
                self._server.fused(t_us, list(self._newest.values()))

    def event(self, text: str, warn: bool = False) -> None:
        """Ignore an event, because rows cannot contain events.

        Parameters
        ----------
        text : str
            See `recording.Feed`.
        warn : bool
            See `recording.Feed`.
        """


def to_arbiter(arbiter: Arbiter, arm: str, order: Literal["abb", "chain"] = "abb") -> OnCommand:
    """Return a callback for an `ArmChannel` that submits its clients' commands to an arbiter.

    Parameters
    ----------
    arbiter : Arbiter
        The controller of the run; it must allow the server "labcomm".
    arm : str
        Name of the robot.
    order : str
        Joint order of the channel, used to number joints in error messages.
    """

    def submit(name: str, row: Row, client: str) -> None:
        arbiter.submit(Order(f"labcomm {client}", arm, row.q, row.qd, row.tau, by_axis=order == "abb"))

    return submit
