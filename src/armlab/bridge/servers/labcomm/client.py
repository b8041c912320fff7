"""Clients of a LabComm server: `LabCommClient`, `LabCommSource`, and the port and codec of row links."""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import numpy as np

from armlab.bridge.inputs.sources import Reading, ThreadSource, whole
from armlab.bridge.net.sockets import Arrival, Port
from armlab.bridge.servers.labcomm.channels import Peer
from armlab.bridge.servers.labcomm.rows import STOP, Row, RowTypes
from armlab.bridge.servers.row import RowsAsPackets
from armlab.errors import ArmlabError, ConfigError, LabCommError, LinkError
from armlab.log import Column
from armlab.robots import Robot
from armlab.wire.egm import Codec, Drop, Packet, Reference
from armlab.wire.labcomm import Encoder, Sample
from armlab.wire.labcomm.types import Event, SampleType


def connected(host: str, port: int, patience: float) -> socket.socket:
    try:
        return socket.create_connection((host, port), timeout=patience)
    except (OSError, OverflowError) as error:
        raise LinkError(
            f"Expected a LabComm server at {host}:{port}, got: {error}. "
            "Start the server (armlab bridge), or check the address."
        ) from error


def greeted(connection: socket.socket, address: str, encoder: Encoder, samples: Iterable[SampleType]) -> Peer:
    """Return a peer whose queue contains VERSION and the definitions of the given types."""
    peer = Peer(connection, address, encoder)
    peer.push(encoder.version(), may_drop=False)
    for sample in samples:
        peer.push(encoder.define(sample), may_drop=False)
    return peer


