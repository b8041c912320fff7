"""`Servers`: one process per server, watched and started again; none of them can touch the loop."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

from armlab._descriptors import Descriptor
from armlab.bridge.arbiter import Arbiter
from armlab.bridge.control.loop import Controller
from armlab.bridge.servers.hub import OPERATOR, Hub
from armlab.bridge.servers.local import socket_path
from armlab.errors import LinkError
from armlab.robots import Robot
from armlab.state import State

__all__ = ["Offering", "PLACE", "RESTARTS", "Servers", "WELL", "server_command", "stoppable"]

PLACE = "{fd}"
"""Word of a command that stands for the number of the socket to the loop."""

RESTARTS = (1.0, 5.0, 30.0)
"""Seconds after which a server that ended is started again; after the last it stays dead."""

WELL = 300.0
"""Seconds that a server has listened after which its next end is the first of a new series."""

_LOOK = 0.05  # s
_IDLE = 200_000_000  # ns without a packet of a robot, after which requests are taken here
_QUOTED = 1000  # bytes of what a server said last
_PATIENCE = 3.0  # s to end by itself before it is killed


def server_command(name: str, options: Mapping[str, Any]) -> list[str]:
    """Return the command that starts a server of armlab."""
    return [sys.executable, "-m", "armlab.bridge.servers.serve", name, PLACE, json.dumps(dict(options))]


class _Child:
    """One server: its command, its process, and what becomes of it."""

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self.name, self.command = name, list(command)
        self.process: subprocess.Popen[bytes] | None = None
        self.errors = Descriptor(-1)  # of the pipe from its standard error
        self.ends = 0
        self.due: float | None = 0.0
        self.has_listened = False
        self.since: float | None = None  # when it was first seen listening, of the process that runs
        self.said = b""
        self.failure = ""

    def read(self) -> None:
        """Keep the end of what it writes to standard error."""
        if not self.errors.is_open:
            return
        with contextlib.suppress(BlockingIOError):
            while part := os.read(self.errors.number, 4096):
                self.said = (self.said + part)[-_QUOTED:]

    @property
    def words(self) -> str:
        """What it said last, in one line."""
        return " ".join(self.said.decode(errors="replace").split()) or "nothing"


class Servers:
    """Starts the server processes of an exchange and keeps them running; a context manager."""

    def __init__(
        self,
        exchange: Hub,
        commands: Mapping[str, Sequence[str]],
        restarts: Sequence[float] = RESTARTS,
        well: float = WELL,
    ) -> None:
        self._exchange, self._restarts, self._well = exchange, tuple(restarts), well
        self._children = [_Child(name, command) for name, command in commands.items()]
        self.dead: set[str] = set()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="servers", daemon=True)

    def __enter__(self) -> Servers:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all processes."""
        self._over.set()
        self._thread.join()
        self._exchange.close()
        for child in self._children:
            if child.process is not None:
                self._end(child, child.process)
            child.errors.close()

    def ready(self, patience: float = 30.0) -> list[str]:
        """Wait until every server listens, and return who listens where."""
        until = time.monotonic() + patience
        while silent := [child.name for child in self._children if self._exchange.outlets[child.name].where is None]:
            failed = next((child for child in self._children if child.failure), None)
            if failed is not None:
                raise LinkError(f"Expected the server {failed.name} to listen, but it {failed.failure}")
            if time.monotonic() > until:
                names = ", ".join(silent)
                raise LinkError(f"Expected {names} to listen within {patience:g} s, but nothing came. Start again.")
            self._over.wait(_LOOK)
        return [where for outlet in self._exchange.outlets.values() for where in outlet.where or ()]

    def processes(self) -> dict[str, int]:
        """Return the process id of each server that runs."""
        running = [child for child in self._children if child.process is not None and child.process.poll() is None]
        return {child.name: child.process.pid for child in running if child.process is not None}

    def _watch(self) -> None:
        while not self._over.is_set():
            for child in [child for child in self._children if child.due is not None]:
                try:
                    self._look(child)
                except Exception as error:  # of one server: the others are watched on
                    self._fail(child, error)
            try:
                self._exchange.idle(_IDLE)
            except Exception as error:
                what = f"{type(error).__name__}: {error}"
                self._exchange.tell(f"Requests of clients were not taken, {what}. The servers go on.", warn=True)
            self._over.wait(_LOOK)

    def _look(self, child: _Child) -> None:
        if child.process is not None:
            child.read()
            if child.since is None and self._exchange.outlets[child.name].where is not None:
                child.since = time.monotonic()
            if child.process.poll() is not None:
                self._ended(child, child.process)
        if child.process is None and child.due is not None and time.monotonic() >= child.due:
            self._start(child)

    def _fail(self, child: _Child, error: Exception) -> None:
        """End a server that cannot be watched; it starts again as one that ended by itself."""
        if child.process is not None:
            child.process.kill()
            child.process.communicate()
            child.process = None
        child.said = f"{type(error).__name__}: {error}".encode()
        self._plan(child, "could not be watched")

    def _start(self, child: _Child) -> None:
        child.said = b""
        theirs = self._exchange.open(child.name)
        command = [word.replace(PLACE, str(theirs.fileno())) for word in child.command]
        child.errors.close()
        number, errors = os.pipe()
        child.errors = Descriptor(number)
        os.set_blocking(number, False)
        try:
            child.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C reaches the bridge alone, which brings the arm to rest first
            )
        except OSError as error:
            child.said = str(error).encode()
            self._plan(child, "could not be started")
        finally:
            os.close(errors)
            theirs.close()

    def _ended(self, child: _Child, process: subprocess.Popen[bytes]) -> None:
        child.read()
        child.errors.close()
        child.process = None
        self._plan(child, f"ended with status {process.returncode}")

    def _plan(self, child: _Child, what: str) -> None:
        """Say when a server that is gone starts again: never, if it has not listened before.

        Ends are counted as one series until a process has listened for long: a fault that comes back at once ends
        the server, and one a day does not.
        """
        outlet = self._exchange.outlets[child.name]
        child.has_listened |= outlet.where is not None
        outlet.close()
        since, child.since = child.since, None
        if since is not None and time.monotonic() - since >= self._well:
            child.ends = 0
        if not child.has_listened:
            child.due, child.failure = None, f"{what}. It said: {child.words}"
            return
        if child.ends < len(self._restarts):
            delay = self._restarts[child.ends]
            child.due, then = time.monotonic() + delay, f"It starts again in {delay:g} s."
        else:
            child.due, then = None, "It stays dead; the loop goes on."
            self.dead.add(child.name)
        child.ends += 1
        self._exchange.tell(f"The server {child.name} {what}. {then} It said: {child.words}", warn=True)

    def _end(self, child: _Child, process: subprocess.Popen[bytes]) -> None:
        """Let a process end, now that its socket is closed."""
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        child.read()
        child.errors.close()


class Offering:
    """Offers the rows of runs to `armlab monitor` and views until it is closed.

    Clients may stop the arms where the controller is made `stoppable`, and nothing else.
    """

    def __init__(self, robots: Sequence[Robot], cell: str) -> None:
        self.exchange = Hub(robots, [OPERATOR], about={"cell": cell})
        self.exchange.arbiter.reserve("the controller of the run")
        self._servers = Servers(self.exchange, {OPERATOR: server_command(OPERATOR, {"path": str(socket_path(cell))})})
        self._servers.__enter__()
        try:
            self._servers.ready()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the feed; its clients are told that it has ended."""
        self._servers.close()


def stoppable(controller: Controller, arbiter: Arbiter) -> Controller:
    """Return the controller that holds while somebody has stopped the arms."""

    def controlled(state: State) -> Any:
        arbiter.poll()
        return None if arbiter.stopped else controller(state)

    return controlled
