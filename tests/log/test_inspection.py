"""What a recording holds besides its table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from armlab.errors import LogError
from armlab.log.inspection import Event, Inspection, Topic, inspect


def test_topics_events_and_sizes(recording: Callable[..., Path]) -> None:
    path = recording(50)
    held = inspect(path)
    assert isinstance(held, Inspection)
    counts = {topic.name: topic.messages for topic in held.topics}
    assert counts["/yumi_right/tick"] == counts["/yumi_right/joint_states"] == 50
    assert counts["/yumi_right/columns/q_ext"] == 0
    assert Topic("/yumi_right/events", "rcl_interfaces/msg/Log", 1) in held.topics
    assert isinstance(held.events[0], Event)
    assert held.size == path.stat().st_size
    assert held.path == path


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    assert inspect(path).topics == ()
    path.write_bytes(b"text")
    with pytest.raises(LogError, match="format text"):
        inspect(path)
