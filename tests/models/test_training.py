"""The ranges of the training data are checked and frozen."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.models import SPEED_EDGES, Training


def ranges(**changes) -> Training:
    bins = 2 * len(SPEED_EDGES)
    fields = {
        "q_min": -np.ones(2),
        "q_max": np.ones(2),
        "qd_peak": np.ones(2),
        "speed_share": np.ones((2, bins)) / bins,
    }
    return Training(**{**fields, "rest_share": 0.1, "longest_rest": 0.5, **changes})


def test_ranges_are_frozen() -> None:
    with pytest.raises(ValueError, match="read-only"):
        ranges().qd_peak[0] = 2.0
    np.testing.assert_array_equal(np.diff(SPEED_EDGES) > 0, True)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"speed_share": np.ones((2, 4))}, r"speed_share of shape \(2, 12\) of the training, got \(2, 4\)"),
        ({"q_max": np.array([1.0, np.nan])}, "finite q_max"),
        ({"rest_share": 1.5}, "share of rest from 0 to 1"),
        ({"longest_rest": np.nan}, "length from 0 s"),
    ],
)
def test_others_are_refused(changes: dict, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        ranges(**changes)
