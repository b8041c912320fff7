"""`plots.excitation`: singular values, and where they are too small."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.estimation import Excitation
from armlab.plots.model import excitation

NAMES = ("mass", "offset", "gain")


def test_the_points_are_the_singular_values_relative_to_the_strongest() -> None:
    rng = np.random.default_rng(1)
    found = Excitation.of(rng.normal(size=(50, 3)) @ np.array([[1, 0, 0.999], [0, 1, 0], [0, 0, 0.05]]), NAMES)
    ax = excitation(found)
    points, weak, refused = ax.lines
    assert np.array_equal(points.get_xdata(), [1, 2, 3])
    assert np.asarray(points.get_ydata()) == pytest.approx(found.singular_values / found.singular_values[0])
    assert np.asarray(weak.get_ydata())[0] == pytest.approx(1 / 300)
    assert np.asarray(refused.get_ydata())[0] == pytest.approx(1e-4)
    assert ax.get_yscale() == "log"
    assert ax.get_xlabel() == "direction"
    assert [text.get_text() for text in ax.texts] == ["weak below", "refused below"]
    assert found.weakest in ax.get_title(loc="left")


def test_without_values_it_is_refused() -> None:
    with pytest.raises(ShapeError, match="singular values"):
        excitation(Excitation(0, 0, np.zeros(0), "none"))
    with pytest.raises(ShapeError, match="above zero"):
        excitation(Excitation(0, 2, np.zeros(2), "none"))
