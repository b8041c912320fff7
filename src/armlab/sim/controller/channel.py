"""`UdpClient`: UDP client of one motion task; `Faults`: seeded random faults in each direction."""

from __future__ import annotations

import heapq
import math
import select
import socket
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from armlab.errors import ConfigError, LinkError
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.settings import FaultRates
from armlab.wire.egm.robot_side import SensorMessage

_LARGEST = 65535
_DRAINED = 64  # maximum number of datagrams read per cycle, even in a flood
_SO_TIMESTAMPNS = 35  # Linux: the kernel stamps arrivals; Python's socket module lacks the constant
_LOOK = 0.25  # s between checks on whether to keep waiting
_FIRST = 0.5  # s to wait for the first reply to a stream, after which the peer counts as a listener
_REFUSED_PAUSE = 0.05  # s before a packet is resent to a port that is not bound yet


class UdpClient:
    """One controller and its socket; it sends packets `phase` seconds after the common start of the cycle."""

    controller: SimulatedController
    phase: float

    def __init__(
        self,
        controller: SimulatedController,
        host: str,
        port: int,
        outgoing: Faults | None = None,
        incoming: Faults | None = None,
        phase: float = 0.0,
    ) -> None:
        self.controller, self.phase = controller, phase
        if not 0.0 <= phase < controller.arm.period:
            raise ConfigError(f"Expected a phase of at least 0 s and below the period, got {phase:g} s.")
        self._outgoing, self._incoming = outgoing, incoming
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise LinkError(f"Expected an address to send to, got {host}:{port} ({error}). Correct it.") from error
        self._socket.setblocking(False)
        with suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self._packet: bytes | None = None
        self._expected, self._newest, self._arrival = 0, -1, 0
        self._refused = self._awaited = self._has_answered = False
        self._is_first = True
        self._arrived: list[tuple[int, bytes]] = []
        self.last_reply: float = time.monotonic()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def prepare(self) -> bool:
        """Build the packet of the next cycle in advance; return whether the cycle has a packet."""
        self._packet = self.controller.packet()
        return self._packet is not None

    def send(self) -> None:
        """Send the prepared packet with the simulated faults."""
        controller = self.controller
        datagrams = [(controller.cycle, self._packet)] if self._packet is not None else []
        if self._outgoing is not None:
            datagrams = self._outgoing.through(datagrams, controller.uptime)
        # newest first, so a peer answers only one datagram, no matter when it reads
        datagrams = sorted(datagrams, key=lambda item: -item[0])
        self._awaited = False
        if self._packet is not None:
            controller.inbox.stamp(time.time_ns(), controller.uptime)
        for number, datagram in datagrams:
            self._put(datagram)
            if number > self._newest:  # a peer answers only packets newer than all previous ones
                self._awaited, self._newest, self._expected = True, number, controller.packets.tm_ms(number)

    def drain(self) -> None:
        """Read all waiting datagrams."""
        for _ in range(_DRAINED):
            data = self._get()
            if data is None:
                break
            self._receive(data)
        self._deliver()

    def wait(self, patience: float, alive: Callable[[], bool]) -> bool:
        """Wait for the reply to the packet just sent; return False on timeout.

        Packets discarded by a fault and streaming packets need no reply. While the peer's port is not
        bound, the packet is resent. After waiting once for a peer that has never replied, the controller sends one
        packet per period.
        """
        if self._packet is None and not self._awaited:
            self.drain()  # discard datagrams from before this session
            return True
        bound = time.monotonic()
        deadline, listens = bound + patience, self._listens()
        while self._awaited:
            data = self._get()
            if data is not None and self._receive(data):
                break
            now = time.monotonic()
            left = deadline - now
            if not self._refused and now - bound >= listens:
                break
            if left <= 0 or not alive():  # checked even in a flood of invalid datagrams
                return False
            if data is not None:
                continue
            if self._refused and self._packet is not None:
                time.sleep(_REFUSED_PAUSE)
                self._put(self._packet)
                bound = time.monotonic()
            else:
                self._poll.poll(1e3 * min(left, bound + listens - now, _LOOK))
        self._deliver()
        return True

    def _listens(self) -> float:
        """Return the time [s] to wait for a reply from a peer that may only listen; infinite if it must reply."""
        if self._has_answered or self.controller.phase != "streaming":
            return math.inf
        first, self._is_first = self._is_first, False
        return _FIRST if first else self.controller.arm.period

    def _receive(self, data: bytes) -> bool:
        """Process one received datagram; return whether it is the reply for which lockstep waits."""
        if self._incoming is not None:
            self._arrived.append((self._arrival, data))
            message = self.controller.inbox.read(data, count=False)
        else:
            message = self.controller.accept(data, self._arrival)
        if not isinstance(message, SensorMessage):
            return False
        self.last_reply, self._has_answered = time.monotonic(), True
        # a peer without an echo of tm (None, or 0 as from abb_libegm) is accepted
        return not message.tm_ms or message.tm_ms == self._expected

    def _deliver(self) -> None:
        """Deliver the datagrams that the faults release in this cycle."""
        if self._incoming is not None:
            for stamp, datagram in self._incoming.through(self._arrived, self.controller.uptime):
                self.controller.accept(datagram, max(stamp, 0))
            self._arrived.clear()

    def _put(self, datagram: bytes) -> None:
        """Send a datagram; retry if the first attempt only reports that an earlier datagram was refused."""
        self._refused = False
        for _ in range(2):
            try:
                self._socket.send(datagram)
                return
            except OSError as error:
                self._count(error)

    def _get(self) -> bytes | None:
        """Return the next datagram, or None; count socket errors, for example from an unbound port."""
        try:
            data, extra, _, _ = self._socket.recvmsg(_LARGEST, 64)
        except BlockingIOError:
            return None
        except OSError as error:
            self._count(error)
            return None
        self._arrival = time.time_ns()
        for _, kind, stamp in extra:
            if kind == _SO_TIMESTAMPNS and len(stamp) >= 16:
                seconds, nanoseconds = struct.unpack("qq", stamp[:16])
                self._arrival = seconds * 10**9 + nanoseconds
        return data

    def _count(self, error: OSError) -> None:
        refused = isinstance(error, ConnectionRefusedError)
        self._refused = self._refused or refused
        self.controller.statistics.counts["refused" if refused else "socket errors"] += 1


