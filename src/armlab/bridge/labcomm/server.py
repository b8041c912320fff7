"""`LabCommServer`: rows, parameters and commands over TCP, for clients in any language that has LabComm.

One thread serves all ports. What is published goes into a bounded queue and wakes that thread: no client is ever waited
for.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import deque
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

from armlab.bridge.events import Tell, nobody
from armlab.bridge.labcomm.channels import Channel, FusedArm, FusedSource
from armlab.bridge.labcomm.parameter_channel import Value
from armlab.bridge.labcomm.ports import Ports
from armlab.bridge.labcomm.rows import Row
from armlab.errors import LinkError, UnknownName

__all__ = ["LabCommServer"]

_PUBLISHED = 256  # items that wait for the server's thread


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
        self.lost = 0
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
        self.ports = self._ports.numbers
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
        return self._ports.counts

    @property
    def clients(self) -> dict[str, tuple[int, int]]:
        """Data packets sent to each client and dropped for it, by channel and address; also of those that have left."""
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
        with contextlib.suppress(OSError):  # a full pipe wakes too
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
