"""What is not of the kind that a figure draws is refused by a sentence that says where the right one comes from."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.log import Table
from armlab.motion import ProMP
from armlab.plots.style import expect


def test_the_right_kind_passes_and_another_is_named() -> None:
    expect(Table(np.arange(2.0), {}), Table)
    with pytest.raises(ShapeError, match=r"Expected Table to draw, got 'run\.mcap'\. log\.read gives one\."):
        expect("run.mcap", Table)
    with pytest.raises(ShapeError, match=r"Expected ProMP to draw, got None\. motion\.fit_promp gives one\."):
        expect(None, ProMP)
