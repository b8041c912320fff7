"""`LabCommServer`: rows, parameters and commands over TCP, for clients in any language that has LabComm.

One thread serves all ports. What is published goes into a bounded queue and wakes that thread: no client is ever waited
for.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Literal

from armlab.bridge.arbiter import Arbiter, Order
from armlab.bridge.net.events import Tell, nobody
from armlab.bridge.servers.labcomm.channels import Channel, FusedArm, FusedSource, OnCommand, Value
from armlab.bridge.servers.labcomm.rows import Row
from armlab.bridge.servers.labcomm.selector_server import Ports
from armlab.errors import LinkError, UnknownName
from armlab.log import Tick
from armlab.state import Command, State

__all__ = ["LabCommServer", "RowFeed", "to_arbiter"]

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


class RowFeed:
    """Publishes each row of a run; see `recording.Feed`. Measured torques are those that the state has.

    Parameters
    ----------
    server : where to. channels : channel by name of the robot. With a channel "fused", the newest rows of all arms are
        published there with each row of the first.
    """

    def __init__(self, server: LabCommServer, channels: Mapping[str, str]) -> None:
        self._server, self._channels = server, dict(channels)
        self._fused = "fused" in server.ports
        self._newest: dict[str, FusedArm] = {}

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Publish one row.

        Parameters
        ----------
        state : of the arm. command, tick : not used.
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
        """Take one sentence: rows have no place for it.

        Parameters
        ----------
        text, warn : see `recording.Feed`.
        """


def to_arbiter(arbiter: Arbiter, arm: str, order: Literal["abb", "chain"] = "abb") -> OnCommand:
    """Return what an `ArmChannel` calls so that its clients command an arm by the rights of an arbiter.

    Parameters
    ----------
    arbiter : the controller of the run; it must allow the server "labcomm". arm : name of the robot.
    order : of the joints on the channel, so that a refusal names the number that its client sent.
    """

    def submit(name: str, row: Row, client: str) -> None:
        arbiter.submit(Order(f"labcomm {client}", arm, row.q, row.qd, row.tau, by_axis=order == "abb"))

    return submit
