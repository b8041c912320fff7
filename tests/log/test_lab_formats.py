"""Laboratory file formats: ABB test signals, orca and ExtCtrl logs, Nikon trackers."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from armlab import log, robots
from armlab.errors import ConfigError, LogError, RobotError, ShapeError, UnknownName
from armlab.lie import euler, se3, so3
from armlab.log import Column, Table, from_orca, read_abb
from armlab.log.nikon import Cloud, PlaneFile, PoseFile, read_cloud, read_matrix, read_plane
from armlab.robots import Robot

N = 6
DEG = np.pi / 180
RNG = np.random.default_rng(7)
POS, SPEED, TRQ = RNG.uniform(-90, 90, (3, N, 7))
CLOCK = 1000.0 + 4.0 * np.arange(N)


def written(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def write_text(path: Path, labels: list[str], columns: list[np.ndarray], separator: str = ",") -> Path:
    rows = np.stack(columns, axis=1).tolist()
    lines = [separator.join(labels)] if labels else []
    return written(path, "\n".join(lines + [separator.join(map(repr, row)) for row in rows]) + "\n")


def yumi(tmp_path: Path, signals: dict[int, np.ndarray]) -> tuple[Path, Path]:
    names = [(signal, axis) for signal in signals for axis in range(1, 8)]
    labels = [f"s{signal} {axis}" for signal, axis in names]
    columns = [array[:, axis] for array in signals.values() for axis in range(7)]
    lines = [f'"s{signal} {axis}" = {{ signal = {signal}, axis = {axis} }}' for signal, axis in names]
    head = 'arm = "yumi_left"\ntime = "time"\ntime_unit = "ms"\n[columns]\n'
    text = write_text(tmp_path / "run.txt", ["time", *labels], [CLOCK, *columns])
    return text, written(tmp_path / "map.toml", head + "\n".join(lines))


def test_units_and_order(tmp_path: Path) -> None:
    table = read_abb(*yumi(tmp_path, {4000: POS, 4001: SPEED, 4002: TRQ, 4003: 2 * TRQ}))
    order = [0, 1, 6, 2, 3, 4, 5]  # axis 7 is the third joint
    np.testing.assert_allclose(table.t, 0.004 * np.arange(N), atol=1e-12)
    np.testing.assert_allclose(table["q"], DEG * POS[:, order], rtol=1e-14)
    np.testing.assert_allclose(table["qd"], DEG * SPEED[:, order], rtol=1e-14)
    np.testing.assert_allclose(table["tau"], TRQ[:, order], rtol=1e-14)  # on the joint side: no gears
    np.testing.assert_allclose(table["tau_ext"], 2 * TRQ[:, order], rtol=1e-14)
    assert dict(table.units) == {"q": "rad", "qd": "rad/s", "tau": "N m", "tau_ext": "N m"}
    assert table.columns["tau_ext"].labels == robots.load("yumi_left").joint_names
    assert [entry.split()[0] for entry in table.source] == ["run.txt", "read_abb(yumi_left,"]


def test_lines_of_a_rapid_logger(tmp_path: Path) -> None:
    columns = [CLOCK, POS[:, 0], POS[:, 6], TRQ[:, 4]]
    path = write_text(tmp_path / "run.txt", [], columns, "  ")
    path.write_text("time v1 v2\n" + path.read_text())
    about = written(
        tmp_path / "map.toml",
        'arm = "yumi_right"\ntime = "1"\ntime_unit = "ms"\nseparator = " "\nheader = false\nskip = 1\n[columns]\n'
        "2 = { signal = 4000, axis = 1 }\n3 = { signal = 4000, axis = 7 }\n4 = { signal = 203 }\n",
    )
    table = read_abb(path, about)
    np.testing.assert_allclose(table["q"][:, [0, 2]], DEG * POS[:, [0, 6]], rtol=1e-14)
    assert np.isnan(table["q"][:, [1, 3, 4, 5, 6]]).all()
    np.testing.assert_array_equal(table["signal_203_axis_1"], TRQ[:, 4])


def test_an_axis_that_abb_counts_from_the_foot(tmp_path: Path) -> None:
    """IRB 2400: axis 3 = q_2 + q_3, with torques that preserve power; the two orders of map and rod differ."""
    labels = [f"{what}{axis}" for what in "pst" for axis in range(1, 7)]
    columns = [array[:, axis] for array in (POS, SPEED, TRQ) for axis in range(6)]
    path = write_text(tmp_path / "run.txt", labels, columns, ";")
    numbers = {"p": 4000, "s": 4001, "t": 4002}
    lines = [f"{name} = {{ signal = {numbers[name[0]]}, axis = {name[1]} }}" for name in labels]
    head = 'arm = "irb2400"\nrate = 250.0\nseparator = ";"\n[columns]\n'
    about = written(tmp_path / "map.toml", head + "\n".join(lines))
    table = read_abb(path, about)
    q = DEG * POS[:, :6]
    np.testing.assert_allclose(table["q"][:, 1], q[:, 1], rtol=1e-13)
    np.testing.assert_allclose(table["q"][:, 2], q[:, 2] - q[:, 1], rtol=1e-13)
    power = (DEG * SPEED[:, :6] * TRQ[:, :6]).sum(axis=1)
    np.testing.assert_allclose((table["qd"] * table["tau"]).sum(axis=1), power, rtol=1e-12)
    np.testing.assert_allclose(table.t, np.arange(N) / 250)


def test_order_of_axes_comes_before_the_rod_and_a_linear_axis_is_in_millimetres(tmp_path: Path) -> None:
    arm = robots.load("irb2400")
    robots.save(replace(arm, name="mixed", abb_axes=(2, 1, 4, 3, 5, 6)), tmp_path / "mixed.toml")
    path = write_text(tmp_path / "run.txt", list("abcdef"), [POS[:, k] for k in range(6)])
    lines = [f"{name} = {{ signal = 4000, axis = {axis} }}" for axis, name in enumerate("abcdef", start=1)]
    head = f'arm = "{tmp_path / "mixed.toml"}"\nrate = 250.0\n[columns]\n'
    found = read_abb(path, written(tmp_path / "map.toml", head + "\n".join(lines)))["q"]
    rod = arm.coupling / np.diag(arm.coupling)
    np.testing.assert_allclose(found, DEG * POS[:, [1, 0, 3, 2, 4, 5]] @ rod.T, rtol=1e-12)
    assert np.abs(found - DEG * (POS[:, :6] @ rod.T)[:, [1, 0, 3, 2, 4, 5]]).max() > 0.1
    robot = robots.load("irb120")
    lift = replace(robot, name="lift", prismatic=(False, False, True, False, False, False))
    robots.save(lift, tmp_path / "lift.toml")
    path = write_text(tmp_path / "run.txt", ["a", "b"], [POS[:, 0], POS[:, 1]])
    about = f'arm = "{tmp_path / "lift.toml"}"\nrate = 10.0\n[columns]\n'
    about += "a = { signal = 4000, axis = 3 }\nb = { signal = 4000, axis = 4 }\n"
    table = read_abb(path, written(tmp_path / "map.toml", about))
    np.testing.assert_allclose(table["q"][:, 2], 1e-3 * POS[:, 0], rtol=1e-14)
    np.testing.assert_allclose(table["q"][:, 3], DEG * POS[:, 1], rtol=1e-14)


def test_two_arms_in_one_file(tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.txt", ["l", "r"], [POS[:, 0], POS[:, 1]])
    about = written(
        tmp_path / "map.toml",
        'rate = 10.0\n[columns]\nl = { signal = 4002, axis = 1, arm = "yumi_left" }\n'
        'r = { signal = 4002, axis = 1, arm = "yumi_right" }\n',
    )
    for arm, column in (("yumi_left", 0), ("yumi_right", 1)):
        np.testing.assert_array_equal(read_abb(path, about, arm)["tau"][:, 0], POS[:, column])
    with pytest.raises(ConfigError, match=r"one arm \(arm=\) .*yumi_left, yumi_right"):
        read_abb(path, about)
    with pytest.raises(UnknownName, match="arm of the map"):
        read_abb(path, about, "irb120")


@pytest.mark.parametrize(
    ("old", "new", "error", "words"),
    [
        ("4000, axis = 1", "4000, axis = 8", ConfigError, "an axis from 1 to 7 of 'yumi_left' .* got 8"),
        ("4000, axis = 1", "4000, axis = 2", ConfigError, "exactly once .*signal_4000_axis_2 twice"),
        ("axis = 1 }", "axes = 1 }", ConfigError, "unknown field `axes`"),
        ('time = "time"\n', "", ConfigError, "either time or rate"),
        ('"yumi_left"', '"yumi_up"', UnknownName, "yumi_up"),
        ('arm = "yumi_left"', "", ConfigError, "an arm for every column"),
        ("s4000 3", "s4000 9", LogError, "a column 's4000 9' in .*run.txt, as stated in the map, got time, s4000 1"),
        ('time_unit = "ms"', 'time_unit = "min"', LogError, "a supported unit for 't'"),
    ],
)
def test_maps_that_are_wrong(tmp_path: Path, old: str, new: str, error: type[Exception], words: str) -> None:
    path, about = yumi(tmp_path, {4000: POS})
    assert old in about.read_text()
    about.write_text(about.read_text().replace(old, new, 1))
    with pytest.raises(error, match=words) as told:
        read_abb(path, about)
    assert str(told.value)[-1] in ".?"


def test_files_that_are_wrong(tmp_path: Path) -> None:
    path, about = yumi(tmp_path, {4000: POS})
    whole = path.read_bytes()
    for data, words in (
        (re.sub(rb"\n1008\.0,", b"\nlate,", whole), r"numbers in the column 'time' .*late"),
        (whole + b"1,2\n", r"Expected 8 fields in line 8 .* got 2"),
        (b"time\n", "lines of numbers"),
        (b"\0\1\2binary", "signal viewer, the only program that can read its binary files"),
    ):
        path.write_bytes(data)
        with pytest.raises(LogError, match=words):
            read_abb(path, about)
    with pytest.raises(LogError, match="No such file"):
        read_abb(tmp_path / "none.txt", about)
    with pytest.raises(ConfigError, match="a map of the columns at"):
        read_abb(path, tmp_path / "none.toml")


PERIOD = 0.004032
ORDER = [0, 1, 6, 2, 3, 4, 5]  # ABB's axes 1, 2, 7, 3, 4, 5, 6


def coupled() -> Robot:
    """A YuMi arm whose wrist motor also turns the last joint."""
    robot = robots.load("yumi_left")
    G = np.diag([1 / 100, 1 / 100, 1 / 100, -1 / 100, 1 / 100, -1 / 101, 1 / 100])
    np.testing.assert_allclose(robot.coupling, G, rtol=1e-15)
    G[6, 5], G[3, 2] = 1 / 70, 1 / 90
    return replace(robot, coupling=G)


def signals(seed: int, rows: int = 20) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=(rows, 7)) for name in ("posRawAbs", "velFlt", "velRaw", "trqRaw")}


def write_log(path: Path, arms: list[dict[str, np.ndarray]], prefix: str = "irb2ext.") -> Path:
    """Write as lc2csv does: one column per leaf, no units, joints out of order."""
    labels, columns = [], []
    for arm, values in enumerate(arms):
        for joint in (3, 0, 6, 1, 2, 5, 4):
            for name, array in values.items():
                labels.append(f"{prefix}robot[{arm}].joint[{joint}].{name}")
                columns.append(array[:, joint])
    labels, columns = [*labels, "force.sensor[0]"], [*columns, columns[0]]
    rows = [",".join(map(repr, row)) for row in np.stack(columns, axis=1).tolist()]
    path.write_text("\n".join([",".join(labels), *rows]) + "\n")
    return path


def test_joints_of_both_arms(tmp_path: Path) -> None:
    robot, arms = coupled(), [signals(1), signals(2)]
    table = log.read_csv(write_log(tmp_path / "run.csv", arms), rate=1 / PERIOD)
    assert from_orca(table, robot, 0).names == ("q", "qd", "tau")
    for arm, values in enumerate(arms):
        found = from_orca(table, robot, arm)
        G = robot.coupling
        np.testing.assert_allclose(found["q"], values["posRawAbs"][:, ORDER] @ G.T, rtol=1e-13)
        np.testing.assert_allclose(found["qd"], values["velFlt"][:, ORDER] @ G.T, rtol=1e-13)
        np.testing.assert_allclose(found["tau"], values["trqRaw"][:, ORDER] @ np.linalg.inv(G), rtol=1e-13)
        assert found.columns["q"].labels == robot.joint_names
        assert np.array_equal(found.t, table.t)
        assert found.source[-1] == f"from_orca(yumi_left, arm {arm})"


def test_names_of_the_old_exports_and_holes(tmp_path: Path) -> None:
    """Aliases, unfiltered velocity, NaN before a motor's first value: missing for the joints that the motor moves."""
    robot, values, kinds = coupled(), signals(4), ("posRawAbs", "velRaw")
    names = {f"robot_0__joint_{k}__{signal}": values[signal][:, k] for k in range(7) for signal in kinds}
    names["robot_0__joint_2__posRawAbs"] = np.where(np.arange(20) < 3, np.nan, values["posRawAbs"][:, 2])
    names["robot_0__joint_7__posRawAbs"] = np.zeros(20)  # an external axis
    table = Table(np.arange(20) * PERIOD, names, dict.fromkeys(names, Column(unit="1")))
    found = from_orca(table, robot, 0)
    assert found.names == ("q", "qd")
    np.testing.assert_allclose(found["qd"], values["velRaw"][:, ORDER] @ robot.coupling.T, rtol=1e-13)
    assert np.isnan(found["q"][:3, 3]).all()  # ABB's axis 3 is joint 4
    assert np.isfinite(found["q"][:, [0, 1, 2, 4, 5, 6]]).all()
    assert np.isfinite(found["q"][3:]).all()


