"""Test signals of ABB, and logs of orca and ExtCtrl."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots
from armlab.errors import ConfigError, LogError, RobotError, ShapeError, UnknownName
from armlab.log import Column, Table, from_orca, read_abb
from armlab.robots import Robot

N = 6
DEG = np.pi / 180
RNG = np.random.default_rng(7)
POS, SPEED, TRQ = RNG.uniform(-90, 90, (3, N, 7))
CLOCK = 1000.0 + 4.0 * np.arange(N)


def write_text(path: Path, labels: list[str], columns: list[np.ndarray], separator: str = ",") -> Path:
    rows = np.stack(columns, axis=1).tolist()
    lines = [separator.join(labels)] if labels else []
    path.write_text("\n".join(lines + [separator.join(map(repr, row)) for row in rows]) + "\n")
    return path


def write_map(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def yumi(tmp_path: Path, signals: dict[int, np.ndarray]) -> tuple[Path, Path]:
    labels = [f"s{signal} {axis}" for signal in signals for axis in range(1, 8)]
    columns = [array[:, axis] for array in signals.values() for axis in range(7)]
    lines = [
        f'"s{signal} {axis}" = {{ signal = {signal}, axis = {axis} }}' for signal in signals for axis in range(1, 8)
    ]
    head = 'arm = "yumi_left"\ntime = "time"\ntime_unit = "ms"\n[columns]\n'
    text = write_text(tmp_path / "run.txt", ["time", *labels], [CLOCK, *columns])
    return text, write_map(tmp_path / "map.toml", head + "\n".join(lines))


def test_units_and_order(tmp_path: Path) -> None:
    table = read_abb(*yumi(tmp_path, {4000: POS, 4001: SPEED, 4002: TRQ, 4003: 2 * TRQ}))
    order = [0, 1, 6, 2, 3, 4, 5]  # axis 7 is the third joint
    np.testing.assert_allclose(table.t, 0.004 * np.arange(N), atol=1e-12)
    np.testing.assert_allclose(table["q"], DEG * POS[:, order], rtol=1e-14)
    np.testing.assert_allclose(table["qd"], DEG * SPEED[:, order], rtol=1e-14)
    np.testing.assert_allclose(table["tau"], TRQ[:, order], rtol=1e-14)  # of the arm's side: no gears
    np.testing.assert_allclose(table["tau_ext"], 2 * TRQ[:, order], rtol=1e-14)
    assert dict(table.units) == {"q": "rad", "qd": "rad/s", "tau": "N m", "tau_ext": "N m"}
    assert table.columns["tau_ext"].labels == robots.load("yumi_left").joint_names
    assert [entry.split()[0] for entry in table.source] == ["run.txt", "read_abb(yumi_left,"]


def test_lines_of_a_rapid_logger(tmp_path: Path) -> None:
    """No labels, spaces, twelve channels at most: missing axes are missing, unknown signals keep their number."""
    columns = [CLOCK, POS[:, 0], POS[:, 6], TRQ[:, 4]]
    path = write_text(tmp_path / "run.txt", [], columns, "  ")
    path.write_text("time v1 v2\n" + path.read_text())
    about = write_map(
        tmp_path / "map.toml",
        'arm = "yumi_right"\ntime = "1"\ntime_unit = "ms"\nseparator = " "\nheader = false\nskip = 1\n[columns]\n'
        "2 = { signal = 4000, axis = 1 }\n3 = { signal = 4000, axis = 7 }\n4 = { signal = 203 }\n",
    )
    table = read_abb(path, about)
    np.testing.assert_allclose(table["q"][:, [0, 2]], DEG * POS[:, [0, 6]], rtol=1e-14)
    assert np.isnan(table["q"][:, [1, 3, 4, 5, 6]]).all()
    np.testing.assert_array_equal(table["signal_203_axis_1"], TRQ[:, 4])


def test_an_axis_that_abb_counts_from_the_foot(tmp_path: Path) -> None:
    """IRB 2400: axis 3 = q_2 + q_3, torques so that the power is kept; both orders of map and rod differ."""
    labels = [f"{what}{axis}" for what in "pst" for axis in range(1, 7)]
    columns = [array[:, axis] for array in (POS, SPEED, TRQ) for axis in range(6)]
    path = write_text(tmp_path / "run.txt", labels, columns, ";")
    lines = [
        f"{what}{axis} = {{ signal = {number}, axis = {axis} }}"
        for what, number in zip("pst", (4000, 4001, 4002))
        for axis in range(1, 7)
    ]
    about = write_map(
        tmp_path / "map.toml", 'arm = "irb2400"\nrate = 250.0\nseparator = ";"\n[columns]\n' + "\n".join(lines)
    )
    table = read_abb(path, about)
    q = DEG * POS[:, :6]
    np.testing.assert_allclose(table["q"][:, 1], q[:, 1], rtol=1e-13)
    np.testing.assert_allclose(table["q"][:, 2], q[:, 2] - q[:, 1], rtol=1e-13)
    power = (DEG * SPEED[:, :6] * TRQ[:, :6]).sum(axis=1)
    np.testing.assert_allclose((table["qd"] * table["tau"]).sum(axis=1), power, rtol=1e-12)
    np.testing.assert_allclose(table.t, np.arange(N) / 250)


def test_order_of_axes_comes_before_the_rod(tmp_path: Path) -> None:
    robot = robots.load("irb2400")
    mixed = replace(robot, name="mixed", abb_axes=(2, 1, 4, 3, 5, 6))
    robots.save(mixed, tmp_path / "mixed.toml")
    path = write_text(tmp_path / "run.txt", list("abcdef"), [POS[:, k] for k in range(6)])
    lines = [f"{name} = {{ signal = 4000, axis = {axis} }}" for axis, name in enumerate("abcdef", start=1)]
    head = f'arm = "{tmp_path / "mixed.toml"}"\nrate = 250.0\n[columns]\n'
    found = read_abb(path, write_map(tmp_path / "map.toml", head + "\n".join(lines)))["q"]
    rod = robot.coupling / np.diag(robot.coupling)
    np.testing.assert_allclose(found, DEG * POS[:, [1, 0, 3, 2, 4, 5]] @ rod.T, rtol=1e-12)
    assert np.abs(found - DEG * (POS[:, :6] @ rod.T)[:, [1, 0, 3, 2, 4, 5]]).max() > 0.1


def test_a_linear_axis_is_in_millimetres(tmp_path: Path) -> None:
    robot = robots.load("irb120")
    lift = replace(robot, name="lift", prismatic=(False, False, True, False, False, False))
    robots.save(lift, tmp_path / "lift.toml")
    path = write_text(tmp_path / "run.txt", ["a", "b"], [POS[:, 0], POS[:, 1]])
    about = f'arm = "{tmp_path / "lift.toml"}"\nrate = 10.0\n[columns]\n' + (
        "a = { signal = 4000, axis = 3 }\nb = { signal = 4000, axis = 4 }\n"
    )
    table = read_abb(path, write_map(tmp_path / "map.toml", about))
    np.testing.assert_allclose(table["q"][:, 2], 1e-3 * POS[:, 0], rtol=1e-14)
    np.testing.assert_allclose(table["q"][:, 3], DEG * POS[:, 1], rtol=1e-14)


def test_two_arms_in_one_file(tmp_path: Path) -> None:
    path = write_text(tmp_path / "run.txt", ["l", "r"], [POS[:, 0], POS[:, 1]])
    about = write_map(
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
        ("4000, axis = 1", "4000, axis = 2", ConfigError, "each signal of an axis once .*signal_4000_axis_2 twice"),
        ("axis = 1 }", "axes = 1 }", ConfigError, "unknown field `axes`"),
        ('time = "time"\n', "", ConfigError, "either time or rate"),
        ('"yumi_left"', '"yumi_up"', UnknownName, "yumi_up"),
        ('arm = "yumi_left"', "", ConfigError, "an arm for every column"),
        ("s4000 3", "s4000 9", LogError, "a column 's4000 9' in .*run.txt, as the map says, got time, s4000 1"),
        ('time_unit = "ms"', 'time_unit = "min"', LogError, "a unit that armlab knows for 't'"),
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
    whole = path.read_text()
    path.write_text(re.sub(r"\n1008\.0,", "\nlate,", whole))
    with pytest.raises(LogError, match=r"numbers in the column 'time' .*late"):
        read_abb(path, about)
    path.write_text(whole + "1,2\n")
    with pytest.raises(LogError, match=r"Expected 8 fields in line 8 .* got 2"):
        read_abb(path, about)
    path.write_text("time\n")
    with pytest.raises(LogError, match="lines of numbers"):
        read_abb(path, about)
    path.write_bytes(b"\0\1\2binary")
    with pytest.raises(LogError, match="signal viewers are read by them alone: export text there"):
        read_abb(path, about)
    with pytest.raises(LogError, match="No such file"):
        read_abb(tmp_path / "none.txt", about)
    with pytest.raises(ConfigError, match="a map of the columns at"):
        read_abb(path, tmp_path / "none.toml")
    assert log.read_abb is read_abb


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
    """As lc2csv writes: one column per leaf, no units, the joints not in order."""
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
    """Aliases, velocity that was not filtered, NaN before the first value: missing of the joints it moves."""
    robot, values = coupled(), signals(4)
    names = {
        f"robot_0__joint_{k}__{signal}": values[signal][:, k] for k in range(7) for signal in ("posRawAbs", "velRaw")
    }
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
    with pytest.raises(LogError, match=r"robot\[1\]\.joint\[0\]\.posRawAbs and so on, got arms 0\. Name another arm"):
        from_orca(table, robot, 1)
    with pytest.raises(LogError, match=r"got columns force"):
        from_orca(table.select("force.sensor[0]"), robot, 0)
    with pytest.raises(LogError, match=r"posRawAbs of 7 joints of robot\[0\] .*none of joint \[4\]"):
        from_orca(table.without("irb2ext.robot[0].joint[4].posRawAbs"), robot, 0)
    first = "irb2ext.robot[0].joint[0].posRawAbs"
    with pytest.raises(LogError, match=r"one posRawAbs per joint, got irb2ext.* and other"):
        from_orca(table.with_column("other.robot[0].joint[0].posRawAbs", table[first], unit="1"), robot, 0)
    with pytest.raises(LogError, match=r"in rad of the motor, got m\."):
        from_orca(table.with_column(first, table[first], unit="m"), robot, 0)
    with pytest.raises(RobotError):
        from_orca(table, "yumi_left", 0)  # type: ignore[arg-type]
    with pytest.raises(ShapeError):
        from_orca("run.csv", robot, 0)  # type: ignore[arg-type]
