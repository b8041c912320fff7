"""`inspect`, and where the columns of a recording are."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from armlab import log, robots
from armlab.errors import LogError
from armlab.log.mcap.records import contents
from armlab.log.recording.columns import (
    clock_channel,
    kept_clock,
    sources_of,
)
from armlab.log.recording.metadata import Event, Inspection, Setting, Topic, inspect
from armlab.log.recording.recorder import Recorder
from armlab.log.recording.ros_messages import T0_KEY


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


@pytest.mark.parametrize(
    ("encoding", "text", "told"),
    [
        ("ros2msg", b"string msg", ["a", "c"]),
        ("ros2idl", b"module rcl_interfaces { module msg { struct Log { string msg; }; }; };", ["a", "c"]),
        ("ros2msg", b"string[[[", []),
        ("ros2msg", b"uint32 x", []),
    ],
)
def test_events_of_another_program(tmp_path: Path, encoding: str, text: bytes, told: list[str]) -> None:
    """A damaged one is left out alone, and a type that cannot be read leaves everything else to be seen."""
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("rcl_interfaces/msg/Log", encoding, text)
        channel = writer.register_channel("/rosout", "cdr", schema)
        for row, word in enumerate((b"a", b"\xff", b"c")):
            writer.add_message(channel, row, b"\0\1\0\0" + struct.pack("<I", 2) + word + b"\0", row, row)
        writer.finish()
    held = inspect(path)
    assert [event.text for event in held.events] == told
    assert held.topics == (Topic("/rosout", "rcl_interfaces/msg/Log", 3),)


def test_settings_of_parameters(tmp_path: Path) -> None:
    """Any value that a parameter may have comes back as it was, from a file that was cut off too."""
    values = [2.5, -3, True, "a 'word' \u00e9", [0.0, 1.5e-300]]
    with Recorder(tmp_path / "run.mcap", robots.load("yumi_right")) as recorder:
        for k, value in enumerate(values):
            recorder.parameter(k, f"p{k}", np.array(value) if k == 4 else value, "local 1", 10**18 + k)
    found = [Setting(10**18 + k, k, f"p{k}", value, "local 1") for k, value in enumerate(values)]
    assert list(inspect(recorder.path).parameters) == found
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recorder.path.read_bytes()[:-100])
    assert list(inspect(torn).parameters) == found


def test_a_setting_in_the_other_byte_order(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = b"int64 sequence\nstring name\nstring value\nstring who"
        schema = writer.register_schema("armlab_msgs/msg/Parameter", "ros2msg", text)
        channel = writer.register_channel("/parameters", "cdr", schema)
        texts = (struct.pack(">I", 2) + letter + b"\0\0\0" for letter in (b"a", b"7", b"b"))
        writer.add_message(channel, 5, b"\0\0\0\0" + struct.pack(">q", 5) + b"".join(texts), 5, 5)
        writer.finish()
    assert inspect(path).parameters == (Setting(5, 5, "a", 7, "b"),)


def test_the_clock_that_is_written_beside_t(recording: Callable[..., Path], tmp_path: Path) -> None:
    table = log.read(recording(30)).shifted(5.0)
    path = log.write(table, tmp_path / "shifted.mcap", robots.load("yumi_right"))
    found = contents(memoryview(path.read_bytes()))
    sources = sources_of(found, clock_channel(found, path, None))
    assert kept_clock(found, sources, 0, "") == (table.t0_ns, "robot")
    assert kept_clock(found, {}, 3, "file") == (3, "file")
    found.channels[sources["t"].channel].metadata[T0_KEY] = "today"
    with pytest.raises(LogError, match="got 'today'"):
        kept_clock(found, sources, 0, "")
