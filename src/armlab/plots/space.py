"""Axes in three dimensions: equal scale, lettered frames, arrows, solids."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError
from armlab.plots.style import AXIS_COLORS, GREY

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["AHEAD", "AWAY", "PROJECTION", "arrow", "equal_scale", "extent", "frame", "solid", "space", "word"]

PROJECTION: dict[str, Any] = {"projection": "3d", "proj_type": "ortho", "elev": 20.0, "azim": -55.0}
"""For ``subplot_kw``: parallel projection, x to the right, y away from the eye, z up, as in a textbook."""
AWAY, AHEAD = (-0.3, -0.3, 0.0), (0.0, 0.0, 1.45)
"""Places of the name of a frame: beside it, away from x and y; or beyond z, where no arm comes from."""
_SOLID, _ARROW, _WORD = 5, 6, 7  # order of drawing; lines have 2
_EDGE = "#B0B0B0"  # as the grid of three dimensions
_FLATTEST = 0.3  # smallest side of the box over its largest: a planar robot still has a box
_HALF_SIDE = 0.0925  # of the axes on paper, in the units of matplotlib
_LABELS, _OFFSET = (20.0, 20.0, 24.0), 21.0  # distances of the names of axes in a cube; matplotlib's own
_ACROSS = ((0.0, 0.3, 0.7), (0.4, 0.0, 0.6), (0.6, 0.4, 0.0))  # parts of the sides in them, as `PROJECTION` sees them


def space(ax: Any = None, *, width: float = 6.4, height: float = 5.4) -> tuple[Figure, Axes3D]:
    """Return a figure and its three-dimensional axes in metres: new ones, or those the caller gave.

    Parameters
    ----------
    ax : three-dimensional Axes; None makes a new figure.
    width, height : of the figure, in inches.

    Raises
    ------
    ShapeError : the given Axes are flat, or several.
    """
    if ax is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(width, height))
        ax = figure.add_subplot(**PROJECTION)
    elif getattr(ax, "name", "") != "3d":
        kind = f"{np.size(ax)} in an array" if np.ndim(ax) else f"{getattr(ax, 'name', type(ax).__name__)} Axes"
        raise ShapeError(f'Expected one Axes with projection="3d" in ax=, got {kind}.')
    ax.computed_zorder = False  # matplotlib would put solids above the words on them
    for axis, letter in zip((ax.xaxis, ax.yaxis, ax.zaxis), "xyz", strict=True):
        axis.pane.set_alpha(None)
        axis.pane.set(closed=True, facecolor=(1.0, 1.0, 1.0, 0.0), edgecolor=_EDGE, linewidth=0.6)
        axis.line.set_color(GREY)
        axis.set_label_text(f"{letter} [m]")
        axis.set_tick_params(pad=1.0 if letter == "z" else -1.0)
    return ax.figure, ax


def extent(ax: Axes3D) -> np.ndarray:
    """Return the lowest and the highest corner (2, 3) of everything drawn so far; NaN while there is nothing."""
    if not ax.has_data():
        return np.full((2, 3), np.nan)
    return np.stack([*ax.xy_dataLim.get_points().T, ax.zz_dataLim.get_points()[:, 0]], axis=-1)


def equal_scale(ax: Axes3D, part: float = 0.84, ticks: int = 7) -> None:
    """Give the three axes one scale and room for everything drawn so far.

    Parameters
    ----------
    ax : axes with something in them.
    part : of the panel that the box fills; the rest is for labels.
    ticks : most intervals along the longest side.
    """
    from matplotlib.ticker import MaxNLocator, MultipleLocator
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    low, high = extent(ax)
    if not np.isfinite([low, high]).all():
        return
    largest = max(float((high - low).max()), 1e-6)
    span = np.maximum(high - low, _FLATTEST * largest) + 0.04 * largest
    middle = (low + high) / 2
    step = float(np.diff(MaxNLocator(ticks, steps=[1, 2, 5, 10]).tick_values(0.0, float(span.max())))[0])
    for i, letter in enumerate("xyz"):
        axis: Any = getattr(ax, f"{letter}axis")
        ax.set(**{f"{letter}lim": (middle[i] - span[i] / 2, middle[i] + span[i] / 2)})
        axis.set_major_locator(MultipleLocator(step))
        axis.labelpad = _LABELS[i] / (np.dot(_ACROSS[i], span) / span.max()) - _OFFSET
    ax.set_box_aspect(tuple(span))
    corners = middle + span / 2 * np.array(list(product((-1, 1), repeat=3)))
    x, y, _ = proj_transform(corners[:, 0], corners[:, 1], corners[:, 2], ax.get_proj())
    ax.set_box_aspect(tuple(span), zoom=part * _HALF_SIDE / np.abs([x, y]).max())


def frame(
    ax: Axes3D, T: np.ndarray, length: float, name: str = "", *, letters: bool = True, place: ArrayLike = AWAY
) -> None:
    """Draw a frame: x, y and z as arrows in their colours, lettered, and its name.

    Parameters
    ----------
    ax : axes to draw into.
    T : (4, 4) pose of the frame in the axes of the figure.
    length : of each arrow [m].
    name : of the frame.
    letters : write x, y, z at the ends; without, they are plain lines.
    place : (3,) of the name, in the frame and in lengths of an arrow.
    """
    p, R = T[:3, 3], T[:3, :3]
    for i, color in enumerate(AXIS_COLORS):
        arrow(ax, p, length * R[:, i], color=color, arrowstyle="-|>" if letters else "-", gid=f"{name}.{'xyz'[i]}")
        if letters:
            word(ax, p + 1.17 * length * R[:, i], "xyz"[i], color=color, fontsize=7.5)
    if name:
        word(ax, p + length * (R @ np.asarray(place)), name)


def arrow(ax: Axes3D, start: np.ndarray, along: np.ndarray, **style: Any) -> None:
    """Draw an arrow from `start` to `start + along`, both (3,) [m]; its head has one size on paper."""
    _include(ax, np.stack([start, start + along]))
    ax.add_patch(_arrow_class()(start, start + along, **style))


def word(ax: Axes3D, place: np.ndarray, text: str, **style: Any) -> None:
    """Write a word centred at a place (3,) with a white rim, readable on top of lines."""
    from matplotlib.patheffects import withStroke

    rim = [withStroke(linewidth=2.0, foreground="white")]
    defaults = {"fontsize": 8.5, "ha": "center", "va": "center", "zorder": _WORD, "path_effects": rim}
    x, y, z = place
    _include(ax, np.asarray(place, dtype=float)[None])
    ax.text(x, y, z, text, **{**defaults, **style})


def solid(ax: Axes3D, faces: np.ndarray, color: Any, **style: Any) -> None:
    """Draw lit faces (N, corners, 3) [m].

    Parameters
    ----------
    ax : axes to draw into.
    faces : (N, corners, 3) corners of each face [m].
    color : one colour, or one per face.
    style : passed to ``Poly3DCollection``.
    """
    from matplotlib.colors import LightSource, to_rgba_array
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    colors = np.broadcast_to(to_rgba_array(color), (len(faces), 4))
    style = {"shade": True, "lightsource": LightSource(azdeg=225, altdeg=45), "zorder": _SOLID, **style}
    _include(ax, faces.reshape(-1, 3))
    ax.add_collection3d(Poly3DCollection(faces, facecolors=colors, linewidths=0.0, **style))


def _include(ax: Axes3D, points: np.ndarray) -> None:
    """Count points (N, 3) as drawn, before they are: matplotlib does it for lines and clouds only."""
    ax.auto_scale_xyz(points[:, 0], points[:, 1], points[:, 2], had_data=ax.has_data())


@cache
def _arrow_class() -> type:
    """Return the class of arrows in space: matplotlib has flat ones only."""
    from matplotlib.patches import FancyArrowPatch
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    class Arrow(FancyArrowPatch):
        """A flat arrow whose ends follow two points (2, 3) of space."""

        def __init__(self, start: np.ndarray, end: np.ndarray, **style: Any) -> None:
            look = {"arrowstyle": "-|>", "mutation_scale": 8.0, "linewidth": 1.4, "zorder": _ARROW}
            super().__init__((0, 0), (1, 1), shrinkA=0.0, shrinkB=0.0, **{**look, **style})
            self.ends = np.stack([start, end])

        def do_3d_projection(self, renderer: Any = None) -> float:
            axes: Any = self.axes
            x, y, depth = proj_transform(self.ends[:, 0], self.ends[:, 1], self.ends[:, 2], axes.M)
            self.set_positions((x[0], y[0]), (x[1], y[1]))
            return float(np.min(depth))

    return Arrow
