"""The operator's wrench is piecewise linear, and bad tables are refused by row."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.sim.events import AppliedWrench


def test_linear_between_rows_and_nothing_outside() -> None:
    wrench = np.zeros((3, 6))
    wrench[1] = [5, 0, 0, 0, 0.5, 0]
    operator = AppliedWrench(np.array([1.0, 1.5, 3.0]), wrench)
    assert operator.at(0.999) is None
    assert operator.at(3.001) is None
    np.testing.assert_allclose(operator.at(1.25), [2.5, 0, 0, 0, 0.25, 0])
    np.testing.assert_allclose(operator.at(1.5), wrench[1])
    np.testing.assert_allclose(operator.at(2.25), [2.5, 0, 0, 0, 0.25, 0])
    np.testing.assert_allclose(operator.at(1.0), wrench[0])
    np.testing.assert_allclose(operator.at(3.0), wrench[2])


def test_idle_never_touches() -> None:
    assert AppliedWrench.idle().at(0.0) is None


@pytest.mark.parametrize(
    ("t", "wrench", "text"),
    [
        ([0.0, 1.0], np.zeros((3, 6)), "one wrench per time"),
        ([0.0, 1.0], np.zeros((2, 5)), "one wrench per time"),
        ([0.0, np.nan], np.zeros((2, 6)), "row 2"),
        ([0.0, 1.0, 1.0], np.zeros((3, 6)), "row 3"),
    ],
)
def test_bad_tables(t: list[float], wrench: np.ndarray, text: str) -> None:
    with pytest.raises(ShapeError, match=text):
        AppliedWrench(np.array(t), wrench)