def test_what_is_refused(tmp_path: Path) -> None:
    robot, values = coupled(), signals(6)
    table = log.read_csv(write_log(tmp_path / "run.csv", [values]), rate=1 / PERIOD)
    first = "irb2ext.robot[0].joint[0].posRawAbs"
    twice = table.with_column("other.robot[0].joint[0].posRawAbs", table[first], unit="1")
    for wrong, arm, words in (
        (table, 1, r"robot\[1\]\.joint\[0\]\.posRawAbs and so on, got arms 0\. Pass another arm"),
        (table.select("force.sensor[0]"), 0, "got columns force"),
        (table.without(first.replace("joint[0]", "joint[4]")), 0, r"of 7 joints of robot\[0\] .*but joints \[4\] are"),
        (twice, 0, r"one posRawAbs per joint, got irb2ext.* and other"),
        (table.with_column(first, table[first], unit="m"), 0, r"motor values in rad in irb2ext.*, got m\."),
    ):
        with pytest.raises(LogError, match=words):
            from_orca(wrong, robot, arm)
    with pytest.raises(RobotError):
        from_orca(table, "yumi_left", 0)  # type: ignore[arg-type]
    with pytest.raises(ShapeError):
        from_orca("run.csv", robot, 0)  # type: ignore[arg-type]


