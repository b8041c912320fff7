"""Rows of a recording as bytes, as messages and as tables."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armlab.errors import LogError, ShapeError, UnknownName
from armlab.kernels import RowEncoder
from armlab.log import Column, Log, Tail, Tick, inspect, read
from armlab.log.assembly import recording_clock
from armlab.log.mcap.records import messages_in
from armlab.log.recording import ros_messages as messages
from armlab.log.recording.file import RecordingFile
from armlab.log.recording.ros_messages import Plan, Topic, definition, plan, topics
from armlab.log.recording.rows import NO_COUNT, SELDOM, RowLayout
from armlab.robots import Robot
from armlab.state import Command, State


def test_what_is_not_there_is_missing(robot: Robot) -> None:
    layout = RowLayout(robot)
    state = State(0.0, 0.004, np.zeros(7), np.zeros(7), np.full(7, np.nan), q_ext=np.array([0.5]))
    found = layout.unpack([layout.pack(state, None, Tick(0, NO_COUNT, 9, 0, NO_COUNT, 0))])
    for name in ("q_ref", "tau", "seq_sent", "send_ns", "clamped", "wrench_hat", "utilization"):
        assert np.isnan(found[name]).all(), name
    assert (found["robot_ns"].dtype, found["robot_ns"][0]) == (np.int64, 0)  # a clock keeps its mark
    assert found["q_ext"][0, 0] == 0.5
    assert np.isnan(found["q_ext"][0, 1:]).all()
    assert np.array_equal(found["q"], np.zeros((1, 7)))


def test_the_end_of_a_row_is_there_when_it_is_needed(robot: Robot) -> None:
    layout = RowLayout(robot)
    state = State(0.0, 0.004, np.zeros(7), np.zeros(7), np.zeros(7))
    tick = Tick(0, 1, 9, 0, 5, 0)
    short = layout.pack(state, None, tick)
    command = Command(q_ext=np.array([0.5, -0.5]))
    sent = tick._replace(q_ext_sent=np.array([0.4]), rapid_data_sent=np.array([1.0, 2.0]), rapid_digital_sent=False)
    long = layout.pack(replace(state, rapid_data=np.array([7.0])), command, sent)
    assert len(long) == layout.size == len(short) + 8 * (6 + 6 + 40 + 40 + 2)
    found = layout.unpack([short, long])
    for name in SELDOM:  # RAPID data that were never sent are missing, not False
        assert np.isnan(found[name][0]).all(), name
    assert found["q_ext_ref"][1, :3].tolist()[:2] == [0.5, -0.5]
    assert found["q_ext_sent"][1, 0] == 0.4
    assert (found["rapid_data"][1, 0], found["rapid_digital"][1], found["rapid_digital_sent"][1]) == (7.0, 0.0, 0.0)
    assert found["rapid_data_sent"][1, :2].tolist() == [1.0, 2.0]
    alone = layout.unpack([short])
    assert np.isnan(alone["rapid_data"]).all()
    assert set(alone) == set(found)


TYPES = ("Tick", "Column", "WrenchEstimate", "Parameter")


def written(topic: Topic, layout: RowLayout, row: bytes, stamp_ns: int) -> bytes | None:
    """Return the message, if any, that is written to a topic for a row with another stamp."""
    planned: Plan = plan(3, topic, layout.slots)
    records, *_ = RowEncoder([planned]).encode([stamp_ns.to_bytes(8, "little") + row[8:]])
    return next((message for *_, message in messages_in(records)), None)


@pytest.fixture(scope="module")
def store():
    """A reader that knows only the message definitions in the file."""
    store = get_typestore(Stores.EMPTY)
    types: dict = {}
    for name in (*(f"armlab_msgs/msg/{own}" for own in TYPES), "rcl_interfaces/msg/Log", "sensor_msgs/msg/JointState"):
        types |= get_types_from_msg(definition(name), name)
    store.register(types)
    return store


def test_numbers_are_where_sentinels_say(robot: Robot, store) -> None:
    layout = RowLayout(robot)
    values = {}
    for number, (name, slot) in enumerate(layout.slots.items()):
        if slot.dtype == "<f8":
            values[name] = (1000.0 * number + np.arange(slot.size)).reshape(slot.column.shape)
        else:
            values[name] = np.full(slot.column.shape, number + 1)
    row = layout.pack_values(values)
    for topic in topics(layout, robot.joint_names):
        if topic.name in ("tcp_pose", "wrench"):
            continue  # standard types, tested with rosbags' own store in test_recorder
        message = written(topic, layout, row, 3_000_000_007)
        assert message is not None
        decoded = store.deserialize_cdr(bytes(message), topic.type)
        assert (decoded.header.stamp.sec, decoded.header.stamp.nanosec) == (3, 7)
        for name, (field,) in topic.fields.items():
            assert np.array_equal(np.ravel(getattr(decoded, field)), np.ravel(values[name])), name
    held = [name for topic in topics(layout, robot.joint_names) for name in topic.fields]
    assert sorted(held) == sorted(set(layout.slots) - {"stamp_ns"})


def test_each_force_sensor_has_a_topic_of_its_own(robot: Robot) -> None:
    shapes = {"left hand.wrench_raw": (6,), "force.wrench_raw": (6,), "force.age": (), "odd.wrench_raw": (3,)}
    layout = RowLayout(robot, {name: Column(shape, unit="1") for name, shape in shapes.items()})
    row = layout.pack_values({"force.wrench_raw": np.arange(6.0), "wrench_raw": np.ones(6)})
    by_name = {topic.name: topic for topic in topics(layout, robot.joint_names)}
    sensors = [name for name, topic in by_name.items() if topic.type == "geometry_msgs/msg/WrenchStamped"]
    assert sensors == ["wrench", "wrench/left_hand", "wrench/force"]
    assert {"columns/force_age", "columns/odd_wrench_raw"} <= by_name.keys()
    message = written(by_name["wrench/force"], layout, row, 5)
    assert message is not None
    decoded = messages.store().deserialize_cdr(message, "geometry_msgs/msg/WrenchStamped")
    assert decoded.header.frame_id == "force"
    assert (decoded.wrench.force.y, decoded.wrench.torque.z) == (1.0, 5.0)
    assert written(by_name["wrench/left_hand"], layout, row, 5) is None
    about = by_name["columns/force_age"].metadata(layout.slots)
    assert json.loads(about["column.force.age"]) == {
        "fields": ["values"], "shape": [], "unit": "1", "frame": "", "kind": "real", "labels": [],
    }  # fmt: skip
    assert by_name["tick"].metadata(layout.slots)["armlab.clock"] == "rows"


def test_columns_whose_topics_would_have_one_name_have_topics_of_their_own(robot: Robot) -> None:
    names = ["a.b", "a_b", "a_b_2", "é", "è", "q planned", "a-b.wrench_raw", "a.b.wrench_raw"]
    found = topics(RowLayout(robot, {name: Column((6,), unit="1") for name in names}), robot.joint_names)
    by_column = {column: topic.name for topic in found for column in topic.fields}
    assert len({topic.name for topic in found}) == len(found)
    assert [by_column[name] for name in ("a.b", "a_b", "a_b_2")] == ["columns/a_b", "columns/a_b_2", "columns/a_b_2_2"]
    assert [by_column[name] for name in ("q_planned", "q planned")] == ["columns/q_planned", "columns/q_planned_2"]
    assert by_column["a.b.wrench_raw"] == "wrench/a_b_2"


def test_absent_sequences_are_empty_and_absent_messages_none(robot: Robot, store) -> None:
    layout = RowLayout(robot)
    x = np.ones(7)
    row = layout.pack(State(0.0, 0.004, x, x, np.full(7, np.nan)), None, Tick(1, -1, 5, 0, -1, 0))
    made = {topic.name: (topic.type, written(topic, layout, row, 5)) for topic in topics(layout, robot.joint_names)}
    there = {name: store.deserialize_cdr(raw, kind) for name, (kind, raw) in made.items() if raw is not None}
    assert set(there) == {"tick", "joint_states"}
    assert (there["joint_states"].position.tolist(), there["joint_states"].effort.size) == (x.tolist(), 0)
    assert there["tick"].clamped.size == 0


STAMPS = 10**18 + np.arange(6) * 4_000_000


@pytest.mark.parametrize("step", [4_032_000, -3_600_000_000_000, 3_600_000_000_000, -1_000_000])
def test_a_robot_clock_that_was_set_is_not_trusted(step: int) -> None:
    robot_ns = 5 * 10**18 + np.arange(6) * 4_032_000
    robot_ns[3:] += step - 4_032_000
    expected = np.arange(6) * 0.004032
    t, clock = recording_clock({"robot_ns": robot_ns, "session_t": expected}, STAMPS)
    assert (clock, t) == ("robot", pytest.approx(expected, abs=1e-15))
    t, clock = recording_clock({}, STAMPS)
    assert (clock, t) == ("bridge", pytest.approx(np.arange(6) * 0.004))
    assert len(recording_clock({}, STAMPS[:0])[0]) == 0


def test_sessions_are_placed_by_the_stamps() -> None:
    session_t = np.array([1.0, 1.004, 1.008, 0.0, 0.004, 0.008])
    stamps = STAMPS + np.repeat([0, 2_000_000_000], 3)
    t, clock = recording_clock({"session_t": session_t, "session": np.repeat([1, 2], 3)}, stamps)
    assert (clock, t) == ("robot", pytest.approx([0.0, 0.004, 0.008, 2.012, 2.016, 2.020]))


def test_pushed_values_become_columns_and_nothing_else(robot: Robot) -> None:
    log = Log(robot, extra={"fext": Column(shape=(6,), unit="N", frame="base")})
    for i in range(20):
        before = log.table()
        log.push(t=0.5 + i * 0.004, q=np.full(7, i), fext=np.arange(6) if i % 2 else np.full(6, np.nan))
    table = log.table()
    assert (len(log), len(table), len(before)) == (20, 20, 19)  # a table stays valid while more rows are pushed
    assert set(table.names) == {"q", "fext", "tick", "session"}
    assert table.t == pytest.approx(0.5 + np.arange(20) * 0.004)
    assert np.array_equal(table["q"][:, 3], np.arange(20))
    assert table.missing() == {"fext": (10, tuple(range(0, 20, 2)))}
    assert table.columns["fext"].frame == "base"
    clockless = Log(robot)
    for _ in range(5):
        clockless.push(q=np.zeros(7))
    assert (clockless.table().clock, clockless.table().t[0]) == ("bridge", 0.0)
    assert np.all(np.diff(clockless.table().t) > 0)


def test_wrong_values_are_refused_before_anything_is_stored(robot: Robot, extra: dict[str, Column]) -> None:
    log = Log(robot, extra=extra)
    with pytest.raises(UnknownName, match=r"'force'.*fext"):
        log.push(q=np.zeros(7), force=1.0)
    with pytest.raises(ShapeError, match="fext"):
        log.push(q=np.zeros(7), fext=np.zeros(5))
    assert len(log) == len(log.table()) == 0


def test_saved_rows_are_a_finished_recording_of_the_same(
    tmp_path: Path, robot: Robot, rows: Callable, extra: dict[str, Column]
) -> None:
    log = Log(robot, extra)
    for i in range(300):
        log.row(*rows(i))
    paths = [log.save(tmp_path / "logs" / "run.mcap", note="by hand") for _ in range(2)]
    assert [path.name for path in paths] == ["run.mcap", "run-2.mcap"]
    held, memory, file = inspect(paths[1]), log.table(), read(paths[1])
    assert (held.finished, held.metadata["armlab"]["note"]) == (True, "by hand")
    assert file.without("T_frame_tool").sha256 == memory.without("T_frame_tool").sha256
    assert memory["T_frame_tool"] == pytest.approx(file["T_frame_tool"], abs=1e-14)  # through a quaternion in the file
    assert (file.clock, file.t0_ns) == (memory.clock, memory.t0_ns)


def test_a_full_disk_leaves_no_half_log(tmp_path: Path, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Log(robot)
    log.push(t=0.0, q=np.zeros(7))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RecordingFile, "finish", full)
    with pytest.raises(LogError, match=r"run\.mcap, got: No space left on device\."):
        log.save(tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def test_a_tail_keeps_the_last_seconds(robot: Robot, rows: Callable, extra: dict[str, Column]) -> None:
    tail = Tail(0.5, robot, extra)
    for i in range(400):
        tail.row(*rows(i))
    table = tail.table()
    assert table.t[-1] - table.t[0] <= tail.seconds == 0.5
    assert (len(table), table["seq"][-1]) == (125, 399 + 7)
    assert len(Tail(1.0, robot).table()) == 0
