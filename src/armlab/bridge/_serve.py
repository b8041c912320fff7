"""The process of one server: ``python -m armlab.bridge._serve NAME SOCKET OPTIONS``. Ends when the loop closes."""

from __future__ import annotations

import json
import socket
import sys
from pathlib import Path
from typing import Any

from armlab.errors import ArmlabError


def _local(feed: socket.socket, options: dict[str, Any]) -> None:
    from armlab.bridge.local_server import LocalServer

    LocalServer(feed, Path(options["path"])).run()


def _labcomm(feed: socket.socket, options: dict[str, Any]) -> None:
    from armlab.bridge.labcomm.process import LabCommProcess

    LabCommProcess(feed, options).run()


_SERVERS = {"local": _local, "labcomm": _labcomm}


def main(name: str, number: str, options: str) -> int:
    """Serve; return the status of the process."""
    with socket.socket(fileno=int(number)) as feed:
        try:
            _SERVERS[name](feed, json.loads(options))
        except (ArmlabError, OSError) as error:
            sys.stderr.write(f"{error}\n")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
