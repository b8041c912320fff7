"""Publisher of robot rows at 250 Hz each, for bench_fleet_robots: `fleet_publisher.py PORT FIRST COUNT`.

It stops when standard input is closed, and prints the number of rows per robot. It sends rows of 400 bytes as a bridge
does.
"""

from __future__ import annotations

import json
import select
import struct
import sys
import time
from dataclasses import replace
from functools import partial
from typing import Any

from armlab import robots
from armlab.bridge.servers.row import MAGIC, RowSchema
from armlab.bridge.servers.zenoh.messages import checksum, key
from armlab.bridge.servers.zenoh.session import BlockingPublisher, close_session, open_session
from armlab.robots import to_toml

PERIOD = 0.004
HEAD = struct.Struct("<4sI8sQqq")
FIELDS = ("q", "qd", "tau", "q_ref", "q_sent", "tick", "seq", "fresh", "commander")


def main() -> None:
    port, first, count = (int(word) for word in sys.argv[1:])
    session = open_session("client", connect=[f"127.0.0.1:{port}"])
    arms = [_Arm(session, f"arm{first + k}") for k in range(count)]
    due, number = time.monotonic(), 0
    while not select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()))[0]:
        arms[number % count].send(number // count)
        number += 1
        due += PERIOD / count  # staggered, like independent robots
    print(number // count, flush=True)
    for arm in arms:
        arm.output.close()
    close_session(session)


class _Arm:
    def __init__(self, session: Any, name: str) -> None:
        robot = replace(robots.load("yumi_right"), name=name)
        whole, fields, at = RowSchema.of([robot]), [], HEAD.size
        for field in whole.fields.values():
            if field.name.partition(".")[2] in FIELDS:
                fields.append(replace(field, offset=at))
                at += field.size
        self.schema = RowSchema([name], fields)
        said = [{"schema": self.schema.text.decode(), "robots": {name: to_toml(robot)}}]
        self.row, self.tick = bytearray(self.schema.size), self.schema.fields[f"{name}.tick"].offset
        self.about = session.declare_queryable(
            key("lab1", name, "about"), partial(_answer, key("lab1", name, "about"), json.dumps(said))
        )
        self.output = BlockingPublisher(session, key("lab1", name, "state"))

    def send(self, tick: int) -> None:
        schema = self.schema
        HEAD.pack_into(self.row, 0, MAGIC, schema.size, schema.id, tick + 1, time.monotonic_ns(), time.time_ns())
        struct.pack_into("<q", self.row, self.tick, tick)
        data = bytes(self.row)
        self.output.put(data, checksum(data))


def _answer(where: str, text: str, query: Any) -> None:
    with query:
        query.reply(where, text)


if __name__ == "__main__":
    main()
