"""The local feed: a Unix socket of the user's own, for `armlab monitor`, `armlab bridge set` and live views."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec

from armlab.bridge.servers.messages import Request
from armlab.bridge.servers.row import MAGIC, Row, RowSchema, read_row
from armlab.errors import ConfigError, LinkError

__all__ = ["LocalFeed", "cells", "socket_path"]

_LARGEST = 2**17


def socket_path(cell: str) -> Path:
    """Return where the local feed of a cell is, in a folder of the user's own.

    Parameters
    ----------
    cell : its name.

    Raises
    ------
    LinkError : the folder belongs to somebody else or is open to others.
    """
    given = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(given) / "armlab" if given else Path(tempfile.gettempdir()) / f"armlab-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
        raise LinkError(f"Expected {folder} to be a folder that only you can enter. Remove it, or set XDG_RUNTIME_DIR.")
    return folder / f"{cell}.sock"


def cells() -> list[str]:
    """Return the names of the cells that run under this user."""
    found = []
    for path in sorted(socket_path("x").parent.glob("*.sock")):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as one:
            one.connect(str(path))
            found.append(path.stem)
    return found


class LocalFeed:
    """A client of the local feed; a context manager.

    Parameters
    ----------
    cell : name of the cell; "" when only one runs. patience : s to wait for a message.

    Raises
    ------
    LinkError : no such bridge runs. ConfigError : several run, and none was named.
    """

    def __init__(self, cell: str = "", patience: float = 5.0) -> None:
        if not cell:
            running = cells()
            if len(running) > 1:
                raise ConfigError(f"Expected the name of a cell, since {', '.join(running)} run. Give --cell NAME.")
            cell = running[0] if running else ""
        if not cell:
            raise LinkError(
                "Expected a running bridge of this user, but found none. Start armlab bridge --config CELL."
            )
        self.cell = cell
        self._schema: RowSchema | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(patience)
        try:
            self._socket.connect(str(socket_path(cell)))
        except OSError as error:
            self._socket.close()
            raise LinkError(
                f"Expected the bridge of the cell {cell!r} to run, but it cannot be reached ({error}). "
                "Start armlab bridge --config CELL."
            ) from error

    def __enter__(self) -> LocalFeed:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave."""
        self._socket.close()

    def wait(self, seconds: float) -> bool:
        """Return whether a message comes within so many seconds.

        Parameters
        ----------
        seconds : at most.
        """
        return bool(select.select([self._socket], [], [], max(seconds, 0.0))[0])

    def ask(self, request: Request) -> None:
        """Send a request.

        Parameters
        ----------
        request : see `messages`.
        """
        try:
            self._socket.send(msgspec.json.encode(request))
        except OSError as error:
            raise LinkError(f"Expected the bridge to take a request, but {error}. It may have ended.") from error

    def receive(self) -> Row | dict[str, Any]:
        """Return the next message: a row, or what another message says, by name, with its "kind".

        Raises
        ------
        LinkError : the bridge has ended, or nothing came in time.
        """
        while True:
            try:
                data = self._socket.recv(_LARGEST)
            except TimeoutError:
                raise LinkError(
                    "Expected a message of the bridge in time, but none came. See whether it runs."
                ) from None
            except OSError:
                data = b""
            if not data:
                raise LinkError(f"Expected the bridge of {self.cell} to go on, but it closed the feed.")
            if data[:4] != MAGIC:
                message = msgspec.json.decode(data)
                if message["kind"] == "about":
                    self._schema = RowSchema.read(message["schema"].encode())
                return message
            if self._schema is not None:
                return read_row(self._schema, data)
