"""`Hub`: the feed that connects the loop to the server processes.

The hub sends rows and events, and receives commands and parameter settings through the same sockets. A server that
does not read never blocks the loop; its lost rows are counted.
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

from armlab.bridge.arbiter import Arbiter, Order, Result
from armlab.bridge.inputs.parameters import Change, Parameters
from armlab.bridge.net.events import Tell
from armlab.bridge.net.sockets import Outlet
from armlab.bridge.servers import messages
from armlab.bridge.servers.messages import parameter_message, text_message
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.errors import ArmlabError, LinkError
from armlab.log import Column, Tick
from armlab.motion import JointTrajectory, Tolerance, TrajectoryController
from armlab.robots import Robot, to_toml
from armlab.state import Command, State

OPERATOR = "local"
"""Name of the server for operators; only the user of the bridge may open its socket."""

_PATIENCE = 0.5  # s: time limit for a server to report client counts, after the arms have come to rest
_DRAINED = 16  # maximum number of requests handled per server and poll
_EVENTS = 1000  # maximum number of events waiting for a run to begin
_SENTENCE = 1000  # maximum length of a report in characters, because it may quote a client's message
_PARTS = 64  # maximum number of parts of a trajectory


class Hub:
    """Feed for the server processes (see `recording.Feed`): sends them rows and events, and handles their requests."""

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
        self.parameters: Parameters = Parameters() if parameters is None else parameters
        self.outlets: dict[str, Outlet] = {name: Outlet(name) for name in servers}
        self.schema: RowSchema = RowSchema.of(robots, sources)
        self._writer = RowWriter(self.schema)
        self._about = {
            "run": secrets.token_hex(8),
            **(about or {}),
            "robots": {robot.name: to_toml(robot) for robot in robots},
        }
        self._read_only = frozenset(read_only)
        self._events: deque[tuple[str, bool, bool]] = deque(maxlen=_EVENTS)
        self._record: Tell | None = None
        self._keep: Callable[[Change], None] = lambda change: None
        self._files = b""
        self._lock = threading.Lock()
        self._polled_ns = 0
        self._parts: dict[str, list[messages.TrajectoryRequest]] = {}
        self._robots = {robot.name: robot for robot in robots}
        self._limits = messages.limits_of_cell(robots, self._about)
        self.arbiter: Arbiter = Arbiter(
            robots, allowed, poll=self.poll, tell=self.tell, answer=self.answer, torque=torque, on_goal=self.report_goal
        )

    def open(self, name: str) -> socket.socket:
        """Return the socket of a new server process, which first receives the schema and the parameters."""
        outlet = self.outlets[name]
        theirs = outlet.open()
        outlet.send(text_message("about", **self._about, schema=self.schema.text.decode()))
        outlet.send(parameter_message(self.parameters))
        if self._files:
            outlet.send(self._files)
        return theirs

    def close(self) -> None:
        """Close all connections, which ends the server processes."""
        for outlet in self.outlets.values():
            outlet.close()

    def begin(
        self, tell: Tell, files: Sequence[Path] = (), keep: Callable[[Change], None] = lambda change: None
    ) -> None:
        """Start recording the events of a run through `tell`, which passes them back to `event`."""
        self._files = text_message("recording", files=[str(file.absolute()) for file in files])
        for outlet in self.outlets.values():
            outlet.send(self._files)
        self._record, self._keep, self.parameters.running = tell, keep, True
        values = self.parameters.values()
        for name, value in values.items():
            keep(Change(0, name, value, "in effect at the start"))
        if values:
            self.tell(f"Parameters: {', '.join(f'{name} = {value}' for name, value in values.items())}.")

    def summary(self) -> dict[str, Any]:
        """Return the statistics of a run: parameters, executed and refused commands by client, and rows by server."""
        servers = {name: self._counted(outlet) for name, outlet in self.outlets.items()}
        self.parameters.running = False
        values = self.parameters.values().items()
        return {
            "parameters": {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values},
            "commands": {arm: dict(clients) for arm, clients in self.arbiter.obeyed.items()},
            "commands_refused": dict(self.arbiter.refused),
            "servers": servers,
        }

    def _counted(self, outlet: Outlet) -> dict[str, Any]:
        """Request and return the row counts of a server and of its clients; wait at most 0.5 s."""
        outlet.clients, until = None, time.monotonic() + _PATIENCE
        if outlet.send(text_message("count")):
            while outlet.clients is None and time.monotonic() < until:
                self.poll()
                time.sleep(1e-3)
        self.poll()
        return {"rows": outlet.rows, "lost": outlet.lost, "clients": outlet.clients}

    def tell(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Queue an event of the run; may be called from any thread."""
        self._events.append((text, warn, each))

    def answer(self, client: str, text: str, refused: Iterable[str] = ()) -> None:
        """Send a text message to a client."""
        server, _, rest = client.partition(" ")
        if server in self.outlets:
            self.outlets[server].send(text_message("answer", client=rest, text=text, refused=list(refused)))

    def report_goal(self, order: Order, result: Result) -> None:
        """Send the start or the result of a goal to its server."""
        server, _, rest = order.client.partition(" ")
        if server in self.outlets:
            status, ending, text = result
            about = {"client": rest, "arm": order.arm, "goal": order.goal}
            self.outlets[server].send(text_message("goal", **about, status=status, ending=ending, text=text))

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Send a row to every server and handle requests."""
        data = self._writer.row(state, command, tick, time.monotonic_ns(), self.arbiter.commander(state.robot))
        for outlet in self.outlets.values():
            outlet.row(data)
        self.poll()

    def event(self, text: str, warn: bool = False) -> None:
        """Send an event to every server."""
        data = text_message("event", stamp_ns=time.time_ns(), text=text, warn=warn)
        for outlet in self.outlets.values():
            outlet.send(data)

    def idle(self, longer_ns: int) -> None:
        """Poll from another thread while no robot packets arrive."""
        if time.monotonic_ns() - self._polled_ns > longer_ns:
            self.poll()

    def poll(self) -> None:
        """Handle at most 16 requests from each server, then apply parameters; never block."""
        if not self._lock.acquire(blocking=False):
            return  # another thread is polling
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
            while self._events:
                text, warn, each = self._events.popleft()
                if self._record is None:
                    self.event(text, warn)
                else:
                    self._record(text, warn, each)
        finally:
            self._lock.release()

    def _take(self, outlet: Outlet, data: bytes) -> None:
        try:
            request = messages.read_request(data)
        except LinkError:  # not a request
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
                self._parts.pop(client, None)
                self.arbiter.leave(client)
            case messages.Cancel():
                self.arbiter.cancel(client, request.arm, request.goal)
            case _ if outlet.name in self._read_only:
                refused = request.values if isinstance(request, messages.SetRequest) else ()
                text = (
                    f"{outlet.name} accepts clients from other computers without a secret. You have read-only access."
                )
                self.answer(client, text, refused)
                if isinstance(request, messages.TrajectoryRequest):
                    self.report_goal(Order(client, request.arm, goal=request.goal), ("aborted", "refused", text))
            case messages.SetRequest():
                self._set(client, request, is_operator)
            case messages.CommandRequest():
                parts = request.q, request.qd, request.tau
                q, qd, tau = (None if part is None else np.array(part, dtype=float) for part in parts)  # null: NaN
                order = Order(client, request.arm, q, qd, tau, request.seq, request.first, request.by_axis)
                self.arbiter.submit(order)
            case messages.TrajectoryRequest():
                self._take_trajectory(client, request)
            case messages.Renew():
                self.arbiter.renew(client, request.arm, request.goal)
            case messages.Release() if not is_operator:
                self.arbiter.release(client, client)
            case messages.Resume() | messages.Release() if is_operator:
                act = self.arbiter.resume if isinstance(request, messages.Resume) else self.arbiter.release
                act(client)
                self.answer(client, "Done.")
            case _:
                self.answer(client, "Only operators may end a stop. Run armlab bridge resume.")

    def _take_trajectory(self, client: str, part: messages.TrajectoryRequest) -> None:
        """Store one part of a trajectory; submit the trajectory when the last part arrives."""
        parts = [one for one in self._parts.pop(client, ()) if one.goal == part.goal]
        if part.index == len(parts) < _PARTS:
            parts.append(part)
        if part.index < part.count - 1:
            self._parts[client] = parts
        else:
            order = Order(client, part.arm, goal=part.goal)
            if len(parts) != part.count:
                why = f"Expected {part.count} parts of the trajectory, got {len(parts)}. Send it again."
                self.report_goal(order, ("aborted", "refused", why))
                return
            points = b"".join(one.points for one in parts)
            try:
                self.arbiter.submit(order._replace(trajectory=self._trajectory(part, points)))
            except (ArmlabError, ValueError) as error:
                self.report_goal(order, ("aborted", "refused", str(error)))

    def _trajectory(self, last: messages.TrajectoryRequest, points: bytes) -> TrajectoryController | None:
        """Return the controller for a trajectory already checked against the limits by its server, or None for an
        unknown arm."""
        robot = self._robots.get(last.arm)
        if robot is None:
            return None
        rows = np.frombuffer(points).reshape(-1, 1 + last.orders * robot.n)
        columns = [rows[:, 1 + k * robot.n : 1 + (k + 1) * robot.n] for k in range(last.orders)]
        trajectory = JointTrajectory(rows[:, 0], *columns, joints=robot.ros_joint_names)
        path, goal = (Tolerance(*pair) for pair in np.frombuffer(last.tolerances).reshape(2, 2, robot.n))
        return TrajectoryController(trajectory, self._limits[last.arm], path, goal, last.goal_time, last.begin)

    def _set(self, client: str, request: messages.SetRequest, is_operator: bool) -> None:
        try:
            self.parameters.set_together(request.values, client, commander=is_operator or self.arbiter.commands(client))
        except ArmlabError as error:
            self.answer(client, str(error), request.values)
            self.tell(f"A setting of {client} was refused: {error}", warn=True)
