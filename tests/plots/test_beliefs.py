"""`plots.hypotheses`: probabilities that stack to one."""

from __future__ import annotations

import numpy as np

from armlab.contact import Hypotheses
from armlab.plots import hypotheses


def test_probabilities_stack_to_one_and_doubt_is_marked() -> None:
    posterior = np.array([[0.99, 0.01, 0.0], [0.2, 0.795, 0.005], [0.0, 1.0, 0.0]])
    decision = ("none", "undecided", "point")
    found = Hypotheses(
        np.arange(3.0), ("none", "point", "wrench"), np.log(posterior + 1e-9), posterior, decision,
        np.array([False, True, False]), np.full(3, np.nan), np.ones(3),
    )  # fmt: skip
    ax = hypotheses(found)
    labels = ax.get_legend_handles_labels()[1]
    assert labels == ["none", "point", "others", "maybe on a link"]
    top = max(path.get_extents().y1 for area in ax.collections for path in area.get_paths())
    assert np.isclose(top, 1.0)
    assert np.isfinite(np.asarray(ax.lines[0].get_ydata())).tolist() == [False, True, False]