CLOUD = (
    "[0.000000 , -450.925232 , 144.769196 , -2566.102783 , 10.0 , 20.0 , 30.0 ;\r\n"
    "1.000000 , -451.412628 , 187.260742 , -2575.094238 , -113.191585 , 0.976892 , -139.300146]\r\n"
    "\r\n// REF_OBJECT = \r\n// MEAS_OBJECT = CloudSeam"
)
PLANE = (
    "[-0.011454 , -0.005684 , 0.999918 , -447.610821 ;\r\n0.504093 , 0.863583 , 0.010683 , 239.195030 ;\r\n"
    "-0.863574 , 0.504174 , -0.007026 , -2653.884552 ;\r\n0.000000 , 0.000000 , 0.000000 , 1.000000]\r\n\r\n"
    "// MEAS_OBJECT = PlaneSeam"
)


def test_read_cloud_with_any_separators_up_to_a_word(tmp_path: Path) -> None:
    cloud = read_cloud(written(tmp_path / "file.txt", CLOUD))
    assert isinstance(cloud, Cloud)
    whole = cloud.p
    np.testing.assert_allclose(whole[0], [-0.450925232, 0.144769196, -2.566102783], rtol=0, atol=1e-15)
    assert (cloud.index.tolist(), whole.flags.writeable) == ([0.0, 1.0], False)
    np.testing.assert_allclose(cloud.R[0], euler.from_rpy(np.deg2rad([10.0, 20, 30]), "xyz"), atol=1e-15)
    assert (cloud.stopped, cloud.comments) == (4, {"REF_OBJECT": "", "MEAS_OBJECT": "CloudSeam"})
    for text in (
        CLOUD.replace(" , ", " "),
        CLOUD.replace(" , ", ","),
        CLOUD.replace(" , ", "\t,\t"),
        CLOUD.replace("\r\n", "\n"),
        "\ufeff" + CLOUD.replace("[", '"[ ').replace("]", "]' "),
        CLOUD.replace(";", ""),
        "\n\n" + CLOUD,
    ):
        np.testing.assert_array_equal(read_cloud(written(tmp_path / "file.txt", text)).p, whole)
    first, second = CLOUD.split("\r\n")[:2]
    cloud = read_cloud(written(tmp_path / "file.txt", f"{first}\n\n{second}"))
    assert (len(cloud.p), cloud.stopped) == (2, 0)
    cloud = read_cloud(written(tmp_path / "file.txt", f"{first}\n// end\n{second}"))
    assert (len(cloud.p), cloud.stopped) == (1, 2)


