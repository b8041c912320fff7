"""A scanner on a tool: where its points are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import models
from armlab.errors import ShapeError
from armlab.lie import se3
from armlab.models import LaserSensor


def some() -> LaserSensor:
    X = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
    return LaserSensor(X, np.eye(3)[:2], np.array([1.0, 0.5]), ("a", "b"), sources=("c",))


def test_points_by_hand() -> None:
    np.testing.assert_allclose(some().points([0.2, 0.05], np.eye(4)), [0.05, 0.2, 0.3], atol=1e-15)
    lifted = se3.from_rp(np.eye(3), [0.0, 0.0, 1.0])
    found = some().points(np.array([[0.2, 0.05], [np.nan, 0.0]]), lifted)
    np.testing.assert_allclose(found[0], [0.05, 0.2, 1.3], atol=1e-15)
    assert np.isnan(found[1]).any()


def test_file(tmp_path) -> None:
    again = models.load(models.save(some(), tmp_path / "laser.toml"), kind="laser_sensor")
    for name in again.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(some(), name))
    assert not again.normals.flags.writeable


def test_refusals() -> None:
    for field, value, words in (
        ("T_tool_sensor", 2.0 * np.eye(4), "T_tool_sensor"),
        ("normals", 2.0 * np.eye(3)[:2], "unit normals"),
        ("offsets", np.ones(3), "offsets of shape"),
    ):
        with pytest.raises(ShapeError, match=words):
            replace(some(), **{field: value})
    with pytest.raises(ShapeError, match="points"):
        some().points(np.zeros(3), np.eye(4))
