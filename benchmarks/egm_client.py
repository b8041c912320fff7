"""One EGM client for `bench_egm` in a separate process: `python egm_client.py NAME PORT[,PORT] [MODEL]`.

NAME is "ahead" or "spin" for armlab's bridge with an empty controller, "both" for two arms in one loop, "estimator" for
the contact-force estimator in the loop with the model file MODEL, or the name of a PyPI package, which sends back the
received joint positions. The bridge records a log in the temporary folder. All except "spin", which never yields, run
with real-time priority if permitted. The client prints "ready" when it listens.
"""

from __future__ import annotations

import os
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

PRIORITY = 50  # real-time priority, as in the bridge
SILENCE = 5.0  # s


def answer(package: str, port: int) -> None:
    """Reply to every packet with its own joint positions until the robot stops sending."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        print("normal priority", file=sys.stderr)
    egm = import_module(f"{package}.egm").EGM(port=port)
    print("ready", flush=True)
    found, state = egm.receive_from_robot(timeout=60.0)
    while found:
        egm.send_to_robot(joint_angles=state.joint_angles, external_joints=state.external_axes)
        found, state = egm.receive_from_robot(timeout=SILENCE)


def bridge(way: str, ports: list[int], file: Path | None) -> None:
    """Run armlab's bridge until the robot stops sending."""
    from armlab import models, robots
    from armlab.bridge import connect
    from armlab.contact import Estimator
    from armlab.errors import SessionEnded
    from armlab.models import TorqueModel
    from armlab.state import Command, State

    arms = [robots.load(name) for name in ("yumi_right", "yumi_left")[: len(ports)]][::-1]
    estimator: Any = None
    if file is not None:
        model = models.load(file)
        if not isinstance(model, TorqueModel):
            raise SystemExit(f"Expected a torque model in {file}.")
        estimator = Estimator(model, arms[0])

    def controller(state: State) -> Command:
        if estimator is not None:
            estimator.step(state)
        return Command(state.q_start)

    log = Path(tempfile.gettempdir()) / "run.mcap"
    try:
        with connect([f"egm://127.0.0.1:{port}" for port in ports], arms, extension=True, patience=60.0) as link:
            print("ready", flush=True)
            link.run(controller, wait="spin" if way == "spin" else "ahead", reconnect="stop", record=log)
    except SessionEnded:
        pass


if __name__ == "__main__":
    name, at, *more = sys.argv[1:]
    if name in ("ahead", "spin", "estimator", "both"):
        bridge(name, [int(port) for port in at.split(",")], Path(more[0]) if more else None)
    else:
        answer(name, int(at))
