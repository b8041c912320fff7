"""Lines, planes, circles and spheres in space."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armlab.frames import Circle, Line, Plane, Sphere
from armlab.plots import space

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["feature"]

_ROUND = np.linspace(0.0, 2.0 * np.pi, 73)
_PATCH = 0.5  # half side of a plane over the size of the scene
_NORMAL = 0.3  # length of a normal over the size of the scene


def feature(ax: Axes3D, item: Line | Plane | Circle | Sphere, size: float, color: str) -> None:
    """Draw a feature, as large as a scene of that size asks for.

    Parameters
    ----------
    ax : axes to draw into.
    item : a line gets its direction and, where it is near, its foot; a plane is a patch with its normal; a circle has a
        mark at its centre; a sphere is three great circles.
    size : largest side of the scene [m]; planes and lines have no size of their own.
    color : of all of it.
    """
    if isinstance(item, Line):
        start = item.centroid - 0.5 * size * item.v
        space.arrow(ax, start, size * item.v, color=color, gid="line")
        if np.linalg.norm(item.r - item.centroid) <= size:
            ax.plot(*item.r[:, None], marker="x", color=color, markersize=5.0, gid="foot")
    elif isinstance(item, Plane):
        corners = _PATCH * size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) @ item.axes
        space.solid(ax, (item.centroid + corners)[None], color, alpha=0.25, shade=False, zorder=1, gid="plane")
        space.arrow(ax, item.centroid, _NORMAL * size * item.n, color=color, gid="normal")
    elif isinstance(item, Circle):
        _ring(ax, item.centre, item.radius * item.axes, color)
        ax.plot(*item.centre[:, None], marker="+", color=color, markersize=6.0, gid="centre")
    else:
        for pair in ((0, 1), (1, 2), (2, 0)):
            _ring(ax, item.centre, item.radius * np.eye(3)[list(pair)], color)


def _ring(ax: Axes3D, centre: np.ndarray, axes: np.ndarray, color: str) -> None:
    points = centre + np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) @ axes
    ax.plot(*points.T, color=color, linewidth=1.2, gid="circle")
