"""Started by tests: `client.py SERVER PORT ROLE LETTER`, a client of a cell with the arm yumi_left; runs until killed.

SERVER is labcomm, zenoh or rmw_zenoh. ROLE "command" (labcomm and zenoh only) commands a small velocity in each cycle;
over zenoh, it prints the answers. "read" reads all messages and prints "row" for the first, "gap 3 KEY" if three are
missing, and "back 1 KEY" if the number does not increase. LETTER sets the identity of the sender.
"""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np

from armlab.bridge.servers.labcomm import Row
from armlab.bridge.servers.labcomm.client import LabCommClient
from armlab.bridge.servers.ros.rmw_zenoh import Origin
from armlab.bridge.servers.zenoh.messages import Attachment, key
from armlab.bridge.servers.zenoh.session import LabAddress

PERIOD = 0.004
UP, DOWN = 0.01, -0.01  # rad/s, over zenoh and labcomm


def command(session: Any, sender: bytes) -> None:
    """Send velocity commands over zenoh until the process ends."""
    place = key("lab", "yumi_left", f"answer/{sender.hex()}")
    session.declare_subscriber(place, lambda sample: print(sample.payload.to_string(), flush=True))
    place, qd, due = key("lab", "yumi_left", "command/velocity"), np.full(7, UP), time.monotonic()
    for k in range(1, 10**6):
        session.put(place, qd.tobytes(), attachment=Attachment(sender, k, 0).pack())
        due = max(due + PERIOD, time.monotonic() - PERIOD)
        time.sleep(max(0.0, due - time.monotonic()))


def read(session: Any, dialect: str) -> None:
    """Read all messages; check the sequence numbers of those sent every tick."""
    last: dict[str, int] = {}

    def take(sample: Any) -> None:
        name = str(sample.key_expr)
        if dialect == "rmw_zenoh":
            origin = Origin.read(sample.attachment.to_bytes())
            number = -1 if origin is None else origin.seq
        elif name.endswith(("/live", "/state")):
            number = int.from_bytes(sample.payload.to_bytes()[16:24], "little")
        else:
            return
        if not last:
            print("row", flush=True)
        missing = number - last.get(name, number - 1) - 1
        if missing:
            print("gap" if missing > 0 else "back", abs(missing), name, flush=True)
        last[name] = number

    every = key("lab", "yumi_left", "*") if dialect == "zenoh" else "0/yumi_left/**"
    session.declare_subscriber(every, take)
    threading.Event().wait(600.0)


def main() -> None:
    dialect, port, role, letter = sys.argv[1:]
    if dialect == "labcomm":
        with LabCommClient(port=int(port)) as client:  # it starts from the arm's position
            client.run(lambda row: Row(row.tm, row.q, np.full(7, DOWN)))
        return
    session = LabAddress("127.0.0.1", int(port)).open(20.0)
    if role == "command":
        command(session, 16 * letter.encode())
    else:
        read(session, dialect)


if __name__ == "__main__":
    main()
