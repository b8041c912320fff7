"""Counting rows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.bridge.servers.status import Status
from armlab.log import Tick
from armlab.state import State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def test_counts() -> None:
    schema = RowSchema.of([LEFT, RIGHT])
    writer, status = RowWriter(schema), Status(schema)
    for k in range(250):
        q = np.zeros(7)
        state = State(0.004 * k, 0.004, q, q, q, robot="yumi_left", session=2, missed=k == 10)
        clamped = np.array([1, 2, 0, 0, 0, 0, 12], dtype=np.uint8) if k < 3 else None
        tick = Tick(k, k, 10**18, 10**18, 10**18 + 1000 * (100 + k), 0, late=k == 20, drops=4, clamped=clamped)
        data = writer.row(state, None, tick, 4_000_000 * k)
        if k != 100:
            status.add(data)
    found = status.summary()
    assert (found["rows"], found["lost"]) == (249, 1)
    left = found["arms"]["yumi_left"]
    assert left["rate"] == pytest.approx(249.0, rel=0.01)
    assert left["p50"] == pytest.approx(225.0, abs=2.0)
    assert left["longest"] == pytest.approx(349.0)
    assert (left["missed"], left["late"], left["drops"], left["session"]) == (1, 1, 4, 2)
    assert left["clamps"]["position"][0] == left["clamps"]["velocity"][1] == left["clamps"]["braking"][6] == 3
    assert math.isnan(found["arms"]["yumi_right"]["p50"])
    assert found["arms"]["yumi_right"]["rows"] == 0
