"""rosbridge v2 over WebSocket, for roslibpy, roslibjs and web pages (docs/ros.md).

`Engine` is the protocol without sockets, `RosbridgeServer` the process that serves it.
"""

from armlab.bridge.servers.rosbridge.engine import Engine
from armlab.bridge.servers.rosbridge.server import RosbridgeServer

__all__ = ["Engine", "RosbridgeServer"]
