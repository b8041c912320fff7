"""`write`, and round trips through every format."""

from __future__ import annotations

import csv
import resource
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from armlab import log, robots
from armlab.errors import ConfigError, LogError, RobotError, ShapeError, UnknownName
from armlab.glossary import columns as known
from armlab.lie import se3
from armlab.log import Column, Table
from armlab.log.file_formats.opening import file_hash
from armlab.log.file_formats.rosbag2 import STORAGES, is_ours, read_rosbag2, topics_of, whole_poses
from armlab.log.writing import ENDINGS, write

N = 100


@pytest.fixture
def table() -> Table:
    rng = np.random.default_rng(1)
    q, hat = rng.normal(size=(N, 7)), rng.normal(size=(N, 6))
    hat[10:20] = np.nan
    q[3, 2] = np.nan
    values = {"q": q, "wrench_hat": hat, "wrench_hat_cov": rng.normal(size=(N, 6, 6)), "flags": np.arange(N) % 5}
    columns = {"flags": Column(unit="1", kind="count"), "q": Column(labels=tuple("abcdefg"))}
    return Table(np.cumsum(rng.uniform(0.003, 0.005, N)), values, columns, t0_ns=1_700_000_000_000_000_000)


def test_mcap_reads_back_equal(table: Table, tmp_path) -> None:
    robot = robots.load("yumi_left")
    none = write(table.between(-2.0, -1.0), tmp_path / "est.mcap", robot)
    assert len(log.read(none)) == 0
    path = write(table, none, robot)
    read = log.read(path)
    assert np.array_equal(read.t, table.t)
    for name in table.names:
        assert np.array_equal(read[name], table[name], equal_nan=True), name
        assert read.units[name] == table.units[name]
        assert read.columns[name].kind == table.columns[name].kind
    assert read.columns["q"].labels == robot.joint_names
    assert (read.t0_ns, read.clock) == (table.t0_ns, table.clock)
    assert [entry.name for entry in tmp_path.iterdir()] == ["est.mcap"]


def test_csv_has_units_in_its_header_and_digits_that_read_back_equal(table: Table, tmp_path) -> None:
    path = write(table, tmp_path / "est.csv")
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert header[:3] == ["t [s]", "q1 [rad]", "q2 [rad]"]
    assert {"wrench_hat3 [N]", "wrench_hat4 [N m]", "flags"} <= set(header)
    units = ["wrench_hat_cov1_1 [N^2]", "wrench_hat_cov1_4 [N^2 m]", "wrench_hat_cov6_5 [N^2 m^2]"]
    assert set(units) <= set(header)
    assert len(rows) == N
    assert [rows[3][header.index(name)] for name in ("q3 [rad]", "flags")] == ["", "3"]


def test_what_cannot_be_written_is_refused_and_leaves_nothing(table: Table, tmp_path) -> None:
    yumi, six = robots.load("yumi_left"), Table([0.0, 1.0], {"q": np.zeros((2, 6)), "tau": np.zeros((2, 6))})
    about = {"id": Column(unit="1", kind="count")}
    large = Table([0.0, 1.0], {"q": np.zeros((2, 7)), "id": np.array([1, 2**53 + 1])}, about)
    words = {"m": Column(unit="1", kind="text")}
    odd = [Table([0.0, 1.0], {"m": np.array(["a", word])}, words) for word in ("a\0b", "\ud800")]
    text = r"without NUL or lone surrogates in the column 'm', got .* in row 1"
    late, far = Table(table.t, {"q": table["q"]}, t0_ns=2**62), Table([0.0, 1e300], {"q": np.zeros((2, 1))})
    for what, name, robot, error, words in (
        (table, "est.xlsx", None, ConfigError, r"ends in \.mcap, \.csv, .*\.hdf5, \.rosbag2, got"),
        (table, "none/est.csv", None, LogError, "create"),
        (table, "est.mcap", None, ConfigError, "Pass robot="),
        (six, "six.mcap", yumi, ShapeError, r"q of shape \(2, 7\) for robot 'yumi_left' with 7 .* got \(2, 6\)"),
        (six, "six.mcap", "irb120", RobotError, "Load the robot first"),
        ("six.csv", "six.mcap", yumi, ShapeError, "Expected a Table"),
        (large, "run.mcap", yumi, LogError, r"counts up to 2\^53 in 'id' for MCAP"),
        *((one, "run.h5", None, LogError, text) for one in odd),
        (late, "run.rosbag2", None, LogError, "before the year 2038"),
        (far, "run.rosbag2", None, LogError, r"times of at most 2\.15e\+09 s"),
    ):
        with pytest.raises(error, match=words):
            write(what, tmp_path / name, robot)  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="storage"):
        write(table, tmp_path / "run.rosbag2", storage="postgres")
    assert not list(tmp_path.iterdir())
    (tmp_path / "run.rosbag2").mkdir()
    (tmp_path / "run.rosbag2" / "thesis.tex").write_text("years of work")
    with pytest.raises(LogError, match="an existing rosbag2 to replace"):
        write(table, tmp_path / "run.rosbag2")
    assert [entry.name for entry in tmp_path.rglob("*")] == ["run.rosbag2", "thesis.tex"]


