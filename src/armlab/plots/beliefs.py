"""What is believed of a contact over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.contact import Hypotheses
from armlab.glossary import label
from armlab.plots.arguments import expect
from armlab.plots.style import GREY, JOINT_STYLES, legend, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["hypotheses"]

_LEAST = 0.02  # largest probability below which a hypothesis is drawn with the others


def hypotheses(found: Hypotheses, ax: Any = None) -> Axes:
    """Draw the probability of each hypothesis over time, stacked to 1; a bar on top where a link is not excluded.

    Parameters
    ----------
    found : from `contact.hypotheses`.
    ax : Axes to draw into; a new figure when None.

    Raises
    ------
    ShapeError : something else in place of hypotheses, or several Axes.
    """
    expect(found, Hypotheses)
    with look():
        figure, axes = panels(1, 1, ax, width=10.0, height=2.8)
        panel: Axes = axes[0, 0]
        shown = found.posterior.max(axis=0) >= _LEAST
        parts = [found.posterior[:, i] for i in np.flatnonzero(shown)]
        names = [name for name, large in zip(found.names, shown) if large]
        colors = ["#D9D9D9" if name == "none" else JOINT_STYLES[i % 7][0] for i, name in enumerate(names)]
        if not shown.all():
            parts, names, colors = [*parts, found.posterior[:, ~shown].sum(axis=1)], [*names, "others"], [*colors, GREY]
        panel.stackplot(found.t, parts, labels=names, colors=colors, alpha=0.8, step="mid", linewidth=0)
        doubt = np.where(found.link, 0.985, np.nan)
        panel.plot(found.t, doubt, color="black", linewidth=3.0, marker="s", markersize=3.0, label="maybe on a link")
        panel.set_ylim(0.0, 1.0)
        panel.set_xlabel(label("t"))
        panel.set_ylabel("probability")
        legend(figure, panel)
    return panel