CORRUPTED = -1
"""Sequence number of a corrupted datagram."""

_NEVER_VALID = 0x07  # an invalid first byte of a protobuf message


class Faults:
    """Faults in one direction of a network path, applied once per cycle."""

    def __init__(self, rates: FaultRates, seed: int | Sequence[int], period: float = 0.004032) -> None:
        self._rates, self._period = rates, period
        self._random = np.random.default_rng(seed)
        self._under_way: list[tuple[float, int, tuple[int, bytes]]] = []  # (due time, order of arrival, item)
        self._order = self._losing = 0
        share, length = rates.loss, rates.burst  # probability that a burst begins, for the overall loss rate `loss`
        self._begins = share / (length - share * (length - 1)) if share else 0.0

    def through(self, datagrams: list[tuple[int, bytes]], now: float) -> list[tuple[int, bytes]]:
        """Return the (number, bytes) pairs that arrive in this cycle, delayed datagrams last.

        A corrupted datagram has the number `CORRUPTED`.
        """
        rates, draw = self._rates, self._random
        out: list[tuple[int, bytes]] = []
        start, length = rates.pause
        resumes = start + length if start <= now < min(start + length, rates.until) else 0.0
        if now >= rates.until:
            out, datagrams = list(datagrams), []
        for number, data in datagrams:
            shares = self._begins, rates.duplicate, rates.reorder, rates.corrupt
            begins, twice, swapped, corrupt = draw.random(4) < shares
            mean, sigma = rates.delay
            wait = max(0.0, mean + sigma * draw.standard_normal()) + self._period * swapped
            if self._is_lost(bool(begins)):
                continue
            item = (CORRUPTED, self._spoil(data)) if corrupt else (number, data)
            for _ in range(1 + int(twice)):
                if wait >= self._period / 2 or resumes:
                    self._order += 1
                    heapq.heappush(self._under_way, (max(now + wait, resumes), self._order, item))
                else:
                    out.append(item)
        while not resumes and self._under_way and self._under_way[0][0] <= now + self._period / 2:
            out.append(heapq.heappop(self._under_way)[2])
        return out

    def _is_lost(self, begins: bool) -> bool:
        if self._losing == 0 and begins:
            self._losing = self._rates.burst
        if self._losing == 0:
            return False
        self._losing -= 1
        return True

    def _spoil(self, data: bytes) -> bytes:
        """Truncate the datagram and overwrite some bytes to make it invalid."""
        spoiled = bytearray(data[: max(1, int(self._random.integers(len(data) + 1)))] or b"\0")
        spoiled[self._random.integers(len(spoiled))] = int(self._random.integers(256))
        spoiled[0] = _NEVER_VALID
        return bytes(spoiled)