def test_csv_alone_keeps_whole_nanoseconds(tmp_path) -> None:
    rng, stamps = np.random.default_rng(0), 1_700_000_000_000_000_001 + 4_000_001 * np.arange(40)
    real = np.array([np.inf, -0.0, 5e-324, np.nan, *rng.normal(size=36)])
    values = {"q": rng.normal(size=(40, 7)), "robot_ns": np.where(np.arange(40) == 3, 0, stamps), "real": real}
    table = Table(5.0 + 0.004 * np.arange(40), values | {"seq": np.arange(40)}, {"real": Column(unit="m/s^2")})
    path = write(table, tmp_path / "run.csv")
    (tmp_path / "run.csv.toml").unlink()
    again = log.read(path)
    for name in table.names:
        np.testing.assert_array_equal(again[name], table[name])
        assert again[name].dtype == table[name].dtype
    np.testing.assert_array_equal(np.signbit(again["real"]), np.signbit(real))
    np.testing.assert_allclose(again.t, table.t - table.t[0], atol=1e-12)
    other = tmp_path / "other.csv"
    other.write_text("t [ns],id\n1700000000000000001,9007199254740993\n1700000000000000003,9007199254740995\n")
    found = log.read(other)
    np.testing.assert_array_equal(found.t, [0.0, 2e-9])
    assert found["id"].tolist() == [9007199254740993, 9007199254740995]


def test_poses_that_a_quaternion_can_hold_come_back(tmp_path) -> None:
    whole = np.tile(np.eye(4), (3, 1, 1))
    holes, scaled, partly = whole.copy(), whole * [1.0, 1.0, 1.0 + 1e-9, 1.0], whole.copy()
    holes[1], partly[2, 0, 0] = np.nan, np.nan
    values = {"whole": whole, "holes": holes, "scaled": scaled, "partly": partly}
    table = Table(np.arange(3.0), values, dict.fromkeys(values, Column(unit="1, m", kind="pose")))
    assert whole_poses(table) == ["whole", "holes"]
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = np.arange(9.0).reshape(3, 3)
    T[1] = np.nan
    values, pose = {"q": np.zeros((3, 6)), "T_cam_marker": T}, Column(unit="1", kind="pose")
    table = Table(np.arange(3.0), values, {"T_cam_marker": pose})
    found = log.read(write(table, tmp_path / "run.mcap", robots.load("irb2400")))
    np.testing.assert_array_equal(found["T_cam_marker"], T)