def test_read_plane_makes_the_normal_unit_unless_raw(tmp_path: Path) -> None:
    path = written(tmp_path / "file.txt", PLANE)
    plane, raw = read_plane(path), read_plane(path, raw=True)
    assert isinstance(plane, PlaneFile)
    assert np.linalg.norm(plane.normal) == pytest.approx(1.0, abs=1e-15)
    assert raw.normal.tolist() == [0.999918, 0.010683, -0.007026]
    np.testing.assert_allclose(plane.point, [-0.447610821, 0.239195030, -2.653884552], rtol=0, atol=1e-15)
    assert plane.comments == {"MEAS_OBJECT": "PlaneSeam"}


@pytest.mark.parametrize(
    ("read", "text", "sentence"),
    [
        (read_cloud, "", "an empty file"),
        (read_cloud, "hello\n", "'hello' in line 1"),
        (read_cloud, "1 2 3\n", "3 in line 1"),
        (read_cloud, CLOUD.replace("144.769196", "NaN"), "'NaN' in line 1, column 3"),
        (read_cloud, CLOUD.replace("187.260742", "1e999"), "'1e999' in line 2, column 3"),
        (read_cloud, CLOUD.replace("0.976892 , ", ""), "6 in line 2"),
        (read_cloud, PLANE, "4 in line 1"),
        (read_cloud, "a\0b", "binary"),
        (read_plane, PLANE.replace("1.000000]", "2.000000]"), "last row"),
        (read_plane, "\n".join(PLANE.split("\r\n")[:3]), "3 rows"),
        (read_plane, PLANE.replace("0.999918", "0.899918"), "normal of length 1"),
        (read_plane, CLOUD, "7 in line 1"),
    ],
)
def test_other_files_are_refused_with_line_and_column(tmp_path: Path, read, text: str, sentence: str) -> None:
    with pytest.raises(LogError, match=sentence):
        read(written(tmp_path / "file.txt", text))
    with pytest.raises(LogError, match="No such file"):
        read(tmp_path / "missing.txt")


