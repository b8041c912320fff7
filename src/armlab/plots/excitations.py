"""What a log could tell: the singular values of its regressor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ShapeError
from armlab.estimation import Excitation
from armlab.plots.arguments import expect
from armlab.plots.style import GREY, JOINT_STYLES, MODEL, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["excitation"]

_WEAK, _REFUSED = 300.0, 1e4  # condition numbers of the estimators


def excitation(found: Excitation, ax: Any = None) -> Axes:
    """Draw the singular values of the scaled regressor, strongest first, each relative to the strongest.

    A direction below 1/300 is weak: it needs a longer or richer log. Below 1/10000 a fit is refused.

    Parameters
    ----------
    found : of a fit, ``fit.excitation``.
    ax : Axes to draw into; a new figure when None.

    Raises
    ------
    ShapeError : something else in place of an excitation; there are no singular values, or none above zero.
    """
    expect(found, Excitation)
    values = found.singular_values
    if not len(values) or not values[0] > 0:
        raise ShapeError(f"Expected singular values above zero to draw, got {len(values)} values. Take those of a fit.")
    relative = np.where(values > 0, values / values[0], np.nan)
    with look():
        _, axes = panels(1, 1, ax, width=7.5, height=3.2)
        panel: Axes = axes[0, 0]
        panel.semilogy(np.arange(1, len(values) + 1), relative, "o-", color=JOINT_STYLES[0][0], markersize=3.5)
        for condition, color, words in ((_WEAK, GREY, "weak below"), (_REFUSED, MODEL, "refused below")):
            panel.axhline(1 / condition, color=color, linestyle="--")
            panel.text(1, 1.1 / condition, words, color=color, fontsize=8.0, va="bottom")
        panel.set_xlabel("direction")
        panel.set_ylabel("singular value, relative")
        panel.set_title(f"condition {found.condition:.0f}; weakest: {found.weakest}", wrap=True)
    return panel
