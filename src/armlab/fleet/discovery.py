"""`Router` connects bridges and clients; `list_robots` lists the robots with running bridges."""

from __future__ import annotations

import ipaddress
import math
import threading
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from armlab.bridge.net.sockets import is_here
from armlab.bridge.servers.row import RowSchema, read_row
from armlab.bridge.servers.zenoh.feed import robots_at
from armlab.bridge.servers.zenoh.messages import EVERY, key, read_about, robot_of, undamaged
from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.servers.zenoh.session import LabAddress, close_session, open_session, queried
from armlab.errors import ArmlabError, ConfigError


class FleetRobot(NamedTuple):
    """Robot with a running bridge.

    Attributes
    ----------
    lab, robot : names of the lab and the robot.
    rate : received rows per second [Hz].
    loss : number of missing rows, from gaps in the robot's ticks.
    damaged : number of rows with an invalid checksum; they count as lost once a later row arrives.
    age : age of the newest row [s], computed from the clocks of both computers; NaN without rows.
    commander : name of the commanding client, or "".
    """

    lab: str
    robot: str
    rate: float
    loss: int
    damaged: int
    age: float
    commander: str


def list_robots(place: LabAddress, seconds: float = 2.0) -> list[FleetRobot]:
    """Listen for rows, and return the robots with running bridges.

    Parameters
    ----------
    place : address of the router; its `lab` may be `EVERY`.
    seconds : listening time.

    Raises
    ------
    LinkError : no router at this address.
    MissingExtra : Zenoh is not installed.
    """
    session = place.open_behind()
    try:
        alive = robots_at(session, place.lab)
        seen = {f"{lab}/{robot}": _Seen(lab, robot) for lab, robot in alive}
        for where, data in queried(session, key(place.lab, EVERY, "about"), 1.0) if seen else ():
            if robot := seen.get("/".join(robot_of(where))):
                robot.describe(data)

        def take(sample: Any) -> None:
            if robot := seen.get("/".join(robot_of(str(sample.key_expr)))):
                robot.take(undamaged(sample))

        rows = session.declare_subscriber(key(place.lab, EVERY, "live"), take)
        threading.Event().wait(seconds if seen else 0.0)
        rows.undeclare()
        return [seen[name].summary() for name in sorted(seen)]
    finally:
        close_session(session)


class _Seen:
    """Received rows of one robot."""

    def __init__(self, lab: str, robot: str) -> None:
        self._lab, self._robot = lab, robot
        self._schema: RowSchema | None = None
        self._rows = self._damaged = 0
        self._times = self._ticks = (0, 0)  # first and last row
        self._commander, self._wall_ns = "", 0

    def describe(self, about: bytes) -> None:
        try:
            self._schema = read_about(about).schema
        except ArmlabError:
            self._schema = None  # listed without rows

    def take(self, data: bytes | None) -> None:
        self._damaged += data is None
        if self._schema is None or data is None:
            return
        try:
            row = read_row(self._schema, data)
            tick = row.values[f"{self._robot}.tick"]
            self._commander = row.values[f"{self._robot}.commander"]
        except (ArmlabError, KeyError):
            return
        now = time.monotonic_ns()
        first = self._rows == 0
        self._times = (now if first else self._times[0], now)
        self._ticks = (tick if first else self._ticks[0], tick)
        self._wall_ns = row.wall_ns
        self._rows += 1

    def summary(self) -> FleetRobot:
        between = 1e-9 * (self._times[1] - self._times[0])
        rate = (self._rows - 1) / between if between > 0.0 else 0.0
        loss = max(self._ticks[1] - self._ticks[0] + 1 - self._rows, 0) if self._rows else 0
        age = 1e-9 * (time.time_ns() - self._wall_ns) if self._rows else math.nan
        return FleetRobot(self._lab, self._robot, rate, loss, self._damaged, age, self._commander)


class Router:
    """Zenoh router in this process, as a context manager.

    Parameters
    ----------
    host, port : listening address; port 0 selects any free port.
    connect : "HOST:PORT" of other routers, whose robots become visible through this router; retried indefinitely.
    security : certificates and users; see `servers.zenoh.security.Security`.

    Attributes
    ----------
    where : printable address.

    Raises
    ------
    ConfigError : a router on a non-local address, or one that connects to a remote router, lacks certificates and
        users, so any client could send commands.
    LinkError : the port is in use.
    MissingExtra : Zenoh is not installed.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 7447, connect: Sequence[str] = (), security: Security | None = None
    ) -> None:
        safe = security or Security()
        try:
            is_near = ipaddress.ip_address(host).is_loopback
        except ValueError:
            raise ConfigError(f"Expected the address of a network interface, got {host!r}.") from None
        far = [f"at {host}"] if not is_near else [f"connected to {other}" for other in connect if not is_here(other)]
        if far and not safe.is_safe:
            raise ConfigError(
                f"Expected certificates and users for the router {far[0]}, because it forwards commands to robots, got "
                "none. Create certificates and users with armlab bridge "
                "certificates, then pass ca, certificate, key and users."
            )
        place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self._session = open_session("router", [place], list(connect), safe)
        self.where: str = f"{'tls' if safe.ca is not None else 'tcp'}/{place}"

    def __enter__(self) -> Router:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the router; connected clients try to reconnect."""
        close_session(self._session)