@pytest.fixture
def full_disk() -> Iterator[None]:
    """No file grows beyond 20 kB, as on a disk without room."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limit[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limit)


@pytest.mark.parametrize(("ending", "storage"), [*((ending, "mcap") for ending in ENDINGS), (".rosbag2", "sqlite3")])
def test_a_full_disk_is_one_sentence_and_leaves_nothing(table: Table, tmp_path, full_disk, ending, storage) -> None:
    path = tmp_path / f"run{ending}"
    with pytest.raises(LogError, match=rf"^Expected to create the file .*run\{ending}, got: .*\.$"):  # in one line
        write(table, path, robots.load("yumi_left") if ending == ".mcap" else None, storage=storage)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [ending for ending in ENDINGS if ending != ".mcap"])
def test_what_is_there_is_replaced_as_a_whole_or_kept(table: Table, tmp_path, monkeypatch, ending) -> None:
    path = tmp_path / f"run{ending}"
    told: list[tuple[float, float, str]] = []
    none = table.between(-2.0, -1.0)
    assert len(none) == len(log.read(write(none, path))) == 0
    write(table, path, progress=lambda *one: told.append(one))
    shares = [done / total for done, total, _ in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert log.read(path).names == table.names
    before = sorted(entry.name for entry in tmp_path.iterdir())

    def fails(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("armlab.log.writing.write_rosbag2", fails)
    monkeypatch.setattr("armlab.log.writing._FILES", {ending: fails})
    with pytest.raises(LogError, match="No space left on device"):
        write(table.select("q"), path)
    assert log.read(path).names == table.names
    assert sorted(entry.name for entry in tmp_path.iterdir()) == before


def test_the_chain_of_sources_goes_through_all_formats(table: Table, tmp_path) -> None:
    found = table
    for ending in (".csv", ".mat", ".parquet", ".h5", ".rosbag2"):
        found = log.read(write(found, tmp_path / f"run{ending}"))
    assert found.sha256 == table.sha256
    back = log.read(write(found, tmp_path / "run.mcap", robots.load("yumi_left")))
    names = ["run.mcap", "run.rosbag2", "run.h5", "run.parquet", "run.mat", "run.csv"]
    assert [entry.split()[0] for entry in back.source] == names
    assert back.source[1:] == found.source
    assert found.source[-1] == f"run.csv sha256 {file_hash(tmp_path / 'run.csv')}"


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_interrupt_leaves_nothing(tmp_path, ending) -> None:
    def interrupt(*_args: object) -> None:
        raise KeyboardInterrupt

    long = Table(np.arange(1500.0), {"q": np.zeros((1500, 7))})
    with pytest.raises(KeyboardInterrupt):
        write(long, tmp_path / f"run{ending}", robots.load("yumi_left"), progress=interrupt)
    assert not list(tmp_path.iterdir())


WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
NASTY = ["", "1", "nan", " a,b ", '"', 'a "b", c', "line\nbreak", "\r", "\r\n", "ü😀", "\x01", "a'b", "\ufeff"]
TEXTS = st.sampled_from(NASTY) | WORDS
MEETING = ["a.b", "a:b", "a_b", "A_b", "a/b", "x" * 70, "x" * 69 + "y", "q1", "q[1]", "/t", "joint_states", "_"]
TAKEN = ["units", "names", "armlab", "end", "2nd", ".", "..", "T", "time", "columns"]
ODD = ["x y", "x, y", "l\nb", "\r", "it's", "grå", "a [b]", "robot[0].joint[2].posRawAbs"]
NAMES = st.sampled_from(MEETING + TAKEN + ODD) | WORDS.filter(lambda name: name not in {*known(), "", "t"})
UNITS = st.sampled_from(["1", "N", "N, N m", "rad", "furlong", "ü/s", "N m, J", "%"])
KINDS = ("real", "angle", "pose", "quaternion", "count", "flag", "text")
FRAMES = st.sampled_from(["", "base", "ü"])
REALS = st.floats(allow_nan=True, allow_infinity=True)


@st.composite
def values(draw: st.DrawFn, kind: str, rows: int) -> np.ndarray:
    shape = (rows, *draw(st.just(()) | array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=3)))
    if kind == "text":
        words = draw(st.lists(TEXTS, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
        return np.array(words, dtype=np.str_).reshape(shape)
    if kind == "count":
        return draw(arrays(np.int64, shape, elements=st.integers(-(2**63), 2**63 - 1)))
    if kind == "flag":
        return draw(arrays(np.bool_, shape))
    if kind == "pose" and draw(st.booleans()):
        poses = se3.exp(draw(arrays(float, (rows, 6), elements=st.floats(-3.0, 3.0))))
        return np.where(draw(arrays(np.bool_, (rows, 1, 1))), np.nan, poses)
    return draw(arrays(float, shape, elements=REALS))


@st.composite
def tables(draw: st.DrawFn) -> Table:
    rows = draw(st.integers(0, 4))
    steps = draw(st.lists(st.floats(1e-9, 10.0), min_size=rows, max_size=rows))
    t = np.cumsum([draw(st.floats(-1e6, 1e6)), *steps])[1:]
    t = t if (np.diff(t) > 0).all() else np.cumsum(steps)
    found, columns = {}, {}
    for name in draw(st.lists(NAMES, unique=True, max_size=4)):
        kind = draw(st.sampled_from(KINDS))
        found[name] = draw(values(kind, rows))
        first = found[name].shape[1:2]
        labels = draw(st.just(()) | st.tuples(*[TEXTS] * first[0])) if first else ()
        columns[name] = Column(unit=draw(UNITS), kind=kind, frame=draw(FRAMES), labels=labels)
    if draw(st.booleans()):
        found |= {"q": draw(arrays(float, (rows, 3), elements=REALS)), "seq": np.arange(rows) + 2**60}
        found |= {"wrench_hat": np.full((rows, 6), np.nan), "late": np.ones(rows, dtype=bool)}
    t0_ns, words = draw(st.integers(-(2**62), 2**62)), st.lists(TEXTS, max_size=2).map(tuple)
    return Table(t, found, columns, t0_ns=t0_ns, clock=draw(TEXTS), notes=draw(words), source=draw(words))


OURS = [(".csv", "mcap"), (".mat", "mcap"), (".parquet", "mcap"), (".h5", "mcap")]
OURS += [(".rosbag2", storage) for storage in STORAGES]


def check_round_trip(ending: str, storage: str, folder: Path, table: Table) -> None:
    """Check that a table is read back unchanged; poses of a rosbag2 go through quaternions."""
    if ending == ".rosbag2":
        table = replace(table, t0_ns=abs(table.t0_ns) % 2**60, notes=())
    again = log.read(log.write(table, folder / f"run{ending}", storage=storage))
    assert again.names == table.names
    assert dict(again.columns) == dict(table.columns)
    assert (again.t0_ns, again.clock, again.notes) == (table.t0_ns, table.clock, table.notes)
    assert again.source[0].startswith(f"run{ending} sha256 ")
    assert again.source[1:] == table.source
    poses = [name for name, one in table.columns.items() if one.kind == "pose"] if ending == ".rosbag2" else []
    for name in poses:
        np.testing.assert_allclose(again[name], table[name], rtol=0, atol=1e-14)
    assert again.without(*poses).sha256 == table.without(*poses).sha256


HERE = settings(max_examples=8, deadline=None, suppress_health_check=[*HealthCheck])


@pytest.mark.parametrize(("ending", "storage"), OURS)
@HERE
@given(table=tables())
def test_every_table_comes_back_the_same(ending: str, storage: str, tmp_path: Path, table: Table) -> None:
    check_round_trip(ending, storage, tmp_path, table)


@pytest.mark.slow
@pytest.mark.parametrize(("ending", "storage"), OURS)
@settings(HERE, max_examples=200)
@given(table=tables())
def test_every_table_comes_back_the_same_often(ending: str, storage: str, tmp_path: Path, table: Table) -> None:
    check_round_trip(ending, storage, tmp_path, table)


START = 1_700_000_000_000_000_000


@pytest.fixture
def table_bag() -> Table:
    rng = np.random.default_rng(3)
    values = {"q": rng.normal(size=(5, 2)), "tau": rng.normal(size=(5, 2)), "wrench": rng.normal(size=(5, 6))}
    values |= {"T_base_tool": se3.exp(rng.normal(size=(5, 6))), "seq": np.arange(5) + 2**60}
    values |= {"mode": np.array(["a", "", "grå", "d", "e"]), "late": np.arange(5) % 2 == 0}
    values |= {"J": rng.normal(size=(5, 2, 3)), "bits": np.arange(10).reshape(5, 2) % 2 == 1}
    columns = {"q": Column(labels=("elbow", "wrist")), "mode": Column(unit="1", kind="text"), "J": Column(unit="1")}
    columns["bits"] = Column(unit="1", kind="flag")
    return Table(1.0 + np.arange(5) * 0.004, values, columns, t0_ns=START, clock="robot", source=("here",))


@pytest.mark.parametrize("storage", STORAGES)
def test_what_another_program_reads(table_bag: Table, tmp_path: Path, storage: str) -> None:
    path = log.write(table_bag, tmp_path / "run.rosbag2", storage=storage)
    ending = {"mcap": "mcap", "sqlite3": "db3"}[storage]
    assert sorted(entry.name for entry in path.iterdir()) == ["metadata.yaml", f"run.rosbag2.{ending}"]
    assert "version: 8" in (path / "metadata.yaml").read_text()
    types, found = {}, {}
    with AnyReader([path]) as bag:
        for connection, stamp, raw in bag.messages():
            types[connection.topic] = connection.msgtype
            found.setdefault(connection.topic, []).append((stamp, bag.deserialize(raw, connection.msgtype)))
    assert Counter(len(messages) for messages in found.values()) == {5: len(types)}
    plain = {"t": "Float64", "seq": "Int64", "mode": "String", "late": "Bool", "J": "Float64MultiArray"}
    assert types == {
        **{f"/{name}": f"std_msgs/msg/{kind}" for name, kind in {**plain, "bits": "UInt8MultiArray"}.items()},
        "/joint_states": "sensor_msgs/msg/JointState",
        "/wrench": "geometry_msgs/msg/WrenchStamped",
        "/T_base_tool": "geometry_msgs/msg/PoseStamped",
    }
    stamp, joints = found["/joint_states"][1]
    assert stamp == START + 1_004_000_000
    assert (joints.header.stamp.sec, joints.header.stamp.nanosec) == (START // 10**9 + 1, 4_000_000)
    assert joints.name == ["elbow", "wrist"]
    np.testing.assert_array_equal(joints.position, table_bag["q"][1])
    np.testing.assert_array_equal(joints.effort, table_bag["tau"][1])
    assert len(joints.velocity) == 0
    wrench = found["/wrench"][2][1]
    assert (wrench.header.frame_id, wrench.wrench.torque.z) == ("base", table_bag["wrench"][2, 5])
    pose = found["/T_base_tool"][3][1].pose
    assert pose.position.y == table_bag["T_base_tool"][3, 1, 3]
    assert sum(getattr(pose.orientation, axis) ** 2 for axis in "wxyz") == pytest.approx(1.0)
    array = found["/J"][4][1]
    assert [(dim.size, dim.stride) for dim in array.layout.dim] == [(2, 6), (3, 3)]
    np.testing.assert_array_equal(array.data, table_bag["J"][4].ravel())
    assert [message.data for _, message in found["/mode"]] == table_bag["mode"].tolist()
    assert found["/seq"][2][1].data == 2**60 + 2
    assert is_ours(path)
    with Writer(tmp_path / "other", version=8, storage_plugin=StoragePlugin.SQLITE3) as bag:
        bag.add_connection("/armlab/chatter", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS2_HUMBLE))
    assert not is_ours(tmp_path / "other")
    assert not is_ours(tmp_path)
    with pytest.raises(LogError, match=r"a rosbag2 written by armlab .*/armlab/chatter \(std_msgs/msg/String\)"):
        read_rosbag2(tmp_path / "other")
    meet = Table([-5.0, -5.0 + 1e-15 * 4, 0.1, 0.1 + 1e-12], {"k": np.arange(4.0)}, {"k": Column(unit="1")})
    again = log.read(log.write(meet, tmp_path / "meet.rosbag2", storage=storage))
    assert again.sha256 == meet.sha256  # rows in the order of their stamps, the clock exact in /t


@pytest.mark.parametrize("storage", STORAGES)
def test_damaged_bags(table_bag: Table, tmp_path: Path, storage: str, read_spoilt: Callable[..., None]) -> None:
    path = log.write(table_bag, tmp_path / "run.rosbag2", storage=storage)
    for file in path.iterdir():
        read_spoilt(path, file, 5)
    assert log.read(path).names == table_bag.names
    for file in path.glob("run*"):
        again = log.read(file)  # a part on its own is read like any other program's
        np.testing.assert_array_equal(again["q"], table_bag["q"])
        file.unlink()
    with pytest.raises(LogError, match="a valid rosbag2"):
        log.read(path)


def test_topics_have_names_that_ros_allows_and_none_comes_twice() -> None:
    columns = {"a.b": Column((), "1"), "a_b": Column((), "1"), "t?": Column((2,), "1"), "joint_states": Column((), "1")}
    columns |= {"q": Column((2,), "rad"), "qd_sent": Column((2,), "rad/s"), "words": Column((2,), "1", kind="text")}
    topics = topics_of(columns, [])
    wanted = [("/t", "t"), ("/joint_states", "q"), ("/joint_states_sent", "qd_sent"), ("/a_b", "a.b")]
    wanted += [("/a_b_2", "a_b"), ("/t_", "t?"), ("/joint_states_2", "joint_states"), ("/words", "words")]
    assert [(topic.name, *topic.fields) for topic in topics] == wanted
