"""Our own bridge beside third-party clients: follows one arm until its robot stops, prints one line of JSON.

    python beside.py PORT

A late cycle is our fault if the loop's own processor time around it exceeded the share of the period after which a
reply is late; otherwise the processor was busy elsewhere.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np

from armlab import bridge, robots
from armlab.log import Column
from armlab.state import Command, State

DEADLINE = 0.75 * 0.004032  # s


def controller(state: State) -> Command:
    """Sway joint 1, and note how much processor time this thread has used."""
    q = state.q_start + 0.1 * (1.0 - np.cos(0.5 * state.t)) * np.eye(7)[0]
    return Command(q, record={"used": time.thread_time()})


def main(port: int) -> dict[str, int]:
    """Run until the robot is silent, and count."""
    with bridge.connect(f"egm://127.0.0.1:{port}", robots.load("yumi_left")) as link:
        run = link.run(controller, wait="block", reconnect="stop", extra={"used": Column(unit="s")})
    table = run.table
    used = table["used"]
    around = np.concatenate((used[2:] - used[:-2], np.zeros(2)))[np.r_[0, 0 : len(used) - 1]]
    late = table["late"].astype(bool)
    counts = {name: int(run.statistics[name]) for name in ("packets", "replies", "overtaken", "late")}
    return {**counts, "own": int(np.sum(late & (around > DEADLINE))), "rows": len(table)}


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]))))
