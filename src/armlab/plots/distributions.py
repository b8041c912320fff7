"""Probabilistic movement primitives: their mean and band, with what they were taught and pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers
from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.motion import ProMP
from armlab.plots.arguments import expect
from armlab.plots.primitives import demonstration
from armlab.plots.style import GREY, JOINT_STYLES, band, legend, line, look, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["promp"]

_SAMPLES = 301


def promp(
    promp: ProMP,
    demos: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    *,
    prior: ProMP | None = None,
    points: Sequence[tuple[float, ArrayLike]] = (),
    samples: int = 0,
    seed: int = 0,
    ax: Any = None,
) -> Figure:
    """Draw a distribution over motions, one panel per coordinate: mean, and a band of two standard deviations.

    Parameters
    ----------
    promp : the distribution.
    demos : times (N,) and positions (N, n) of each demonstration, drawn thin, stretched to the duration of `promp`.
    prior : distribution before it was conditioned, drawn grey. points : (t, y) that it passes, y (n,).
    samples : motions that are drawn from it, dotted. seed : of them.
    ax : n Axes to draw into; a new figure when None.

    Returns
    -------
    The Figure.

    Raises
    ------
    ShapeError : another kind of primitive; demonstrations, a prior or points of another shape; another number of Axes.
    """
    expect(promp, ProMP)
    t = np.linspace(0.0, promp.duration, _SAMPLES)
    marks = [(number(when, "time of a point [s]"), _point(y, promp.n)) for when, y in points]
    if prior is not None and prior.n != promp.n:
        raise ShapeError(f"Expected a prior of {promp.n} coordinates, got one of {prior.n}. Take the one conditioned.")
    with look():
        figure, axes = panels(promp.n, 1, ax, width=8.0, height=1.9, sharex=True)
        for demo in demos:
            times, y = demonstration(demo, promp.n)
            for i, panel in enumerate(axes[:, 0]):
                line(panel, times * promp.duration / times[-1], y[:, i], color=GREY, linewidth=0.4, label="_")
        if prior is not None:
            _draw(axes[:, 0], t, prior, ["#999999"] * promp.n, ("before", None))
        colors = [JOINT_STYLES[i % len(JOINT_STYLES)][0] for i in range(promp.n)]
        _draw(axes[:, 0], t, promp, colors, ("mean", "± 2 sd"))
        drawn = promp.sample(t, seed, samples) if samples else np.zeros((0, len(t), promp.n))
        for i, panel in enumerate(axes[:, 0]):
            for k, one in enumerate(drawn):
                panel.plot(t, one[:, i], color=colors[i], linewidth=0.7, linestyle=":", label="_" if k else "samples")
            for k, (when, y) in enumerate(marks):
                panel.plot(when, y[i], "o", color="black", markersize=4.0, label="_" if k else "points")
            panel.set_ylabel(label("y").replace("y ", f"y{i + 1} ", 1))
        if len(demos):
            axes[0, 0].plot([], [], color=GREY, linewidth=0.8, label="demonstrations")
        axes[-1, 0].set_xlabel(label("t"))
        figure.align_ylabels()
        legend(figure, axes[0, 0])
    return figure


def _draw(axes: np.ndarray, t: np.ndarray, promp: ProMP, colors: list[str], names: tuple[str, str | None]) -> None:
    """Draw mean and band of each coordinate."""
    motion = promp.marginal(t, duration=t[-1])
    for panel, color, mean, sd in zip(axes, colors, motion.y.T, motion.sd.T, strict=True):
        panel.plot(t, mean, color=color, label=names[0])
        band(panel, t, mean, 2.0 * sd, color=color, alpha=0.25, label=names[1] or "_")


def _point(y: ArrayLike, n: int) -> np.ndarray:
    point = np.atleast_1d(numbers(y, "point", ShapeError))
    if point.shape != (n,):
        raise ShapeError(f"Expected points y of shape ({n},), got {point.shape}. NaN leaves a coordinate out.")
    return point
