"""A user's program for one of the EGM clients on PyPI: moves joint 1, and axis 7 where there is one, along a cosine.

    python client.py ABBRobotEGM PORT MOTION_SECONDS

Runs in that client's environment, which has no armlab. Prints one line of JSON when the robot has stopped sending.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

import numpy as np

AMPLITUDE = 10.0  # degrees; the joint ends 20 degrees from where it began
PATIENCE = 30.0  # s for the first packet
SILENCE = 3.0  # s of silence that end the program


def main(package: str, port: int, duration: float) -> dict[str, Any]:
    """Answer every packet until the robot is silent, and return the observations."""
    egm = import_module(f"{package}.egm").EGM(port=port)
    found, state = receive(egm, PATIENCE)
    assert found, "no packet came"
    seen: dict[str, Any] = {"packets": 0, "restarts": 0, "error": 0.0, "first": joints(state)}
    first, seqno, tm = joints(state), -1, state.robot_message.header.tm
    while found:
        header, q = state.robot_message.header, joints(state)
        seen["packets"] += 1
        seen["restarts"] += header.seqno < seqno
        seqno = header.seqno
        phase = min(1e-3 * (header.tm - tm) / duration, 1.0)
        moved = AMPLITUDE * (1.0 - np.cos(np.pi * phase))
        wanted = [first[0] + moved, *first[1:6], *(angle + moved for angle in first[6:7])]
        if seen["restarts"] == 0:
            seen["error"] = max(seen["error"], abs(q[0] - wanted[0]))
        egm.send_to_robot(
            joint_angles=np.array(wanted[:6]),
            external_joints=np.array(wanted[6:]) if len(wanted) > 6 else None,
            rapid_to_robot=np.array([1.5, seen["packets"]]),
        )
        if state.rapid_from_robot is not None and len(state.rapid_from_robot):
            seen["rapid"] = [float(value) for value in state.rapid_from_robot]
        seen["last"], seen["wanted"] = q, wanted
        found, state = receive(egm, SILENCE)
    return seen


def receive(egm: Any, patience: float) -> tuple[bool, Any]:
    """Return the next packet."""
    return egm.receive_from_robot(timeout=patience)


def joints(state: Any) -> list[float]:
    """Return ABB's axes [degrees]: six, then the external ones."""
    external = [] if state.external_axes is None else state.external_axes
    return [float(angle) for angle in (*state.joint_angles, *external)]


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))))
