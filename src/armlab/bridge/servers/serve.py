"""The process of one server: ``python -m armlab.bridge.servers.serve NAME SOCKET OPTIONS``, until the loop closes."""

from __future__ import annotations

import json
import socket
import sys
from importlib import import_module

from armlab.errors import ArmlabError

_SERVERS = {
    "local": "armlab.bridge.servers.local",
    "labcomm": "armlab.bridge.servers.labcomm.process",
    "ros2": "armlab.bridge.servers.ros.dds",
    "rosbridge": "armlab.bridge.servers.rosbridge.server",
    "zenoh": "armlab.bridge.servers.zenoh.process",
    "rmw_zenoh": "armlab.bridge.servers.ros.rmw_zenoh",
    "ros1": "armlab.bridge.servers.ros1.process",
    "plotjuggler": "armlab.bridge.servers.plotjuggler",
}
"""Module of each server, which has ``serve(feed, options)``."""


def main(name: str, number: str, options: str) -> int:
    """Serve; return the status of the process."""
    with socket.socket(fileno=int(number)) as feed:
        try:
            import_module(_SERVERS[name]).serve(feed, json.loads(options))
        except (ArmlabError, OSError) as error:
            sys.stderr.write(f"{error}\n")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
