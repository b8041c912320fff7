"""`listening_socket`: a TCP port of a server, or a sentence with who has it."""

from __future__ import annotations

import errno
import socket

from armlab.bridge.holder import holder
from armlab.errors import LinkError

__all__ = ["listening_socket"]


def listening_socket(host: str, port: int, name: str, backlog: int) -> socket.socket:
    """Return a socket that listens and never blocks; what it accepts sends small messages at once.

    Parameters
    ----------
    host, port : where; port 0 lets the system choose. name : what for, in messages. backlog : connections that wait.

    Raises
    ------
    LinkError : the port cannot be bound; names the process that has it where that can be told.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else one waits up to 40 ms for an acknowledgement
    try:
        listener.bind((host, port))
        listener.listen(backlog)
    except (OSError, OverflowError) as error:
        listener.close()
        is_taken = getattr(error, "errno", None) == errno.EADDRINUSE
        who = holder(port, "tcp") if is_taken else ""
        why = f"it is in use{f' by {who}' if who else ''}" if is_taken else f"{error}"
        raise LinkError(
            f"Expected TCP port {host}:{port} for {name} to be free, but {why}. End the program that has it or choose "
            "another port."
        ) from error
    listener.setblocking(False)
    return listener
