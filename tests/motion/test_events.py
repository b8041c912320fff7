"""Holds, pushes and blows: what they force, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion.disturbances import Displace, Hold, Push


def test_a_hold_is_a_push_without_speed() -> None:
    np.testing.assert_array_equal(Hold(0.0, 1.0).drive(3), 0.0)
    np.testing.assert_array_equal(Hold(0.0, 1.0, [1]).drive(3), [np.nan, 0.0, np.nan])
    assert isinstance(Hold(0, 1), Push)


def test_a_push_forces_the_coordinates_that_it_names() -> None:
    np.testing.assert_array_equal(Push(0, 1, 0.3).drive(2), 0.3)
    np.testing.assert_array_equal(Push(0, 1, [0.3, -1.0], (2, 0)).drive(3), [-1.0, np.nan, 0.3])


def test_a_blow_keeps_its_numbers() -> None:
    assert Displace(1.0, [0.1, 0.2]).dy == [0.1, 0.2]


@pytest.mark.parametrize(
    "misuse",
    [
        lambda: Hold(1.0, 1.0),
        lambda: Hold(np.nan, 1.0),
        lambda: Hold(0.0, np.inf),
        lambda: Push(0.0, 1.0, np.nan),
        lambda: Push(0.0, 1.0, "fast"),  # pyright: ignore[reportArgumentType]
        lambda: Hold(0.0, 1.0, [3]).drive(3),
        lambda: Hold(0.0, 1.0, [-1]).drive(3),
        lambda: Hold(0.0, 1.0, [0, 0]).drive(3),
        lambda: Hold(0.0, 1.0, []).drive(3),
        lambda: Hold(0.0, 1.0, [0.5]).drive(3),  # pyright: ignore[reportArgumentType]
        lambda: Push(0.0, 1.0, [1.0, 2.0]).drive(3),
        lambda: Displace(np.inf, 0.1),
        lambda: Displace(0.0, [0.1, np.nan]),
    ],
)
def test_bad_input_gets_a_sentence(misuse: Any) -> None:
    with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
        misuse()
