"""Started by tests: `labcomm_client.py PORT`, a commander of a YuMi arm over LabComm; ends by a signal.

It answers each row with the position that it names and a small velocity downwards.
"""

from __future__ import annotations

import sys

import numpy as np

from armlab.bridge.servers.labcomm import Row
from armlab.bridge.servers.labcomm.client import LabCommClient

SPEED = -0.01  # rad/s


def answer(row: Row) -> Row:
    """Go on from where the arm is."""
    return Row(row.tm, row.q, np.full(7, SPEED))


if __name__ == "__main__":
    with LabCommClient(port=int(sys.argv[1])) as client:
        client.run(answer)
