"""Shared helpers of the ROS server tests."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from armlab.bridge.inputs.parameters import Parameter

OTHERS = [
    Parameter("count", 3, type="int", minimum=0, rights="anyone"),
    Parameter("mode", "soft", type="text"),
    Parameter("is_on", True, type="bool", rights="anyone"),
    Parameter("axis", [1.0, 0.0], type="float[2]", rights="anyone"),
]
"""Parameters of the cells besides the gain: one of each type."""


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.ros.server._AGAIN", 0.1)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._PERIOD_NS", 10**8)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._SILENT", 0.2)


def cell_class(server: str) -> Any:
    """Return the class of a cell with a server and a node, over DDS ("ros2") or Zenoh ("rmw_zenoh")."""
    if server == "ros2":
        pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
        from .dds_peers import DdsCell as Cell
    else:
        pytest.importorskip("zenoh", reason="the extra net is not installed")
        from .zenoh_nodes import ZenohCell as Cell
    return Cell


@contextmanager
def turning_cell(server: str) -> Iterator[Any]:
    """Run the loop of a cell with a stationary arm."""
    one, over = cell_class(server)(), threading.Event()

    def turn() -> None:
        while not over.wait(0.004):
            one.commanded()

    loop = threading.Thread(target=turn)
    loop.start()
    yield one
    over.set()
    loop.join()
    one.close()
