"""`Hub`: between the loop and the server processes; it is a feed of the loop.

Rows and events go out; commands and settings of parameters come back by the same sockets. A server that does not read
loses rows, which are counted; it never holds the loop up.
"""

from __future__ import annotations

import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlab.bridge.arbiter import Arbiter, Order
from armlab.bridge.inputs.parameters import Change, Parameters
from armlab.bridge.net.events import Tell
from armlab.bridge.net.sockets import Outlet
from armlab.bridge.servers import messages
from armlab.bridge.servers.messages import parameter_message, text_message
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.errors import ArmlabError, LinkError
from armlab.log import Column, Tick
from armlab.robots import Robot, to_toml
from armlab.state import Command, State

OPERATOR = "local"
"""The server whose clients are operators: its socket is the user's own."""

_PATIENCE = 0.5  # s for a server to say what its clients got, when the arms rest
_DRAINED = 16  # requests of a server per look
_EVENTS = 1000  # that wait for a run to begin
_SENTENCE = 1000  # characters of a report: what clients send may be quoted in it


class Hub:
    """A feed (see `recording.Feed`) for processes: rows and events to all, their requests to arbiter and parameters."""

    def __init__(
        self,
        robots: Sequence[Robot],
        servers: Iterable[str],
        parameters: Parameters | None = None,
        allowed: Iterable[str] = (),
        *,
        sources: Mapping[str, Mapping[str, Column]] | None = None,
        about: Mapping[str, Any] | None = None,
        torque: Iterable[str] = (),
        read_only: Iterable[str] = (),
    ) -> None:
        self.parameters = Parameters() if parameters is None else parameters
        self.outlets = {name: Outlet(name) for name in servers}
        self.schema = RowSchema.of(robots, sources)
        self._writer = RowWriter(self.schema)
        self._about = {
            "run": secrets.token_hex(8),
            **(about or {}),
            "robots": {robot.name: to_toml(robot) for robot in robots},
        }
        self._read_only = frozenset(read_only)
        self._told: deque[tuple[str, bool, bool]] = deque(maxlen=_EVENTS)
        self._record: Tell | None = None
        self._keep: Callable[[Change], None] = lambda change: None
        self._files = b""
        self._lock = threading.Lock()
        self._polled_ns = 0
        self.arbiter = Arbiter(robots, allowed, poll=self.poll, tell=self.tell, answer=self.answer, torque=torque)

    def open(self, name: str) -> socket.socket:
        """Return the socket for a server process that starts; it gets schema and parameters first."""
        outlet = self.outlets[name]
        theirs = outlet.open()
        outlet.send(text_message("about", **self._about, schema=self.schema.text.decode()))
        outlet.send(parameter_message(self.parameters))
        if self._files:
            outlet.send(self._files)
        return theirs

    def close(self) -> None:
        """Close all outlets: the server processes end."""
        for outlet in self.outlets.values():
            outlet.close()

    def begin(
        self, tell: Tell, files: Sequence[Path] = (), keep: Callable[[Change], None] = lambda change: None
    ) -> None:
        """Take where the events of a run are recorded; it gives them back to `event`."""
        self._files = text_message("recording", files=[str(file.absolute()) for file in files])
        for outlet in self.outlets.values():
            outlet.send(self._files)
        self._record, self._keep, self.parameters.running = tell, keep, True
        values = self.parameters.values()
        for name, value in values.items():
            keep(Change(0, name, value, "in force at the start"))
        if values:
            self.tell(f"Parameters: {', '.join(f'{name} = {value}' for name, value in values.items())}.")

    def summary(self) -> dict[str, Any]:
        """Return what is kept with the numbers of a run: parameters, who commanded, rows by server and client."""
        servers = {name: self._counted(outlet) for name, outlet in self.outlets.items()}
        self.parameters.running = False
        values = {
            name: getattr(value, "tolist", lambda value=value: value)()
            for name, value in self.parameters.values().items()
        }
        return {
            "parameters": values,
            "commands": {arm: dict(clients) for arm, clients in self.arbiter.obeyed.items()},
            "commands_refused": dict(self.arbiter.refused),
            "servers": servers,
        }

    def _counted(self, outlet: Outlet) -> dict[str, Any]:
        """Ask a server what its clients got; it has little time to answer."""
        outlet.clients, until = None, time.monotonic() + _PATIENCE
        if outlet.send(text_message("count")):
            while outlet.clients is None and time.monotonic() < until:
                self.poll()
                time.sleep(1e-3)
        self.poll()
        return {"rows": outlet.rows, "lost": outlet.lost, "clients": outlet.clients}

    def tell(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Keep a sentence for the events of the run; from any thread."""
        self._told.append((text, warn, each))

    def answer(self, client: str, text: str, refused: Iterable[str] = ()) -> None:
        """Send a sentence to the client that asked."""
        server, _, rest = client.partition(" ")
        if server in self.outlets:
            self.outlets[server].send(text_message("answer", client=rest, text=text, refused=list(refused)))

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Send a row to every server and see what came back."""
        data = self._writer.row(state, command, tick, time.monotonic_ns(), self.arbiter.commander(state.robot))
        for outlet in self.outlets.values():
            outlet.row(data)
        self.poll()

    def event(self, text: str, warn: bool = False) -> None:
        """Send a sentence to every server."""
        data = text_message("event", stamp_ns=time.time_ns(), text=text, warn=warn)
        for outlet in self.outlets.values():
            outlet.send(data)

    def idle(self, longer_ns: int) -> None:
        """See what came back when no packet of a robot made the loop look; for another thread."""
        if time.monotonic_ns() - self._polled_ns > longer_ns:
            self.poll()

    def poll(self) -> None:
        """Take at most 16 requests of each server, then bring parameters into force. Never waits."""
        if not self._lock.acquire(blocking=False):
            return  # the other thread is at it
        try:
            self._polled_ns = time.monotonic_ns()
            for outlet in self.outlets.values():
                for _ in range(_DRAINED):
                    data = outlet.receive()
                    if data is None:
                        break
                    self._take(outlet, data)
            changes = self.parameters.apply()
            for change in changes:
                self._keep(change)
                self.tell(change.sentence)
            if changes:
                message = parameter_message(self.parameters)
                for outlet in self.outlets.values():
                    outlet.send(message)
            while self._told:
                text, warn, each = self._told.popleft()
                if self._record is None:
                    self.event(text, warn)
                else:
                    self._record(text, warn, each)
        finally:
            self._lock.release()

    def _take(self, outlet: Outlet, data: bytes) -> None:
        try:
            request = messages.read_request(data)
        except LinkError:  # noise
            return
        client, is_operator = f"{outlet.name} {request.client}".rstrip(), outlet.name == OPERATOR
        match request:
            case messages.Listening():
                outlet.where = request.where
            case messages.Counted():
                outlet.clients = request.clients
            case messages.Report():
                self.arbiter.report(client, request.text[:_SENTENCE])
            case messages.Stop():
                self.arbiter.stop(client)
                self.answer(client, "Done.")
            case messages.Leave():
                self.arbiter.leave(client)
            case _ if outlet.name in self._read_only:
                refused = request.values if isinstance(request, messages.SetRequest) else ()
                text = f"Expected no requests through {outlet.name}: it listens beyond this computer. Read."
                self.answer(client, text, refused)
            case messages.SetRequest():
                self._set(client, request, is_operator)
            case messages.CommandRequest():
                q, qd, tau = (None if one is None else _numbers(one) for one in (request.q, request.qd, request.tau))
                order = Order(client, request.arm, q, qd, tau, request.seq, request.first, request.by_axis)
                self.arbiter.submit(order)
            case messages.Release() if not is_operator:
                self.arbiter.release(client, client)
            case messages.Resume() | messages.Release() if is_operator:
                act = self.arbiter.resume if isinstance(request, messages.Resume) else self.arbiter.release
                act(client)
                self.answer(client, "Done.")
            case _:
                self.answer(client, "Expected an operator to resume: armlab bridge resume.")

    def _set(self, client: str, request: messages.SetRequest, is_operator: bool) -> None:
        try:
            self.parameters.set_together(request.values, client, commander=is_operator or self.arbiter.commands(client))
        except ArmlabError as error:
            self.answer(client, str(error), request.values)
            self.tell(f"A setting of {client} was refused: {error}", warn=True)


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], dtype=float)
