"""A bridge in a thread that answers simulated robots, for the tests of sockets and loops."""

from __future__ import annotations

import hashlib
import socket
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from armlab.robots import Robot
from armlab.wire.egm import EgmCodec, Packet, Reference

Reply = Callable[[int, Packet, bytes], list[bytes]]


class ThreadedPeer:
    """Binds a port on 127.0.0.1 and replies until closed.

    `answer` gets the number of the packet, the packet and the normal reply, and returns the datagrams to send.
    """

    def __init__(self, robot: Robot, answer: Reply | None = None, port: int = 0) -> None:
        self._codec, self._answer = EgmCodec(robot, extension=True), answer
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self.port = self._socket.getsockname()[1]
        self.packets: list[Packet] = []
        self.digest = hashlib.sha256()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        waker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        waker.sendto(b"", ("127.0.0.1", self.port))
        waker.close()
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        start = np.zeros(0)
        while data := self._socket.recvfrom(65535):
            if not data[0]:
                return
            self.digest.update(data[0])
            packet = self._codec.decode(data[0])
            if not isinstance(packet, Packet):
                continue
            k = len(self.packets)
            start = packet.q if k == 0 else start
            self.packets.append(packet)
            w, t = 2.0, 0.004032 * k
            q, qd = start + 0.2 * (1 - np.cos(w * t)), np.full(len(start), 0.2 * w * np.sin(w * t))
            reply = self._codec.encode(Reference(q, qd, None, k, packet.tm_ms or 0, packet.seqno, packet.robot_mono_ns))
            for datagram in [reply] if self._answer is None else self._answer(k, packet, reply):
                self._socket.sendto(datagram, data[1])


@pytest.fixture
def make_peer() -> Iterator[Callable[..., ThreadedPeer]]:
    """Yield a function that creates peers, and close them at the end."""
    made: list[ThreadedPeer] = []

    def make(robot: Robot, answer: Reply | None = None, port: int = 0) -> ThreadedPeer:
        made.append(ThreadedPeer(robot, answer, port))
        return made[-1]

    yield make
    for peer in made:
        peer.close()
