"""An accelerometer at rest reads g upwards; what is left of its reading is motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import models
from armlab.errors import ShapeError
from armlab.lie import se3, so3
from armlab.models import Accelerometer

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z


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


def test_file(tmp_path) -> None:
    sensor = Accelerometer(QUARTER, np.ones(3), 1.1, sources=("a",))
    again = models.load(models.save(sensor, tmp_path / "acc.toml"), kind="accelerometer")
    for name in sensor.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(sensor, name))
    assert not again.bias.flags.writeable


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("R_tool_sensor", np.diag([1.0, 1.0, -1.0]), "a rotation"),
        ("bias", np.full(3, np.nan), "finite bias"),
        ("gravity", np.zeros(2), "finite gravity"),
        ("scale", 0.0, "scale above zero"),
    ],
)
def test_refusals(field: str, value: object, words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        replace(Accelerometer(np.eye(3), np.zeros(3)), **{field: value})


def test_wrong_readings() -> None:
    with pytest.raises(ShapeError, match="readings"):
        Accelerometer(np.eye(3), np.zeros(3)).acceleration(np.zeros(2), np.eye(4))
