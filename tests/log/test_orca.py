"""Logs of orca: order of axes first, then the gears, both told from the wrong way round."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots
from armlab.errors import LogError, RobotError, ShapeError
from armlab.log import Column, Table, from_orca
from armlab.robots import Robot

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


def test_the_other_order_gives_something_else(tmp_path: Path) -> None:
    """Gears before the order of axes, or G⁻¹ for torques: plausible, and wrong."""
    robot, values = coupled(), signals(1)
    found = from_orca(log.read_csv(write_log(tmp_path / "run.csv", [values]), rate=1 / PERIOD), robot, 0)
    G = robot.coupling
    wrong = (values["posRawAbs"] @ G.T)[:, ORDER]
    assert np.abs(found["q"] - wrong).max() > 0.01
    assert np.abs(wrong).max() < 2 * np.abs(found["q"]).max()
    ancestor = values["trqRaw"][:, ORDER] @ np.linalg.inv(G).T
    assert np.abs(found["tau"] - ancestor).max() > 10.0


def test_the_gears_keep_the_power(tmp_path: Path) -> None:
    robot, values = coupled(), signals(3)
    found = from_orca(log.read_csv(write_log(tmp_path / "run.csv", [values]), rate=1 / PERIOD), robot, 0)
    motors = (values["velFlt"] * values["trqRaw"]).sum(axis=1)
    np.testing.assert_allclose((found["qd"] * found["tau"]).sum(axis=1), motors, rtol=1e-9)


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


def test_a_labcomm_stream_ends_in_the_same_function(tmp_path: Path) -> None:
    """`read_labcomm` numbers structs in arrays and names their leaves alike."""
    robot, values = coupled(), signals(5)
    csv = from_orca(log.read_csv(write_log(tmp_path / "run.csv", [values]), rate=1 / PERIOD), robot, 0)
    names = {f"irb2ext.robot[0].joint[{k}].{s}": array[:, k] for s, array in values.items() for k in range(7)}
    stream = Table(np.arange(20) * PERIOD, names, dict.fromkeys(names, Column(unit="1")))
    assert from_orca(stream, robot, 0).sha256 == Table(stream.t, csv.values, csv.columns).sha256


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
