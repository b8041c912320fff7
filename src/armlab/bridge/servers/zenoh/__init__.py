"""Zenoh: rows, parameters, events and commands of a cell under ``armlab/<lab>/<robot>/`` (docs/how_to/zenoh.md).

`ZenohFeed` reads a bridge elsewhere, ``bridge.connect("zenoh://host:7447/lab", robot)`` runs a controller over it.
`open_session`, `key`, `robots_at`, `Asking`, `undamaged`, `Place` and `Gaps` are for those who listen to many bridges.
"""

from armlab.bridge.servers.zenoh.address import Place
from armlab.bridge.servers.zenoh.feed import ZenohFeed, robots_at
from armlab.bridge.servers.zenoh.keys import EVERY, Attached, key, robot_of
from armlab.bridge.servers.zenoh.rows import Gaps, checksum, undamaged
from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.servers.zenoh.session import Asking, close_session, open_session, queried

__all__ = [
    "EVERY",
    "Asking",
    "Attached",
    "Gaps",
    "Place",
    "Security",
    "ZenohFeed",
    "checksum",
    "close_session",
    "key",
    "open_session",
    "queried",
    "robot_of",
    "robots_at",
    "undamaged",
]
