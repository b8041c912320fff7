"""A known mass, turned anywhere: what the sensor reads is physics worked out by hand, and the contact comes back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models
from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.lie import se3, so3
from armlab.models import ForceSensor

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z


def some(seed: int = 0, sign: int = 1) -> ForceSensor:
    rng = np.random.default_rng(seed)
    return ForceSensor(
        R_tool_sensor=so3.exp(rng.normal(size=3)),
        mass=float(rng.uniform(0.1, 3.0)),
        centre=rng.normal(size=3) * 0.05,
        bias=rng.normal(size=6),
        sign=sign,
        gravity=rng.normal(size=3) * 5.0,
        position=rng.normal(size=3) * 0.1,
        robot_name="a",
        robot_hash="b",
        sources=("c",),
    )


def close(found: np.ndarray, expected: list[float]) -> None:
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_mass_that_hangs_down_by_hand() -> None:
    """2 kg, 0.1 m out along the sensor's x. The tool's axes are the base's; the sensor is turned by 90 deg about z."""
    sensor, m_g = ForceSensor(QUARTER, 2.0, np.array([0.1, 0.0, 0.0]), np.array([1.0, 0, 0, 0, 0.5, 0])), 2.0 * 9.80665
    unloaded = sensor.unloaded(np.eye(4))
    close(unloaded, [1, 0, -m_g, 0, 0.5 + 0.1 * m_g, 0])
    pushed = unloaded + np.array([3.0, 0, 0, 0, 0, 0.2])  # along the sensor's x, the tool's y
    close(sensor.contact(pushed, np.eye(4)), [0, 3, 0, 0, 0, 0.2])
    tipped = se3.from_rp(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), np.ones(3))  # the tool's y points up
    close(sensor.contact(pushed, tipped, frame="tool")[:3], [0, 3 + m_g, -m_g])  # the weight expected elsewhere
    close(sensor.contact(sensor.unloaded(tipped) + np.array([3.0, 0, 0, 0, 0, 0]), tipped)[:3], [0, 0, 3])
    away = replace(sensor, position=np.array([0.0, 0.0, 0.5]))  # 0.5 m further along the tool: 3 N at that arm
    close(away.wrench(pushed, np.eye(4)), [0, 3, 0, -1.5, 0, 0.2])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
def test_what_was_put_in_comes_out(sign: int, batch: tuple[int, ...]) -> None:
    """Raw readings composed element by element; power is the same in all axes and at both points."""
    sensor, rng = some(1, sign), np.random.default_rng(2)
    poses = se3.from_rp(so3.exp(rng.normal(size=(*batch, 3))), rng.normal(size=(*batch, 3)))
    wrench = rng.normal(size=(*batch, 6))
    raw = np.zeros((*batch, 6))
    for at in np.ndindex(batch):
        R = poses[at][:3, :3]
        p = R @ sensor.position
        f, m = wrench[at][:3], wrench[at][3:]
        weight = sensor.mass * sensor.R_tool_sensor.T @ R.T @ sensor.gravity
        felt = np.r_[sensor.R_tool_sensor.T @ R.T @ f, sensor.R_tool_sensor.T @ R.T @ (m - np.cross(p, f))]
        raw[at] = sign * (felt + np.r_[weight, np.cross(sensor.centre, weight)]) + sensor.bias
    np.testing.assert_allclose(sensor.wrench(raw, poses), wrench, atol=1e-12)
    contact, in_tool = sensor.contact(raw, poses), sensor.contact(raw, poses, frame="tool")
    np.testing.assert_allclose(contact[..., :3], wrench[..., :3], atol=1e-12)
    R = poses[..., :3, :3]
    for part in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(np.einsum("...ij,...j->...i", R, in_tool[..., part]), contact[..., part], atol=1e-12)
    np.testing.assert_array_equal(sensor.unloaded(poses).shape, (*batch, 6))


def test_nan_stays_and_moments_that_were_not_calibrated_are_nan() -> None:
    sensor = some()
    raw = np.ones(6)
    raw[4] = np.nan
    assert np.isnan(sensor.contact(raw, np.eye(4))[3:]).all()
    assert np.isfinite(sensor.contact(raw, np.eye(4))[:3]).all()
    forces = replace(sensor, centre=np.full(3, np.nan), bias=np.r_[sensor.bias[:3], np.full(3, np.nan)])
    np.testing.assert_array_equal(forces.wrench(np.ones(6), np.eye(4))[:3], sensor.wrench(np.ones(6), np.eye(4))[:3])
    assert np.isnan(forces.wrench(np.ones(6), np.eye(4))[3:]).all()


def test_file(tmp_path: Path) -> None:
    sensor = some(3, -1)
    path = models.save(sensor, tmp_path / "force.toml")
    again = models.load(path, kind="force_sensor")
    assert isinstance(again, ForceSensor)
    for name in sensor.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(sensor, name))
    assert not again.bias.flags.writeable
    path.write_text(path.read_text(encoding="utf-8").replace("sign = -1", "sign = 2"), encoding="utf-8")
    with pytest.raises((ConfigError, ShapeError), match=r"sign \+1 or -1"):
        models.load(path)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("R_tool_sensor", np.diag([1.0, 1.0, -1.0]), "a rotation"),
        ("R_tool_sensor", np.eye(3) * 1.01, "a rotation"),
        ("R_tool_sensor", np.eye(4), r"finite R_tool_sensor of shape \(3, 3\)"),
        ("mass", -0.1, "mass of 0 kg or more"),
        ("mass", np.nan, "mass of 0 kg or more"),
        ("centre", np.array([np.nan, 0.0, 0.0]), "finite centre"),
        ("bias", np.full(6, np.nan), "finite bias"),
        ("bias", np.zeros(3), "finite bias"),
        ("gravity", np.array([0.0, 0.0, np.inf]), "finite gravity"),
        ("position", np.zeros(2), "finite position"),
        ("sign", 0, r"sign \+1 or -1"),
    ],
)
def test_refusals(field: str, value: object, words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        replace(some(), **{field: value})


def test_wrong_readings_and_poses() -> None:
    sensor = some()
    with pytest.raises(ShapeError, match=r"readings \(\.\.\., 6\)"):
        sensor.contact(np.zeros(3), np.eye(4))
    with pytest.raises(ShapeError, match="T_base_tool"):
        sensor.wrench(np.zeros(6), np.eye(3))
    with pytest.raises(ShapeError, match="T_base_tool"):
        sensor.unloaded(np.zeros(6))
    with pytest.raises(UnknownName, match="sensor"):
        sensor.contact(np.zeros(6), np.eye(4), frame="sensor")  # type: ignore[arg-type]
