"""What the tests of all servers of ROS share."""

from __future__ import annotations

import pytest


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters and diagnostics come ten times a second, an arm is silent after a fifth of one."""
    monkeypatch.setattr("armlab.bridge.servers.ros.server._AGAIN", 0.1)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._PERIOD_NS", 10**8)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._SILENT", 0.2)
