"""`Router`, where bridges and their clients find each other, and `list_robots`, the robots that are there."""

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
    """What was seen of a robot.

    Attributes
    ----------
    lab, robot : names.
    rate : rows that came per second [Hz].
    loss : rows that did not come, by the robot's ticks.
    damaged : rows whose checksum was another one; they count as lost as well, once a later one came.
    age : of the newest row by both computers' clocks [s], NaN without any.
    commander : who moves it, "" for nobody.
    """

    lab: str
    robot: str
    rate: float
    loss: int
    damaged: int
    age: float
    commander: str


def list_robots(place: LabAddress, seconds: float = 2.0) -> list[FleetRobot]:
    """Return the robots whose bridges are alive, after listening to all their rows for a while.

    Parameters
    ----------
    place : of the router; its `lab` may be `EVERY`.
    seconds : to listen.

    Raises
    ------
    LinkError : no router. MissingExtra : no Zenoh.
    """
    session = place.open_behind()
    try:
        alive = robots_at(session, place.lab)
        seen = {f"{lab}/{robot}": _Seen(lab, robot) for lab, robot in alive}
        for where, data in queried(session, key(place.lab, EVERY, "about"), 1.0) if seen else ():
            robot = seen.get("/".join(robot_of(where)))
            if robot is not None:
                robot.describe(data)

        def take(sample: Any) -> None:
            robot = seen.get("/".join(robot_of(str(sample.key_expr))))
            if robot is not None:
                robot.take(undamaged(sample))

        rows = session.declare_subscriber(key(place.lab, EVERY, "live"), take)
        threading.Event().wait(seconds if seen else 0.0)
        rows.undeclare()
        return [seen[name].summary() for name in sorted(seen)]
    finally:
        close_session(session)


class _Seen:
    """The rows of one robot."""

    def __init__(self, lab: str, robot: str) -> None:
        self._lab, self._robot = lab, robot
        self._schema: RowSchema | None = None
        self._rows = self._damaged = 0
        self._times = self._ticks = (0, 0)  # of the first and the last row
        self._commander, self._wall_ns = "", 0

    def describe(self, about: bytes) -> None:
        try:
            self._schema = read_about(about).schema
        except ArmlabError:
            self._schema = None  # shown without rows

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
    """A Zenoh router in this process; a context manager.

    Parameters
    ----------
    host, port : where it listens; port 0 lets the system choose.
    connect : "HOST:PORT" of other routers, whose robots are seen through this one; they are tried for ever.
    security : certificates and users; see `servers.zenoh.security.Security`.

    Attributes
    ----------
    where : address in words.

    Raises
    ------
    ConfigError : not on this computer alone, or connected to a router elsewhere, and without certificates and users:
        whoever comes could command.
    LinkError : the port is taken. MissingExtra : no Zenoh.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 7447, connect: Sequence[str] = (), security: Security | None = None
    ) -> None:
        safe = security or Security()
        try:
            is_near = ipaddress.ip_address(host).is_loopback
        except ValueError:
            raise ConfigError(f"Expected the address of a network card to listen at, got {host!r}.") from None
        far = [f"at {host}"] if not is_near else [f"connected to {other}" for other in connect if not is_here(other)]
        if far and not safe.is_safe:
            raise ConfigError(
                f"Expected certificates and users for a router {far[0]}, since commands to robots pass through it. "
                "Write them: armlab bridge certificates; then give ca, certificate, key and users."
            )
        place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self._session = open_session("router", [place], list(connect), safe)
        self.where = f"{'tls' if safe.ca is not None else 'tcp'}/{place}"

    def __enter__(self) -> Router:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it: those who were connected try to come again."""
        close_session(self._session)