def pose_file(tmp_path: Path, M: np.ndarray, **more: np.ndarray) -> Path:
    path = tmp_path / "pose.mat"
    savemat(path, {"T_a_b": M, **more})
    return path


def test_read_matrix(tmp_path: Path) -> None:
    T = se3.from_rp(so3.exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    found = read_matrix(pose_file(tmp_path, T))
    assert isinstance(found, PoseFile)
    np.testing.assert_allclose(found.T[:3, 3], [1e-3, 2e-3, 3e-3], rtol=1e-15)
    np.testing.assert_array_equal(found.T[:3, :3], T[:3, :3])
    assert found.name == "T_a_b"
    two = pose_file(tmp_path, T, other=T)
    assert read_matrix(two, "other").name == "other"
    with pytest.raises(LogError, match="name="):
        read_matrix(two)
    for M, sentence in (
        (np.diag([1.0, 1, -1, 1]), "left-handed"),
        (np.diag([1.0, 1, 1, 2]), "a matrix that is not a pose"),
        (np.diag([np.nan, 1, 1, 1]), "row 1"),
        (np.zeros((4, 4)), "a matrix that is not a pose"),
        (np.eye(3), "one 4x4 array"),
    ):
        with pytest.raises(LogError, match=sentence):
            read_matrix(pose_file(tmp_path, M), project=True)


def test_a_rotation_that_is_none_is_projected_on_demand_only(tmp_path: Path) -> None:
    T = se3.from_rp(so3.exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    T[0, 0] += 1e-5
    path = pose_file(tmp_path, T)
    with pytest.raises(LogError, match=r"project=True"):
        read_matrix(path)
    found = read_matrix(path, project=True)
    assert se3.is_pose(found.T, 1e-14)
    assert found.distance == pytest.approx(1e-5, rel=0.3)
    T[0, 0] -= 1e-5
    T[0, 0] += 1e-8  # rounding in the file is corrected
    found = read_matrix(pose_file(tmp_path, T))
    assert se3.is_pose(found.T, 1e-14)
    np.testing.assert_allclose(found.T[:3, :3], T[:3, :3], rtol=0, atol=1e-8)