class LabCommClient:
    """Client of one port of a LabComm server; use it as a context manager.

    Parameters
    ----------
    host : str
        Address of the server.
    port : int
        Port of the server: 7511 (left arm), 7512 (right arm), 7513 (parameters) or 7514 (fused rows).
    dialect : str
        Dialect of sent packets; the dialect of received packets is detected.
    types : RowTypes
        Sample types and joint order, for an arm's port.
    patience : float, s
        Time to wait for the connection.

    Attributes
    ----------
    host : str
        Address of the server.
    port : int
        Port of the server.
    samples : dict
        Types defined by the server, by index.

    Raises
    ------
    LinkError
        No server is listening at that address.
    UnknownName
        Unknown dialect.
    """

    host: str
    port: int

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 7511,
        dialect: str = "2014v1",
        types: RowTypes | None = None,
        patience: float = 5.0,
    ) -> None:
        self.host, self.port = host, port
        self._types, self._dialect, self._patience = types or RowTypes(), dialect, patience
        self._defined: list[SampleType] = []
        self._open()

    def __enter__(self) -> LabCommClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection, which releases control of the arm."""
        self._peer.close()

    @property
    def samples(self) -> dict[int, SampleType]:
        """Types defined by the server, by index."""
        return self._peer.decoder.samples

    def define(self, sample: SampleType) -> None:
        """Define a type; a parameter server replies with the value.

        Parameters
        ----------
        sample : SampleType
            Name and type.
        """
        if sample not in self._defined:
            self._defined.append(sample)
            self._push(self._encoder.define(sample), may_drop=False)

    def send(self, sample: SampleType, value: Any) -> None:
        """Send a value after its type definition.

        Parameters
        ----------
        sample : SampleType
            Name and type.
        value : object
            See `wire.labcomm.Sample`.

        Raises
        ------
        LabCommError
            The value does not match the type.
        LinkError
            The connection is closed.
        """
        self.define(sample)
        self._push(self._encoder.data(sample, value))

    def command(self, row: Row) -> None:
        """Send a command to the arm: a position, optionally a velocity and a torque.

        Unsent older commands are dropped.

        Parameters
        ----------
        row : Row
            Command in kinematic joint order, with the `tm` of the row to which it responds.

        Raises
        ------
        LabCommError
            Wrong number of joints.
        LinkError
            The connection is closed.
        """
        self._peer.clear()
        self.send(self._types.accepted, self._types.value(row, self._types.accepted))

    def stop(self) -> None:
        """Bring all arms of the bridge to rest; only an operator can end the stop.

        Raises
        ------
        LinkError
            The connection is closed.
        """
        self._peer.clear()
        self.send(STOP, {})

    def events(self, seconds: float) -> list[Event]:
        """Return the received events; wait for the first one if necessary.

        Parameters
        ----------
        seconds : float, s
            Maximum waiting time.

        Raises
        ------
        LinkError
            The server has closed the connection, or its stream is malformed.
        """
        return self._awaited(seconds, lambda events: events)

    def rows(self, seconds: float) -> list[Row]:
        """Return the received rows of the arm; wait for the first one if necessary.

        Parameters
        ----------
        seconds : float, s
            Maximum waiting time.

        Raises
        ------
        LinkError
            The server has closed the connection, or its stream is malformed.
        """
        return self._awaited(seconds, self._types.rows)

    def _awaited(self, seconds: float, selected: Callable[[list[Event]], list[Any]]) -> list[Any]:
        """Return the selected events as soon as any arrive, or an empty list after `seconds`."""
        end, left = time.monotonic() + seconds, max(seconds, 0.0)
        while True:
            self._flush()
            select.select([self._peer.socket], [], [], left)
            try:
                events = self._peer.read()
            except LabCommError as error:
                raise LinkError(f"The stream of {self.host}:{self.port} is malformed. {error}") from error
            if events is None:
                raise self._gone()
            found = selected(events)
            left = 0.0 if found else max(end - time.monotonic(), 0.0)
            if not left:
                return found

    def run(self, on_row: Callable[[Row], Row | None], seconds: float | None = None, reconnects: bool = True) -> int:
        """Call a function with the newest row after each read and send its result; return the number of calls.

        Parameters
        ----------
        on_row : callable
            Maps a Row to a command, or to None to send nothing.
        seconds : float, s
            Time to run; default: until the connection is closed.
        reconnects : bool
            Try to reconnect for up to `patience` seconds after a disconnection.

        Raises
        ------
        LinkError
            The connection is closed, or no row arrived for `patience` seconds.
        """
        end = None if seconds is None else time.monotonic() + seconds
        calls, received = 0, time.monotonic()
        while end is None or time.monotonic() < end:
            try:
                rows = self.rows(0.1)
                if rows:
                    received = time.monotonic()
                    calls += 1
                    answer = on_row(rows[-1])
                    if answer is not None:
                        self.command(answer)
            except LinkError:
                if not reconnects:
                    raise
                self.close()
                self._reconnect()
            if time.monotonic() - received > self._patience:
                raise LinkError(f"Expected rows from {self.host}:{self.port}, got none for {self._patience:g} s.")
        return calls

    def _open(self) -> None:
        self._encoder = Encoder(self._dialect)
        connection = connected(self.host, self.port, self._patience)
        self._peer = greeted(connection, f"{self.host}:{self.port}", self._encoder, self._defined)
        self._flush()

    def _reconnect(self) -> None:
        end = time.monotonic() + self._patience
        while True:
            try:
                self._open()
                return
            except LinkError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.1)

    def _push(self, packet: bytes, may_drop: bool = True) -> None:
        self._peer.push(packet, may_drop)
        self._flush()

    def _flush(self) -> None:
        """Send queued packets."""
        if self._peer.socket.fileno() < 0 or not self._peer.flush():
            raise self._gone()

    def _gone(self) -> LinkError:
        if self._peer.socket.fileno() < 0:
            return LinkError(
                f"The connection to {self.host}:{self.port} was closed by this program. Create a new client."
            )
        return LinkError(f"The LabComm server at {self.host}:{self.port} closed the connection.")


_AGAIN = 0.5  # s between attempts to connect
_POLL = 0.1  # s
_STAMPS = {"t_us": 1000, "tm": 10**6}  # ns per unit


class LabCommSource(ThreadSource):
    """Source that receives one sample type in a reconnecting thread; the field t_us or tm is its timestamp."""

    host: str
    port: int
    problem: str

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Column],
        period: float,
        port: int,
        host: str = "127.0.0.1",
        sample: str | None = None,
        dialect: str = "2014v1",
        **options: Any,
    ) -> None:
        super().__init__(name, fields, period, **options)
        self.host, self.port, self._sample, self._dialect = host, port, sample, dialect

    def work(self) -> None:
        """Connect and read until closed; reconnect after errors."""
        while not self._over.is_set():
            try:
                with LabCommClient(self.host, self.port, self._dialect, patience=_AGAIN) as client:
                    while not self._over.is_set():
                        for event in client.events(_POLL):
                            if isinstance(event, Sample):
                                self._take(event)
            except LinkError as error:
                self.problem = str(error)
                self._over.wait(_AGAIN)

    def _take(self, sample: Sample) -> None:
        if self._sample not in (None, sample.name):
            return
        value = sample.value if isinstance(sample.value, dict) else {next(iter(self.fields)): sample.value}
        given = {name: value[name] for name in self.fields if name in value}
        if len(given) < len(self.fields):
            if self._sample is not None:
                missing = ", ".join(name for name in self.fields if name not in given)
                self.problem = f"Expected {missing} in the sample {sample.name}, got {', '.join(value)}."
            return
        last = self._newest
        try:
            stamp_ns = next((whole(value[name], unit) for name, unit in _STAMPS.items() if name in value), 0)
            values = self.values(given)
        except (ArmlabError, ValueError) as error:
            self.problem = str(error)
            return
        self._newest = Reading(values, stamp_ns, time.monotonic_ns(), 0 if last is None else last.seq + 1)


_FIRST = 5.0  # s for the first connection
_RECONNECT = 0.5  # s between attempts to reconnect
_MOTORS_ON, _MCI_RUNNING, _RAPID_RUNNING = 1, 3, 2
_NAN = np.full(7, math.nan)


def far_end(robot: Robot, host: str, port: int, options: dict[str, str]) -> tuple[Port, Codec]:
    """Return the port and codec of an arm behind a LabComm server."""
    unknown = sorted(set(options) - {"order", "dialect"})
    if unknown:
        raise ConfigError(f"Expected only the options order and dialect in a labcomm link, got {', '.join(unknown)}.")
    order: Any = options.get("order", "abb")
    types, dialect = RowTypes(robot.abb_axes, order), options.get("dialect", "2014v1")
    codec = RowCodec(robot, types, dialect)
    return cast(Port, RowPort(host, port, types, dialect)), codec


class RowPort:
    """Connection to a LabComm server in place of a UDP port; it counts errors, reconnects, and never blocks."""

    host: str
    port: int
    errors: int

    def __init__(self, host: str, port: int, types: RowTypes, dialect: str = "2014v1") -> None:
        self.host, self.port, self.errors = host, port, 0
        self._types, self._dialect = types, dialect
        self._form = struct.Struct(f">Ii{3 * types.n}d")
        Encoder(dialect)
        self._socket = connected(host, port, _FIRST)
        self._address = self._socket.getpeername()
        self._fresh: socket.socket | None = None  # connection being established
        self._rows: deque[Arrival] = deque()
        self._count, self._retry = 0, math.inf
        self._peer: Peer | None = self._greeted()

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()
        if self._fresh is not None:
            self._fresh.close()

    def receive(self) -> Arrival | None:
        """Return the next row as a packet for `RowCodec`, or None."""
        if not self._rows:
            self._read()
        return self._rows.popleft() if self._rows else None

    def flush(self) -> None:
        """Discard all queued rows."""
        for _ in range(1000):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one command and drop older unsent commands; return whether the port is connected."""
        if self._peer is None:
            return False
        self._peer.clear()
        self._peer.push(data)
        if self._peer.flush():
            return True
        self._lose()
        return False

    def _read(self) -> None:
        if self._peer is None:
            self._connect_again()
            return
        events: list[Event] | None
        try:
            events, is_gone = self._peer.read(), False
        except LabCommError as error:
            events, is_gone = error.events, True
        now = time.monotonic_ns()
        for row in self._types.rows(events or ()):
            parts = [_NAN[: self._types.n] if part is None else part for part in (row.q, row.qd, row.tau)]
            data = self._form.pack(self._count, row.tm, *np.concatenate(parts).tolist())
            self._rows.append(Arrival(data, (self.host, self.port), now))
            self._count += 1
        if events is None or is_gone:
            self._lose()

    def _greeted(self) -> Peer:
        address, encoder = f"{self.host}:{self.port}", Encoder(self._dialect)
        peer = greeted(self._socket, address, encoder, [self._types.accepted])
        peer.flush()
        return peer

    def _lose(self) -> None:
        """Replace the connection with an idle placeholder socket and schedule a reconnection."""
        self.errors += 1
        self._peer, self._count, self._retry = None, 0, time.monotonic() + _RECONNECT
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as idle:
            os.dup2(idle.fileno(), self._socket.fileno(), inheritable=False)

    def _connect_again(self) -> None:
        """Start or finish a reconnection when due; never block."""
        now = time.monotonic()
        if self._fresh is None:
            if now >= self._retry:
                self._retry = now + _RECONNECT
                self._fresh = socket.socket(self._socket.family, socket.SOCK_STREAM)
                self._fresh.setblocking(False)
                self._fresh.connect_ex(self._address)
            return
        _, is_done, _ = select.select([], [self._fresh], [], 0.0)
        if not is_done and now < self._retry:
            return
        failed = not is_done or self._fresh.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if not failed:
            os.dup2(self._fresh.fileno(), self._socket.fileno(), inheritable=False)
            self._peer = self._greeted()
        self._fresh.close()
        self._fresh = None
        self.errors += bool(failed)


