"""A probe's tip is one constant; a point at another distance is an outlier."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.frames import OffsetCheck, Plane, check_offset

PLANE = Plane.of([0.1, 0.2, 1.0], [0.3, 0.4, 2.0])


def points(n: int, offset: float, sigma: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    on = PLANE.centroid + rng.uniform(-1, 1, (n, 2)) @ PLANE.axes
    return on + (offset + sigma * rng.standard_normal((n, 1))) * PLANE.n


def test_the_constant_and_its_deviation() -> None:
    found = check_offset(PLANE, points(400, -0.005, 1e-4))
    assert isinstance(found, OffsetCheck)
    assert found.sigma == pytest.approx(1e-4, rel=0.1)
    assert found.sd == pytest.approx(found.sigma / 20, rel=0.01)
    assert abs(found.offset + 0.005) < 4 * found.sd
    assert found.outliers.sum() <= 3


def test_outliers_are_flagged_by_index() -> None:
    p = points(9, 0.005, 5e-5)
    p[[1, 4, 7, 8]] += np.outer([0.01, -0.02, 0.03, 0.004], PLANE.n)
    found = check_offset(PLANE, p)
    assert np.flatnonzero(found.outliers).tolist() == [1, 4, 7, 8]
    assert abs(found.offset - 0.005) < 1e-4
    assert "point 4: -0.02" in found.text()


def test_exact_data() -> None:
    found = check_offset(PLANE, points(5, 0.005, 0.0))
    assert found.offset == pytest.approx(0.005, abs=1e-15)
    assert not found.outliers.any()


def test_bad_input_is_refused() -> None:
    with pytest.raises(NotExcited, match="at least 3 points"):
        check_offset(PLANE, points(2, 0.0, 0.0))
    with pytest.raises(ShapeError, match="rows 1"):
        check_offset(PLANE, [[0, 0, 0], [0, np.inf, 0], [0, 0, 1]])
    with pytest.raises(ShapeError, match="Plane"):
        check_offset([0, 0, 1], points(5, 0.0, 0.0))


def test_noise_of_few_distances_is_not_flattered() -> None:
    squares = [check_offset(PLANE, points(4, 0.005, 1e-4, seed)).sigma ** 2 for seed in range(300)]
    assert np.mean(squares) == pytest.approx(1e-8, rel=0.15)
