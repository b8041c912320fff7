"""`read` and `read_arm`, and how file formats are detected."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from armlab import identify, log, robots
from armlab.errors import ConfigError, LogError, ModelMismatchError, UnknownName
from armlab.log import Column, Recorder, Table, Tick, inspect, read, read_topics, recover, write
from armlab.log.file_formats.opening import check_readable, check_unpacked_size, format_of, naming, origin
from armlab.log.mcap.records import MAGIC
from armlab.log.recording import ros_messages as messages
from armlab.log.topics.reader import is_foreign, names_robots
from armlab.robots import Robot
from armlab.state import Command, State


def test_every_column_and_state_comes_back_bit_for_bit(recording: Callable[..., Path], rows: Callable) -> None:
    count = 300  # more than a chunk
    table = read(recording(count))
    samples = [rows(i) for i in range(count)]
    states, commands, ticks = zip(*samples, strict=True)
    of_state = ["q", "qd", "tau", "seq", "missed", "q_planned", "wrench_raw", "motors", "mci", "rapid", "dt"]
    of_state += ["utilization", "converged"]
    of_tick = ["q_sent", "qd_sent", "clamped", "seq_sent", "send_ns", "receive_ns", "step_ns", "wake_ns", "late"]
    expected = {name: [getattr(state, name) for state in states] for name in of_state}
    expected |= {name: [getattr(tick, name) for tick in ticks] for name in [*of_tick, "drops"]}
    expected |= {f"{name}_ref": [getattr(command, name) for command in commands] for name in ("q", "qd")}
    expected |= {name: [command.record[name] for command in commands] for name in commands[0].record}
    for name, values in expected.items():
        assert np.array_equal(table[name], values), name
    poses = np.array([state.T_frame_tool for state, _, _ in samples])
    assert table["T_frame_tool"] == pytest.approx(poses, abs=1e-14)
    assert (table.clock, table.t0_ns, table.notes) == ("robot", samples[0][2].stamp_ns, ())
    assert np.array_equal(table.t, np.arange(count) * 4_032_000 / 1e9)
    columns = table.columns
    assert (columns["mode"].kind, columns["fext"].frame, table["late"].dtype) == ("count", "base", bool)
    assert columns["q"].labels == ("axis_1", "axis_2", "axis_7", "axis_3", "axis_4", "axis_5", "axis_6")
    assert table.source[0].startswith("run.mcap sha256 ")
    for i, (live, state) in enumerate(zip(states[:20], table.states())):
        for name in ("t", "dt", "seq", "missed", "session", "motors", "mci", "rapid", "converged", "utilization"):
            assert getattr(state, name) == getattr(live, name), name
        assert (state.qd_source, state.tau_source, state.robot_ns) == ("measured", "measured", live.robot_ns)
        assert np.array_equal(state.tau, live.tau)
        assert np.all(np.isnan(state.wrench))
        if i:
            assert np.array_equal(state.q_sent, ticks[i - 1].q_sent)
            assert np.array_equal(state.clamped, ticks[i - 1].clamped)


def test_absent_data_have_no_column(tmp_path: Path, robot: Robot) -> None:
    with Recorder(tmp_path / "bare.mcap", robot) as recorder:
        for i in range(30):
            state = State(i * 0.004, 0.004, q=np.ones(7), qd=np.zeros(7), tau=np.full(7, np.nan), robot_ns=0)
            recorder.row(state, None, Tick(i, -1, 10**18 + i * 4_000_000, 0, -1, 0))
    table = read(recorder.path)
    assert table.names[:2] == ("q", "qd")
    for name in ("tau", "q_ref", "q_sent", "seq_sent", "send_ns", "robot_ns", "wrench_hat", "T_frame_tool", "clamped"):
        assert name not in table
    assert np.all(table["qd"] == 0.0)
    assert np.allclose(table.t, np.arange(30) * 0.004)


def test_some_columns_or_one_robot_only(
    recording: Callable[..., Path], tmp_path: Path, robot: Robot, rows: Callable
) -> None:
    path = recording(100)
    whole = read(path)
    part = read(path, ["tau", "fext"])
    assert part.sha256 == whole.select("tau", "fext").sha256
    assert part.names == ("tau", "fext")
    with pytest.raises(UnknownName, match=r"'torque'\. Known: .*fext"):
        read(path, ["torque"])
    with pytest.raises(LogError, match=r"Expected values of wrench in .*got no values in 100 rows"):
        read(path, ["q", "wrench"])
    with pytest.raises(UnknownName, match="yumi_right"):
        read(path, robot="yumi_left")
    told: list[tuple[float, float, str]] = []
    assert read(path, robot="yumi_right", progress=lambda *one: told.append(one)).sha256 == whole.sha256
    assert told == sorted(told)
    assert told[-1][0] == told[-1][1] > 0
    assert {what for *_, what in told} == {"bytes"}
    assert names_robots(path)
    bag = write(whole, tmp_path / "run.rosbag2")  # exported bags name no robot
    assert not names_robots(bag)
    with pytest.raises(ConfigError, match="which does not name a robot"):
        read(bag, robot="yumi_right")
    for one in (path, write(read(path, ["q"]), tmp_path / "run.csv")):
        with pytest.raises(ConfigError, match=r"for clock='/joint_states', got .*run.* Omit clock="):
            read(one, clock="/joint_states")
    own = replace(robot, name="arm-1 left")  # invalid in a topic name
    with Recorder(tmp_path / "own.mcap", own) as recorder:
        recorder.row(*rows(0))
    for name in (own, "arm-1 left", "arm_1_left"):
        assert len(read(recorder.path, robot=name)) == 1


def test_rows_out_of_time_order_are_dropped_counted_and_reachable(tmp_path: Path, robot: Robot) -> None:
    times = [0, 1, 2, 2, 1, 3, 4]
    with Recorder(tmp_path / "back.mcap", robot) as recorder:
        for i, time in enumerate(times):
            state = State(time * 0.004, 0.004, np.full(7, float(i)), np.zeros(7), np.zeros(7))
            recorder.row(state, None, Tick(i, i, 10**18 + time * 4_000_000, 1, 1, 0))
    with pytest.warns(UserWarning, match=r"2 rows dropped.*\(row 3, row 4\)"):
        table = read(recorder.path)
    assert np.array_equal(table["q"][:, 0], [0, 1, 2, 5, 6])
    assert "2 rows dropped" in table.notes[0]
    raw = read(recorder.path, raw=True)
    assert np.array_equal(raw["q"][:, 0], np.arange(7))
    assert np.all(np.diff(raw.t) > 0)


DISORDER = {"t": [0.0, 1.0, 1.0, 0.5, 2.0], "x": [1.0, 2.0, 3.0, 4.0, 5.0]}


def in_disorder(path: Path) -> Path:
    if path.suffix == ".mat":
        savemat(path, DISORDER)
    elif path.suffix == ".h5":
        h5py = pytest.importorskip("h5py", reason="HDF5 needs the extra data")
        with h5py.File(path, "w") as file:
            for name, values in DISORDER.items():
                file[name] = values
    elif path.suffix == ".parquet":
        pa = pytest.importorskip("pyarrow", reason="Parquet needs the extra data")
        pytest.importorskip("pyarrow.parquet").write_table(pa.table(DISORDER), path)
    else:
        lines = ["t,x", *(f"{t:g},{x:g}" for t, x in zip(*DISORDER.values(), strict=True)), ""]
        path.write_bytes((gzip.compress if path.suffix == ".gz" else bytes)("\n".join(lines).encode()))
    return path


@pytest.mark.parametrize("name", ["run.csv", "run.csv.gz", "run.mat", "run.h5", "run.parquet"])
def test_every_format_drops_rows_out_of_time_order_and_names_no_robot(tmp_path: Path, name: str) -> None:
    path = in_disorder(tmp_path / name)
    first = "line 4, line 5" if ".csv" in name else "row 2, row 3"
    with pytest.warns(UserWarning, match=rf"2 rows dropped: their time does not increase \({first}\); raw=True keeps"):
        table = read(path)
    assert table["x"].tolist() == [1.0, 2.0, 5.0]
    assert any(f"2 rows dropped: their time does not increase ({first})" in note for note in table.notes)
    whole = read(path, ["x"], raw=True)
    assert whole["x"].tolist() == DISORDER["x"]
    assert (np.diff(whole.t) > 0).all()
    with pytest.raises(ConfigError, match=r"robot='ur5e', got .* which does not name a robot\. Omit robot="):
        read(path, robot="ur5e")
    assert not names_robots(path)


def test_every_error_of_reading_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(MAGIC + bytes([7]) + bytes(40))
    for look in (read, inspect, recover, is_foreign, read_topics):
        with pytest.raises(LogError) as caught:
            look(path)
        assert f"Expected a valid log in {path}, got an error: Expected the header of an MC" in str(caught.value)
    added = r"^Expected a valid log in a\.mcap, got an error: Expected no end\.$"
    for text, words in (("Expected no end.", added), ("Expected no end in a.mcap.", r"^Expected no end in a\.mcap\.$")):
        with pytest.raises(LogError, match=words), naming(Path("a.mcap")):
            raise LogError(text)


def test_a_damaged_chunk_costs_its_rows_only(recording: Callable[..., Path], tmp_path: Path) -> None:
    whole = recording(600)
    data = bytearray(whole.read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    with pytest.warns(UserWarning, match="chunk at byte .* skipped"):
        table = read(damaged)
    assert 350 <= len(table) < 600  # a chunk has 250 rows, fewer where the writer was slow
    kept = np.isin(read(whole)["seq"], table["seq"])
    assert np.array_equal(table["q"], read(whole)["q"][kept])


def test_foreign_damaged_and_missing_files_are_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "strange"
    for data, message in (
        (b"", "empty file"),
        (b"\x89HDF\r\n\x1a\n" + b"\0" * 90, "a valid HDF5 file"),
        (b"PAR1" + b"\0" * 90, "a valid Parquet file"),
        (b"SQLite format 3\0" + b"\0" * 90, "the folder of a rosbag2"),
        (b"#ROSBAG V2.0\n", "a valid bag"),
        (b"hello world\n1\n", "a column t"),
        (b"\x00\x01\x02", "format unknown .*00 01 02"),
        (b"\x89MCAP0\r\n", "without columns; topics: none"),
        (b"\x89MCAP0\r\n" + b"\x01" + (2**60).to_bytes(8, "little"), "without columns"),
    ):
        path.write_bytes(data)
        with pytest.raises(LogError, match=rf"(?s)(?=.*strange).*{message}.*\.$"):
            read(path)
    for missing in (tmp_path / "none.mcap", tmp_path):
        with pytest.raises(LogError, match="Expected a log at"):
            read(missing)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LogError, match="got a pipe"):  # without waiting for it
        check_readable(tmp_path / "pipe")


def test_one_value_that_does_not_fit_does_not_cost_the_recording(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    with Recorder(tmp_path / "run.mcap", robot, extra={"mode": Column(unit="1", kind="count")}) as recorder:
        for i in range(5):
            state, _, tick = rows(i)
            assert state.T_frame_tool is not None
            T = 2.0 * state.T_frame_tool if i == 3 else state.T_frame_tool  # no rotation
            mode = 0.5 if i == 2 else 1.0
            assert recorder.row(replace(state, T_frame_tool=T), Command(state.q, record={"mode": mode}), tick)
    with pytest.warns(UserWarning, match="1 rows of T_frame_tool are missing"):
        table = read(recorder.path)
    assert table["mode"].tolist() == [1.0, 1.0, 0.5, 1.0, 1.0]
    assert "mode: stored as real because values do not match the kind count" in table.notes
    assert table.missing()["T_frame_tool"] == (1, (3,))


def test_descriptions_that_contradict_the_glossary_are_refused(
    recording: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, whole = recording(3), messages.Topic.metadata
    assert len(read(path, ["q"])) == 3

    def other_unit(topic: messages.Topic, slots: Any) -> dict[str, str]:
        return {key: text.replace('"unit": "rad"', '"unit": "deg"') for key, text in whole(topic, slots).items()}

    monkeypatch.setattr(messages.Topic, "metadata", other_unit)
    with pytest.raises(LogError, match="Expected valid columns"):
        read(recording(3, name="degrees.mcap"))


def test_columns_are_those_of_the_arm_in_its_order(truth, tmp_path: Path, ur5e_bag: Path) -> None:
    np.testing.assert_array_equal(log.read_arm(ur5e_bag, robots.load("ur5e"))["q"][0], np.arange(6.0))
    table = truth.log(identify.dither(truth.robot.q_home, 1.0), seed=5)
    told: list[tuple[int, int, str]] = []
    for name in ("one.mcap", "one.csv"):
        path = log.write(table, tmp_path / name, truth.robot)
        found = log.read_arm(str(path), truth.robot, lambda *step: told.append(step))
        np.testing.assert_array_equal(found["tau"], table["tau"])
        assert found["q"].shape == (len(table), 7)
    assert told


def test_logs_that_are_not_of_the_arm_are_refused(truth, tmp_path: Path) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 1.0), seed=5)
    path = log.write(table, tmp_path / "left.mcap", truth.robot)
    with pytest.raises(ModelMismatchError, match=r"left\.mcap, 'yumi_left' .*, got 'yumi_right' .*mount moved by"):
        log.read_arm(path, robots.load("yumi_right"))
    bare = log.write(table, tmp_path / "left.csv")
    with pytest.raises(ModelMismatchError, match="of 'ur5e' with 6 joints"):
        log.read_arm(bare, robots.load("ur5e"))
    for names, missing in (("q", "tau"), ("qd", "q and tau"), ("qd tau", "q")):
        advice = "research extension" if missing == "tau" else "log of the joints"
        mute = log.write(table.select(*names.split()), tmp_path / "mute.csv")
        with pytest.raises(LogError, match=f"got no {missing} among the columns .*{advice}"):
            log.read_arm(mute, truth.robot)
    with pytest.raises(LogError, match=r"no\.mcap"):
        log.read_arm(tmp_path / "no.mcap", truth.robot)


FIRST = {
    b"\x89MCAP0\r\nrest": "MCAP",
    b"SQLite format 3\0": "SQLite (rosbag2)",
    b"#ROSBAG V2.0\n": "ROS 1 bag",
    b"PAR1....": "Parquet",
    b"MATLAB 5.0 MAT-file": "MAT v5",
    b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n": "MAT v7.3",
    b"\x89HDF\r\n\x1a\n": "HDF5",
    b"Julia data file (HDF5), version 0.1.1".ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n": "HDF5",
    b"t [s],mode\n0,\x01\n": "text",
    b"\x1f\x8b\x08": "gzip",
    "t [s],q1 [grå]\n".encode(): "text",
    b"\x00\x00\x00\x02\x00\x00\x00\x40": "LabComm",
    b"\x0bLabComm2013\x02": "LabComm",
    b"\x01\x10\x0eLabComm2014.v1": "LabComm",
    b"\x01LabComm": "unknown",
    b"\x00\x01": "unknown",
    b"": "empty",
}


def test_formats() -> None:
    assert {first: format_of(first) for first in FIRST} == FIRST


def test_the_hash_of_a_table_never_changes_and_depends_on_neither_nan_bits_nor_padding() -> None:
    """Model files refer to the hash: a new value here breaks every model file's link to its log."""
    table = Table([0.0, 0.5], {"q": [[1.0], [np.nan]], "seq": [1, 2]}, {})
    assert table.sha256 == "164643750a016c3d86447c5228ca174c0140b35bf7485e8e5c888912c09129b0"
    odd = np.array([0x7FF8000000000001, 0], dtype=np.uint64).view(float)
    about = {"x": Column(unit="1"), "w": Column(unit="1", kind="text")}
    a = Table([0.0, 1.0], {"x": odd, "w": np.array(["a", "b"], dtype="U9")}, about)
    b = Table([0.0, 1.0], {"x": [np.nan, 0.0], "w": np.array(["a", "b"])}, about)
    assert a.sha256 == b.sha256
    assert a.sha256 != b.with_column("w", np.array(["a", "c"]), unit="1", kind="text").sha256


def test_the_hash_of_a_folder_counts_names_and_contents(tmp_path: Path) -> None:
    found = set()
    for name, text in (("a", "x"), ("a", "y"), ("b", "y")):
        (tmp_path / name).write_text(text)
        found.add(origin(tmp_path))
        (tmp_path / name).unlink()
    assert len(found) == 3
    assert all(one.startswith(f"{tmp_path.name} sha256 ") for one in found)


def test_a_thousand_times_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(bytes(100_000))
    check_unpacked_size(path, 100_000_000)
    with pytest.raises(LogError, match=r"at most 100000000 bytes in .*a\.h5, 1000 times its size, got 100000001"):
        check_unpacked_size(path, 100_000_001)
    path.write_bytes(b"")
    check_unpacked_size(path, 1 << 26)
