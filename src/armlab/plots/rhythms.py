"""Periodic movement primitives over one turn and over several."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number
from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.motion import PeriodicDmp
from armlab.plots.arguments import expect
from armlab.plots.primitives import demonstration
from armlab.plots.style import GREY, JOINT_STYLES, legend, look, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["periodic_dmp"]

_SAMPLES = 500  # of a turn
_MOST = 2000  # samples of a demonstration
_TICKS = {0.0: "0", np.pi / 2: "π/2", np.pi: "π", 3 * np.pi / 2: "3π/2", 2 * np.pi: "2π"}


def periodic_dmp(
    dmp: PeriodicDmp, demo: tuple[ArrayLike, ArrayLike] | None = None, turns: float = 3.0, ax: Any = None
) -> Figure:
    """Draw a periodic movement primitive: position, forcing and kernels over one turn, then several turns over time.

    The last panel begins at rest on the baseline (dashed): the motion is soon that of the panels above.

    Parameters
    ----------
    dmp : the primitive. demo : times (N,) and positions (N, n) that it was taught, phase 0 at the first; drawn as dots.
    turns : periods of the last panel. ax : four Axes to draw into; a new figure when None.

    Returns
    -------
    The Figure.

    Raises
    ------
    ShapeError : another kind of primitive, a demonstration of another shape, no turns above zero, another number of
        Axes.
    """
    expect(dmp, PeriodicDmp)
    if not 0.0 < number(turns, "turns") < np.inf:
        raise ShapeError(f"Expected turns above zero, got {turns:g}. Three show the rhythm.")
    phi = 2 * np.pi / _SAMPLES * np.arange(_SAMPLES + 1)
    once = dmp.rollout(phi * dmp.period / (2 * np.pi))
    t = np.linspace(0.0, turns * dmp.period, round(_SAMPLES * turns) + 1)
    begun = dmp.rollout(t, y0=dmp.g, v0=np.zeros(dmp.n))
    with look():
        figure, axes = panels(4, 1, ax, width=8.0, height=1.9)
        position, forcing, kernels, several = axes[:, 0]
        if demo is not None:
            _draw_dots(dmp, demo, position)
        for i in range(dmp.n):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            position.plot(phi, once.y[:, i], color=color, linestyle=style, label=f"y{i + 1}")
            forcing.plot(phi, once.forcing[:, i], color=color, linestyle=style, label="_")
            several.plot(t, begun.y[:, i], color=color, linestyle=style, label="_")
            several.axhline(dmp.g[i], color=color, linestyle="--", linewidth=0.7, label="_")
        kernels.plot(phi, dmp.primitive_from().basis(phi), color=GREY, linewidth=0.7, label="_")
        names = (label("y"), label("forcing"), "kernels [1]", label("y"))
        for panel, name in zip(axes[:, 0], names, strict=True):
            panel.set_ylabel(name)
        for panel in axes[:3, 0]:
            panel.set_xticks(list(_TICKS), list(_TICKS.values()))
        kernels.set_xlabel(label("phi"))
        several.set_xlabel(label("t"))
        figure.align_ylabels()
        legend(figure, position)
    return figure


def _draw_dots(dmp: PeriodicDmp, demo: tuple[ArrayLike, ArrayLike], position: Any) -> None:
    t, y = demonstration(demo, dmp.n)
    every = max(1, len(t) // _MOST)
    phi = 2 * np.pi * np.mod(t[::every] / dmp.period, 1.0)
    for i in range(dmp.n):
        name = "demonstration" if not i else "_"
        position.plot(phi, y[::every, i], ".", color="#999999", markersize=2.5, label=name)
