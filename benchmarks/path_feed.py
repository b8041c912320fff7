"""Readers of complete rows with armlab's own clients: `path_feed.py zenoh|local|labcomm WHERE COUNT`."""

from __future__ import annotations

import os
import sys

from path_ends import PATIENCE, ROBOT, Lines

from armlab.bridge.servers.labcomm import LabCommClient
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from armlab.bridge.servers.row import Row
from armlab.wire.labcomm import Sample


def main() -> None:
    kind, where, count = sys.argv[1:]
    lines = Lines(int(count))
    if kind == "labcomm":
        _labcomm(int(where), lines)
    else:
        _feed(kind, where, lines)
    lines.tell()
    os._exit(0)


def _labcomm(port: int, lines: Lines) -> None:
    """Receive fused rows, whose stamps are in whole microseconds."""
    with LabCommClient(port=port) as client:
        while not lines.over.is_set():
            for event in client.events(1.0):
                if isinstance(event, Sample) and event.name == "fused_row":
                    lines.add("J", 1000 * event.value["t_us"])


def _feed(kind: str, where: str, lines: Lines) -> None:
    if kind == "zenoh":
        from armlab.bridge.servers.zenoh.feed import ZenohFeed

        feed = ZenohFeed(where, patience=PATIENCE)
    else:
        feed = LocalFeed(where, patience=PATIENCE)
    feed.ask(Subscribe(rate=None))
    while not lines.over.is_set():
        if not feed.wait(1.0):
            continue
        message = feed.receive()
        if isinstance(message, Row) and message.values[f"{ROBOT}.fresh"]:
            lines.add("J", message.wall_ns)


if __name__ == "__main__":
    main()
