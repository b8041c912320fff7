"""`LabCommClient`: the other side of a LabComm server, for rows and commands of an arm, or any samples."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

from armlab.bridge.inputs.sources import Reading, ThreadSource, whole
from armlab.bridge.servers.labcomm.connection import Peer
from armlab.bridge.servers.labcomm.rows import STOP, Row, RowTypes
from armlab.errors import ArmlabError, LabCommError, LinkError
from armlab.log import Column
from armlab.wire.labcomm import Encoder, Sample
from armlab.wire.labcomm.types import Event, SampleType


def connected(host: str, port: int, patience: float) -> socket.socket:
    try:
        return socket.create_connection((host, port), timeout=patience)
    except (OSError, OverflowError) as error:
        raise LinkError(
            f"Expected a LabComm server at {host}:{port}, got: {error}. Start it (armlab bridge) or check the address."
        ) from error


class LabCommClient:
    """A connection to one port; a context manager. It announces itself and its command type at once.

    Parameters
    ----------
    host : address of the server.
    port : port of the server: 7511 left arm, 7512 right arm, 7513 parameters, 7514 fused rows.
    dialect : dialect of packets sent; that of received packets follows from their first bytes.
    types : sample types and order of joints of an arm's port.
    patience : time to wait for the connection [s].

    Attributes
    ----------
    host : address of the server.
    port : port of the server.
    samples : types that the server has defined, by index.

    Raises
    ------
    LinkError : no server listens there.
    UnknownName : no such dialect.
    """

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
        """Close the connection: the server frees the arm."""
        self._peer.close()

    @property
    def samples(self) -> dict[int, SampleType]:
        """Types that the server has defined, by index."""
        return self._peer.decoder.samples

    def define(self, sample: SampleType) -> None:
        """Announce a type: a server of parameters then sends its value.

        Parameters
        ----------
        sample : name and type.
        """
        if sample not in self._defined:
            self._defined.append(sample)
            self._push(self._encoder.define(sample), may_drop=False)

    def send(self, sample: SampleType, value: Any) -> None:
        """Send a value, after its definition.

        Parameters
        ----------
        sample : name and type.
        value : see `wire.labcomm.Sample`.

        Raises
        ------
        LabCommError : the value does not fit.
        LinkError : the connection is gone.
        """
        self.define(sample)
        self._push(self._encoder.data(sample, value))

    def command(self, row: Row) -> None:
        """Send a command to the arm: a position, and a velocity and a torque where they are given.

        Commands that could not be sent yet are dropped for it.

        Parameters
        ----------
        row : `tm` is that of the row it answers; joints in kinematic order.

        Raises
        ------
        LabCommError : a wrong number of joints.
        LinkError : the connection is gone.
        """
        self._peer.clear()
        self.send(self._types.accepted, self._types.value(row, self._types.accepted))

    def stop(self) -> None:
        """Bring all arms of the bridge to rest, whoever commands them; only its operator ends that.

        Raises
        ------
        LinkError : the connection is gone.
        """
        self._peer.clear()
        self.send(STOP, {})

    def events(self, seconds: float) -> list[Event]:
        """Return what has come, waiting for the first event if there is none.

        Parameters
        ----------
        seconds : longest time to wait.

        Raises
        ------
        LinkError : the server has closed the connection, or its stream is malformed.
        """
        return self._awaited(seconds, lambda events: events)

    def rows(self, seconds: float) -> list[Row]:
        """Return the rows of the arm that have come, waiting for the first if there is none.

        Parameters
        ----------
        seconds : longest time to wait.

        Raises
        ------
        LinkError : the server has closed the connection, or its stream is malformed.
        """
        return self._awaited(seconds, self._types.rows)

    def _awaited(self, seconds: float, wanted: Callable[[list[Event]], list[Any]]) -> list[Any]:
        """Return what is wanted of what came, once there is any or the time is up."""
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
            found = wanted(events)
            left = 0.0 if found else max(end - time.monotonic(), 0.0)
            if not left:
                return found

    def run(self, on_row: Callable[[Row], Row | None], seconds: float | None = None, reconnects: bool = True) -> int:
        """Call a function with each newest row; what it returns is sent as the command. Return the number of calls.

        Parameters
        ----------
        on_row : Row -> Row or None.
        seconds : time to run [s]; default: until the connection is gone.
        reconnects : try again for `patience` seconds when the server goes.

        Raises
        ------
        LinkError : the server is gone, or sent nothing for `patience` seconds.
        """
        end = None if seconds is None else time.monotonic() + seconds
        calls, heard = 0, time.monotonic()
        while end is None or time.monotonic() < end:
            try:
                rows = self.rows(0.1)
                if rows:
                    heard = time.monotonic()
                    calls += 1
                    answer = on_row(rows[-1])
                    if answer is not None:
                        self.command(answer)
            except LinkError:
                if not reconnects:
                    raise
                self.close()
                self._again()
            if time.monotonic() - heard > self._patience:
                raise LinkError(f"Expected rows from {self.host}:{self.port}, got none for {self._patience:g} s.")
        return calls

    def _open(self) -> None:
        encoder = Encoder(self._dialect)
        connection = connected(self.host, self.port, self._patience)
        self._encoder, self._peer = encoder, Peer(connection, f"{self.host}:{self.port}", encoder)
        self._push(encoder.version(), may_drop=False)
        for sample in self._defined:
            self._push(encoder.define(sample), may_drop=False)

    def _again(self) -> None:
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
        """Send what waits."""
        if self._peer.socket.fileno() < 0 or not self._peer.flush():
            raise self._gone()

    def _gone(self) -> LinkError:
        if self._peer.socket.fileno() < 0:
            return LinkError(f"The connection to {self.host}:{self.port} was closed here. Make a new client.")
        return LinkError(f"The LabComm server at {self.host}:{self.port} closed the connection.")


_AGAIN = 0.5  # s between two tries to connect
_LOOK = 0.1  # s
_STAMPS = {"t_us": 1000, "tm": 10**6}  # ns of one unit


class LabCommSource(ThreadSource):
    """The newest value of one sample type, received in a thread of its own; it connects again by itself.

    The type need not be known: the stream defines it. A field ``t_us`` or ``tm`` of the sample is its clock.
    """

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
        """Connect and read, again and again."""
        while not self._over.is_set():
            try:
                with LabCommClient(self.host, self.port, self._dialect, patience=_AGAIN) as client:
                    while not self._over.is_set():
                        for event in client.events(_LOOK):
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
