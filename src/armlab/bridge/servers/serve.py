"""Entry point of a server process: ``python -m armlab.bridge.servers.serve NAME SOCKET OPTIONS``."""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from armlab.errors import ArmlabError

SERVERS = {
    "local": "local.LocalServer",
    "labcomm": "labcomm.process.LabCommProcess",
    "ros2": "ros.dds.DdsServer",
    "rosbridge": "rosbridge.server.RosbridgeServer",
    "zenoh": "zenoh.process.ZenohProcess",
    "rmw_zenoh": "ros.rmw_zenoh.RmwZenohServer",
    "ros1": "ros1.process.Ros1Process",
    "plotjuggler": "plotjuggler.PlotJugglerServer",
}
"""Class of each server, constructed from the loop's socket and options; `run` serves until the socket is closed."""


def serve(name: str, feed: socket.socket, options: Mapping[str, Any]) -> None:
    """Run the server until the loop closes the socket."""
    module, _, server = f"armlab.bridge.servers.{SERVERS[name]}".rpartition(".")
    getattr(import_module(module), server)(feed, options).run()


def main(name: str, number: str, options: str) -> int:
    with socket.socket(fileno=int(number)) as feed:
        try:
            serve(name, feed, json.loads(options))
        except (ArmlabError, OSError) as error:
            sys.stderr.write(f"{error}\n")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
