"""Started by tests: `publisher.py router PORT`, or `publisher.py publisher PORT ROBOT [NAME [PERIOD [TICK]]]`: a Zenoh
server at the other end of an exchange, as in a bridge, with a row of that robot every 4 ms, or every PERIOD seconds,
until standard input is closed; the first row has tick TICK."""

from __future__ import annotations

import select
import sys
import threading
import time
from dataclasses import replace

import numpy as np

from armlab import robots
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.zenoh.process import ZenohProcess
from armlab.fleet import Router
from armlab.log import Tick
from armlab.state import State


def main() -> None:
    kind, port, *words = sys.argv[1:]
    if kind == "router":
        with Router(port=int(port)) as router:
            print(router.where, flush=True)
            sys.stdin.read()
        return
    model, name, period, first = [*words, *(words[0], "0.004", "0")[len(words) - 1 :]]
    robot, period, tick = replace(robots.load(model), name=name), float(period), int(first)
    exchange = Hub([robot], ["zenoh"], about={"cell": robot.name})
    options = {"lab": "lab1", "host": "127.0.0.1", "port": 0, "router": f"127.0.0.1:{port}"}
    process = ZenohProcess(exchange.open("zenoh"), options)
    serving = threading.Thread(target=process.run)
    serving.start()
    print("ready", flush=True)
    rows, due, q = 0, time.monotonic(), np.array(robot.q_home)
    while not select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()))[0]:
        now = time.time_ns()
        state = State(t=period * rows, dt=period, q=q + 1e-6 * rows, qd=0 * q, tau=0 * q, robot=robot.name, seq=rows)
        exchange.row(state, None, Tick(tick + rows, -1, now, now, -1, 0))
        rows, due = rows + 1, due + period
    exchange.close()
    serving.join()
    print(rows, flush=True)


if __name__ == "__main__":
    main()
