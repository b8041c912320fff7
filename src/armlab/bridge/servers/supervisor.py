"""`Servers`: one supervised process per server, restarted after a crash and isolated from the loop."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from armlab._files import Descriptor
from armlab.bridge.arbiter import Arbiter
from armlab.bridge.control.loop import Controller
from armlab.bridge.servers.hub import OPERATOR, Hub
from armlab.bridge.servers.local import socket_path
from armlab.errors import LinkError
from armlab.robots import Robot
from armlab.state import State

__all__ = ["Offering", "PLACE", "RESTARTS", "Servers", "WELL", "server_command", "stoppable"]

PLACE = "{fd}"
"""Placeholder in a command line for the file descriptor of the socket to the loop."""

RESTARTS = (1.0, 5.0, 30.0)
"""Delays before a crashed server is restarted [s]; after the last delay, it is not restarted again."""

WELL = 300.0
"""Uptime after which the restart count of a server is reset [s]."""

_CHECK_EVERY = 0.05  # s
_IDLE = 200_000_000  # ns without a robot packet after which requests are handled here
_QUOTED = 1000  # kept bytes of a server's last error output
_PATIENCE = 3.0  # s for a process to exit before it is killed


def server_command(name: str, options: Mapping[str, Any]) -> list[str]:
    """Return the command line of an armlab server."""
    return [sys.executable, "-m", "armlab.bridge.servers.serve", name, PLACE, json.dumps(dict(options))]


class _Child:
    """Command line, process and restart count of one server."""

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self.name, self.command = name, list(command)
        self.process: subprocess.Popen[bytes] | None = None
        self.errors = Descriptor(-1)  # pipe from its standard error
        self.ends = 0
        self.due: float | None = 0.0
        self.has_listened = False
        self.since: float | None = None  # when the running process was first seen listening
        self.output = b""
        self.failure = ""

    def read(self) -> None:
        """Read the standard error of the process and keep the most recent output."""
        if not self.errors.is_open:
            return
        with contextlib.suppress(BlockingIOError):
            while part := os.read(self.errors.number, 4096):
                self.output = (self.output + part)[-_QUOTED:]

    @property
    def last_output(self) -> str:
        """Last error output of the process, as one line."""
        return " ".join(self.output.decode(errors="replace").split()) or "nothing"


class Servers:
    """Supervisor that starts and restarts the server processes of a hub; use it as a context manager."""

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

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop all processes."""
        self._over.set()
        self._thread.join()
        self._exchange.close()
        for child in self._children:
            if child.process is not None:
                self._end(child, child.process)
            child.errors.close()

    def ready(self, patience: float = 30.0) -> list[str]:
        """Wait until every server is listening; return their addresses."""
        until = time.monotonic() + patience
        while silent := [child.name for child in self._children if self._exchange.outlets[child.name].where is None]:
            failed = next((child for child in self._children if child.failure), None)
            if failed is not None:
                raise LinkError(f"Expected the server {failed.name} to listen, but it {failed.failure}")
            if time.monotonic() > until:
                names = ", ".join(silent)
                raise LinkError(
                    f"Expected {names} to listen within {patience:g} s, got no report. Start the bridge again."
                )
            self._over.wait(_CHECK_EVERY)
        return [where for outlet in self._exchange.outlets.values() for where in outlet.where or ()]

    def processes(self) -> dict[str, int]:
        """Return the process id of each running server."""
        running = [child for child in self._children if child.process is not None and child.process.poll() is None]
        return {child.name: child.process.pid for child in running if child.process is not None}

    def _watch(self) -> None:
        while not self._over.is_set():
            for child in [child for child in self._children if child.due is not None]:
                try:
                    self._check(child)
                except Exception as error:  # affects one server; the others stay supervised
                    self._fail(child, error)
            try:
                self._exchange.idle(_IDLE)
            except Exception as error:
                what = f"{type(error).__name__}: {error}"
                self._exchange.tell(f"Client requests could not be handled: {what}. The servers continue.", warn=True)
            self._over.wait(_CHECK_EVERY)

    def _check(self, child: _Child) -> None:
        if child.process is not None:
            child.read()
            if child.since is None and self._exchange.outlets[child.name].where is not None:
                child.since = time.monotonic()
            if child.process.poll() is not None:
                self._ended(child, child.process)
        if child.process is None and child.due is not None and time.monotonic() >= child.due:
            self._start(child)

    def _fail(self, child: _Child, error: Exception) -> None:
        """Kill a server whose supervision failed; the server is then restarted as after a crash."""
        if child.process is not None:
            child.process.kill()
            child.process.communicate()
            child.process = None
        child.output = f"{type(error).__name__}: {error}".encode()
        self._plan(child, "could not be supervised")

    def _start(self, child: _Child) -> None:
        child.output = b""
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
                start_new_session=True,  # Ctrl-C interrupts only the bridge, which brings the arm to rest first
            )
        except OSError as error:
            child.output = str(error).encode()
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
        """Schedule the restart of a server that has ended, unless it never listened.

        The restart count is reset once a process has listened for `well` seconds, so only a fault that recurs soon
        stops the server permanently.
        """
        outlet = self._exchange.outlets[child.name]
        child.has_listened |= outlet.where is not None
        outlet.close()
        since, child.since = child.since, None
        if since is not None and time.monotonic() - since >= self._well:
            child.ends = 0
        if not child.has_listened:
            child.due, child.failure = None, f"{what}. Its output: {child.last_output}"
            return
        if child.ends < len(self._restarts):
            delay = self._restarts[child.ends]
            child.due, then = time.monotonic() + delay, f"The server restarts in {delay:g} s."
        else:
            child.due, then = None, "The server is not restarted; the loop continues."
            self.dead.add(child.name)
        child.ends += 1
        self._exchange.tell(f"The server {child.name} {what}. {then} Its output: {child.last_output}", warn=True)

    def _end(self, child: _Child, process: subprocess.Popen[bytes]) -> None:
        """Wait for a process to exit after its socket has been closed."""
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        child.read()
        child.errors.close()


class Offering:
    """Feed of a link's rows for `armlab monitor` and viewers; its clients may only read rows and stop the arms (see
    `stoppable`)."""

    def __init__(self, robots: Sequence[Robot], cell: str) -> None:
        self.exchange: Hub = Hub(robots, [OPERATOR], about={"cell": cell})
        self.exchange.arbiter.reserve("the controller of the run")
        self._servers = Servers(self.exchange, {OPERATOR: server_command(OPERATOR, {"path": str(socket_path(cell))})})
        self._servers.__enter__()
        try:
            self._servers.ready()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the feed and disconnect its clients."""
        self._servers.close()


def stoppable(controller: Controller, arbiter: Arbiter) -> Controller:
    """Wrap a controller so that the arms hold position while stopped by a client."""

    def controlled(state: State) -> Any:
        arbiter.poll()
        return None if arbiter.stopped else controller(state)

    return controlled
