"""Models of force sensors, accelerometers and laser sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.lie import se3, so3
from armlab.models import Accelerometer, ForceSensor, LaserSensor

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


# An accelerometer at rest reads g upwards; what is left of its reading is motion.


def test_by_hand() -> None:
    """A sensor turned by 90 degrees about z that reads 10 % too much, on a tool that falls, stands and starts."""
    sensor = Accelerometer(QUARTER, np.array([0.1, 0.0, 0.0]), 1.1)
    np.testing.assert_allclose(sensor.acceleration([0.1, 0.0, 1.1 * 9.80665], np.eye(4)), 0.0, atol=1e-12)
    np.testing.assert_allclose(sensor.acceleration([0.1, 0, 0], np.eye(4)), [0, 0, -9.80665], atol=1e-12)
    np.testing.assert_allclose(sensor.acceleration([1.2, 0, 1.1 * 9.80665], np.eye(4)), [0, 1, 0], atol=1e-12)


def test_batches_and_nan() -> None:
    rng = np.random.default_rng(0)
    sensor = Accelerometer(so3.exp(rng.normal(size=3)), rng.normal(size=3))
    poses = se3.from_rp(so3.exp(rng.normal(size=(2, 5, 3))), np.zeros((2, 5, 3)))
    raw = rng.normal(size=(2, 5, 3))
    raw[1, 2, 0] = np.nan
    found = sensor.acceleration(raw, poses)
    np.testing.assert_array_equal(found[0, 3], sensor.acceleration(raw[0, 3], poses[0, 3]))
    assert np.isnan(found[1, 2]).all()
    assert np.isfinite(found[0]).all()


# A scanner on a tool: where its points are.


def some_of_laser_sensor() -> LaserSensor:
    X = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
    return LaserSensor(X, np.eye(3)[:2], np.array([1.0, 0.5]), ("a", "b"), sources=("c",))


def test_points_by_hand() -> None:
    np.testing.assert_allclose(some_of_laser_sensor().points([0.2, 0.05], np.eye(4)), [0.05, 0.2, 0.3], atol=1e-15)
    lifted = se3.from_rp(np.eye(3), [0.0, 0.0, 1.0])
    found = some_of_laser_sensor().points(np.array([[0.2, 0.05], [np.nan, 0.0]]), lifted)
    np.testing.assert_allclose(found[0], [0.05, 0.2, 1.3], atol=1e-15)
    assert np.isnan(found[1]).any()
