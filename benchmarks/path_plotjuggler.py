"""Datagrams for PlotJuggler: `path_plotjuggler.py read PORT COUNT`, `path_plotjuggler.py write PORT`.

The reader parses each datagram, as PlotJuggler does; the writer creates the server's datagrams in plain Python.
"""

from __future__ import annotations

import contextlib
import json
import socket
import sys

import msgspec
from path_ends import ROBOT, Lines, numbers, paced

FIELDS = ("q", "qd", "tau", "wrench", "wrench_hat", "q_sent", "qd_sent", "tau_sent", "q_ref", "qd_ref", "tau_ref")


def main() -> None:
    role, port, *count = sys.argv[1:]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        if role == "read":
            one.bind(("127.0.0.1", int(port)))
            one.settimeout(1.0)
            lines = Lines(int(count[0]))
            while not lines.over.is_set():
                with contextlib.suppress(TimeoutError):
                    found = json.loads(one.recv(65536))
                    if ROBOT in found:
                        lines.add("J", round(1e9 * found["timestamp"]))
            lines.tell()
        else:
            one.connect(("127.0.0.1", int(port)))
            paced(lambda stamp_ns: _send(one, stamp_ns))


def _send(one: socket.socket, stamp_ns: int) -> None:
    values = {str(k): value for k, value in enumerate(numbers(stamp_ns)[0], start=1)}
    with contextlib.suppress(ConnectionRefusedError):  # the reader has not started
        one.send(msgspec.json.encode({"timestamp": 1e-9 * stamp_ns, ROBOT: dict.fromkeys(FIELDS, values)}))


if __name__ == "__main__":
    main()
