"""How a movement primitive with two degrees of freedom waits for its arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.motion import TwoDofRun
from armlab.plots.arguments import expect
from armlab.plots.style import GREY, JOINT_STYLES, legend, line, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["two_dof"]


def two_dof(run: TwoDofRun, dofs: Sequence[int] | None = None, ax: Any = None) -> Figure:
    """Draw how a primitive with two degrees of freedom is held up and recovers.

    Above the arm ya (line), the coupled path yc (dashed) and the primitive undisturbed (dotted), then the filtered
    error e, then how many times slower the path runs. Where something moved the arm it is shaded.

    Parameters
    ----------
    run : of `TwoDofDmp.simulate` or `TwoDofDmp.recorded`.
    dofs : numbers of the coordinates from 0; all when None.
    ax : three Axes to draw into; a new figure when None.

    Returns
    -------
    The Figure.

    Raises
    ------
    ShapeError : no run, a coordinate that does not exist, or another number of Axes.
    """
    expect(run, TwoDofRun)
    which = range(run.yc.shape[1]) if dofs is None else dofs
    if not all(isinstance(i, int | np.integer) and 0 <= i < run.yc.shape[1] for i in which):
        raise ShapeError(f"Expected dofs as numbers from 0 to {run.yc.shape[1] - 1}, got {list(which)}.")
    with look():
        figure, axes = panels(3, 1, ax, width=8.0, height=2.0, sharex=True)
        position, error, slower = axes[:, 0]
        for i in which:
            color, _ = JOINT_STYLES[i % len(JOINT_STYLES)]
            line(position, run.t, run.free.y[:, i], color=color, linestyle=":", label="_")
            line(position, run.t, run.yc[:, i], color=color, linestyle="--", label="_")
            line(position, run.t, run.ya[:, i], color=color, label=f"y{i + 1}")
            line(error, run.t, run.e[:, i], color=color, label="_")
        for style, name in (("-", "arm ya"), ("--", "path yc"), (":", "undisturbed")):
            position.plot([], [], color=GREY, linestyle=style, label=name)
        line(slower, run.t, run.tau_a / run.tau_a.min(), color=GREY, label="_")
        for panel, name in zip(axes[:, 0], (label("y"), label("e"), "times slower [1]"), strict=True):
            for k, (t0, t1) in enumerate(run.disturbed):
                _mark(panel, t0, t1, "disturbed" if not k and panel is position else "_")
            panel.set_ylabel(name)
        slower.set_yscale("log", subs=[2, 5])
        slower.set_ylim(0.9, 1.2 * max(run.tau_a.max() / run.tau_a.min(), 2.0))
        for formatter in (slower.yaxis.set_major_formatter, slower.yaxis.set_minor_formatter):
            formatter("{x:g}")
        slower.set_xlabel(label("t"))
        figure.align_ylabels()
        legend(figure, position)
    return figure


def _mark(panel: Axes, t0: float, t1: float, name: str) -> None:
    if t1 > t0:
        panel.axvspan(t0, t1, color="#999999", alpha=0.25, linewidth=0.0, zorder=0, label=name)
    else:
        panel.axvline(t0, color="#999999", alpha=0.6, zorder=0, label=name)
