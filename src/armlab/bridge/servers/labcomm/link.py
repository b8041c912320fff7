"""`labcomm://host:7511` as a link: `RowPort` and `RowCodec` let the loop run on another computer than the bridge.

The loop sees rows as it sees packets of EGM: each is a packet with a number counted here, answered by one command row.
Rows have no states of motors or RAPID: the bridge at the other end knows them and holds by itself.
"""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import time
from collections import deque
from typing import Any, cast

import numpy as np

from armlab.bridge.net.sockets import Arrival, Port
from armlab.bridge.servers.labcomm.client import connected
from armlab.bridge.servers.labcomm.connection import Peer
from armlab.bridge.servers.labcomm.rows import Row, RowTypes
from armlab.bridge.servers.row import RowsAsPackets
from armlab.errors import ConfigError, LabCommError
from armlab.robots import Robot
from armlab.wire.egm import Codec, Drop, Packet, Reference
from armlab.wire.labcomm import Encoder
from armlab.wire.labcomm.types import Event

_PATIENCE = 5.0  # s for the first connection
_AGAIN = 0.5  # s between two tries to connect again
_MOTORS_ON, _MCI_RUNNING, _RAPID_RUNNING = 1, 3, 2
_NAN = np.full(7, math.nan)


def far_end(robot: Robot, host: str, port: int, options: dict[str, str]) -> tuple[Port, Codec]:
    """Return the port and codec of an arm behind a LabComm server."""
    unknown = sorted(set(options) - {"order", "dialect"})
    if unknown:
        raise ConfigError(f"Expected only order and dialect as options of a labcomm link, got {', '.join(unknown)}.")
    order: Any = options.get("order", "abb")
    types, dialect = RowTypes(robot.abb_axes, order), options.get("dialect", "2014v1")
    codec = RowCodec(robot, types, dialect)
    return cast(Port, RowPort(host, port, types, dialect)), codec


class RowPort:
    """A connection to a LabComm server in place of a bound UDP port; it connects again by itself.

    Never blocks and never raises after construction; what goes wrong is counted.
    """

    def __init__(self, host: str, port: int, types: RowTypes, dialect: str = "2014v1") -> None:
        self.host, self.port, self.errors = host, port, 0
        self._types, self._dialect = types, dialect
        self._form = struct.Struct(f">Ii{3 * types.n}d")
        Encoder(dialect)
        self._socket = connected(host, port, _PATIENCE)
        self._address = self._socket.getpeername()
        self._fresh: socket.socket | None = None  # a connection that was begun
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
        """Return the next row as a packet for `RowCodec`, or None when there is none."""
        if not self._rows:
            self._read()
        return self._rows.popleft() if self._rows else None

    def flush(self) -> None:
        """Throw away rows that came while nobody listened."""
        for _ in range(1000):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one command, dropping those that still wait. Return whether there is a connection."""
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
        encoder = Encoder(self._dialect)
        peer = Peer(self._socket, f"{self.host}:{self.port}", encoder)
        peer.push(encoder.version(), may_drop=False)
        peer.push(encoder.define(self._types.accepted), may_drop=False)
        peer.flush()
        return peer

    def _lose(self) -> None:
        """Put a socket that never has anything in place of the connection, and try again soon."""
        self.errors += 1
        self._peer, self._count, self._retry = None, 0, time.monotonic() + _AGAIN
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as idle:
            os.dup2(idle.fileno(), self._socket.fileno(), inheritable=False)

    def _connect_again(self) -> None:
        """Begin a connection when it is time, and see whether one that was begun is there. Never waits."""
        now = time.monotonic()
        if self._fresh is None:
            if now >= self._retry:
                self._retry = now + _AGAIN
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
    """Rows as packets of the loop."""

    def __init__(self, robot: Robot, types: RowTypes, dialect: str = "2014v1") -> None:
        super().__init__()
        self._n, self._types, self._form = robot.n, types, struct.Struct(f">Ii{3 * robot.n}d")
        self._encoder = Encoder(dialect)
        self._encoder.define(types.accepted)
        self._nan, self._nan44 = np.full(robot.n, math.nan), np.full((4, 4), math.nan)
        for array in (self._nan, self._nan44):
            array.flags.writeable = False

    def decode(self, data: bytes) -> Packet | Drop:
        """Return the packet of a row, or why it is dropped."""
        if len(data) != self._form.size:
            return Drop("unparsable", f"{len(data)} bytes are no row")
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