class RowCodec(RowsAsPackets):
    """Codec that converts rows to packets for the loop, and references to commands."""

    def __init__(self, robot: Robot, types: RowTypes, dialect: str = "2014v1") -> None:
        super().__init__()
        self._n, self._types, self._form = robot.n, types, struct.Struct(f">Ii{3 * robot.n}d")
        self._encoder = Encoder(dialect)
        self._encoder.define(types.accepted)
        self._nan, self._nan44 = np.full(robot.n, math.nan), np.full((4, 4), math.nan)
        for array in (self._nan, self._nan44):
            array.flags.writeable = False

    def decode(self, data: bytes) -> Packet | Drop:
        """Convert a row to a packet, or return the reason for dropping the row."""
        if len(data) != self._form.size:
            return Drop("unparsable", f"{len(data)} bytes are not a row")
        count, tm, *_ = self._form.unpack(data)
        q, qd, tau = np.frombuffer(data, ">f8", offset=8).astype(float).reshape(3, self._n)
        for part in (q, qd, tau):
            part.flags.writeable = False
        return self._packet(
            q,
            qd,
            tau,
            seqno=count,
            tm_ms=tm % 2**32,
            robot_ns=0,
            q_planned=self._nan,
            q_ext=self._nan[:0],
            T_frame_tool=self._nan44,
            wrench_raw=self._nan44.reshape(-1)[:6],
            motors=_MOTORS_ON,
            mci=_MCI_RUNNING,
            rapid=_RAPID_RUNNING,
            converged=False,
            utilization=math.nan,
        )

    def encode(self, ref: Reference) -> bytes:
        types = self._types
        return self._encoder.data(types.accepted, types.value(Row(ref.tm_ms, ref.q, ref.qd, ref.tau), types.accepted))
