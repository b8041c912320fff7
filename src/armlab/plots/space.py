"""3D axes and their contents: frames, pose paths, points, lines, planes, spheres."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import AXIS_COLORS, GREY
from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.frames import Line, Plane
from armlab.frames.features import Circle, Sphere
from armlab.lie import se3
from armlab.plots.style import JOINT_STYLES, look

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

PROJECTION: dict[str, Any] = {"projection": "3d", "proj_type": "ortho", "elev": 20.0, "azim": -55.0}
"""Arguments for ``subplot_kw``: parallel projection with x to the right, y away from the viewer and z up."""
AWAY, AHEAD = (-0.3, -0.3, 0.0), (0.0, 0.0, 1.45)
"""Label positions in the axes of a frame: away from x and y, or beyond z to avoid the arm."""
_SOLID, _ARROW, _WORD = 5, 6, 7  # z-order; lines have 2
_EDGE = "#B0B0B0"  # grid colour of 3D axes
_FLATTEST = 0.3  # minimum ratio of the shortest to the longest box side, for planar robots
_HALF_SIDE = 0.0925  # half side of the axes in the figure, in matplotlib units
_LABELS, _OFFSET = (20.0, 20.0, 24.0), 21.0  # label distances for a cubic box, and matplotlib's default distance
_ACROSS = ((0.0, 0.3, 0.7), (0.4, 0.0, 0.6), (0.6, 0.4, 0.0))  # scaling of these distances with the sides of the box


def space(ax: Any = None) -> tuple[Figure, Axes3D]:
    """Return a new figure, or that of the caller's Axes, and its 3D axes in metres."""
    if ax is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(6.4, 5.4))
        ax = figure.add_subplot(**PROJECTION)
    elif getattr(ax, "name", "") != "3d":
        kind = f"{np.size(ax)} in an array" if np.ndim(ax) else f"{getattr(ax, 'name', type(ax).__name__)} Axes"
        raise ShapeError(f'Expected one Axes with projection="3d" in ax=, got {kind}.')
    ax.computed_zorder = False  # matplotlib would draw solids on top of their labels
    for axis, letter in zip((ax.xaxis, ax.yaxis, ax.zaxis), "xyz", strict=True):
        axis.pane.set_alpha(None)
        axis.pane.set(closed=True, facecolor=(1.0, 1.0, 1.0, 0.0), edgecolor=_EDGE, linewidth=0.6)
        axis.line.set_color(GREY)
        axis.set_label_text(f"{letter} [m]")
        axis.set_tick_params(pad=1.0 if letter == "z" else -1.0)
    return ax.figure, ax


def extent(ax: Axes3D) -> np.ndarray:
    """Return the lowest and highest corners (2, 3) of all items drawn so far; NaN for empty axes."""
    if not ax.has_data():
        return np.full((2, 3), np.nan)
    return np.stack([*ax.xy_dataLim.get_points().T, ax.zz_dataLim.get_points()[:, 0]], axis=-1)


def equal_scale(ax: Axes3D, part: float = 0.84, ticks: int = 7) -> None:
    """Set equal scales on all three axes, with room for all items; the box fills the fraction `part` of the axes."""
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
    """Draw a frame with pose T (4, 4): coloured arrows of the given length [m], labelled x, y and z, and its name.

    `place`: position (3,) of the name in the frame, in arrow lengths.
    """
    p, R = T[:3, 3], T[:3, :3]
    for i, color in enumerate(AXIS_COLORS):
        arrow(ax, p, length * R[:, i], color=color, arrowstyle="-|>" if letters else "-", gid=f"{name}.{'xyz'[i]}")
        if letters:
            word(ax, p + 1.17 * length * R[:, i], "xyz"[i], color=color, fontsize=7.5)
    if name:
        word(ax, p + length * (R @ np.asarray(place)), name)


def arrow(ax: Axes3D, start: np.ndarray, along: np.ndarray, **style: Any) -> None:
    """Draw an arrow from `start` to `start + along`, both (3,) [m], whose head has a fixed size in the figure."""
    _include(ax, np.stack([start, start + along]))
    ax.add_patch(_arrow_class()(start, start + along, **style))


def word(ax: Axes3D, place: np.ndarray, text: str, **style: Any) -> None:
    """Write text centred at a position (3,), with a white outline to keep it readable on top of lines."""
    from matplotlib.patheffects import withStroke

    rim = [withStroke(linewidth=2.0, foreground="white")]
    defaults = {"fontsize": 8.5, "ha": "center", "va": "center", "zorder": _WORD, "path_effects": rim}
    x, y, z = place
    _include(ax, np.asarray(place, dtype=float)[None])
    ax.text(x, y, z, text, **{**defaults, **style})


def solid(ax: Axes3D, faces: np.ndarray, color: Any, **style: Any) -> None:
    """Draw shaded faces (N, corners, 3) [m]."""
    from matplotlib.colors import LightSource, to_rgba_array
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    colors = np.broadcast_to(to_rgba_array(color), (len(faces), 4))
    style = {"shade": True, "lightsource": LightSource(azdeg=225, altdeg=45), "zorder": _SOLID, **style}
    _include(ax, faces.reshape(-1, 3))
    ax.add_collection3d(Poly3DCollection(faces, facecolors=colors, linewidths=0.0, **style))


def _include(ax: Axes3D, points: np.ndarray) -> None:
    """Include points (N, 3) in the axes extent; matplotlib does this only for lines and point clouds."""
    ax.auto_scale_xyz(points[:, 0], points[:, 1], points[:, 2], had_data=ax.has_data())


@cache
def _arrow_class() -> type:
    """Return a class for 3D arrows, because matplotlib has only planar arrows."""
    from matplotlib.patches import FancyArrowPatch
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    class Arrow(FancyArrowPatch):
        """Planar arrow between two 3D points (2, 3)."""

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


_ROUND = np.linspace(0.0, 2.0 * np.pi, 73)
_PATCH = 0.5  # half side of a plane, relative to the size of the scene
_NORMAL = 0.3  # length of a normal vector, relative to the size of the scene


def feature(ax: Axes3D, item: Line | Plane | Circle | Sphere, size: float, color: str) -> None:
    """Draw a feature. Planes and lines are unbounded, so they are drawn at the size of the scene [m]."""
    if isinstance(item, Line):
        start = item.centroid - 0.5 * size * item.v
        arrow(ax, start, size * item.v, color=color, gid="line")
        if np.linalg.norm(item.r - item.centroid) <= size:
            ax.plot(*item.r[:, None], marker="x", color=color, markersize=5.0, gid="foot")
    elif isinstance(item, Plane):
        corners = _PATCH * size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) @ item.axes
        solid(ax, (item.centroid + corners)[None], color, alpha=0.25, shade=False, zorder=1, gid="plane")
        arrow(ax, item.centroid, _NORMAL * size * item.n, color=color, gid="normal")
    elif isinstance(item, Circle):
        _ring(ax, item.centre, item.radius * item.axes, color)
        ax.plot(*item.centre[:, None], marker="+", color=color, markersize=6.0, gid="centre")
    else:
        for pair in ((0, 1), (1, 2), (2, 0)):
            _ring(ax, item.centre, item.radius * np.eye(3)[list(pair)], color)


def _ring(ax: Axes3D, centre: np.ndarray, axes: np.ndarray, color: str) -> None:
    points = centre + np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) @ axes
    ax.plot(*points.T, color=color, linewidth=1.2, gid="circle")


_MOST_FRAMES = 12  # maximum number of frames per path
_MARKS = (("o", 8), ("^", 22), ("s", 14), ("D", 14))  # markers of successive point sets, with their areas
_NAMED = 0.15  # default length of a named frame, relative to the size of the scene


def scene(*items: Any, frames: float = 0.0, ax: Any = None) -> Axes3D:
    """Draw frames, paths, points and features in common 3D axes with equal scales [m].

    Parameters
    ----------
    *items : a mapping {name: T_a_x (4, 4)} of named frames; poses (N, 4, 4), drawn as a path from a dot to a square;
        points (N, 3), coloured from first to last, with a different marker per set; a `frames.Line`, with its foot
        point if nearby; a `frames.Plane`, drawn as a patch with its normal; a circle or a sphere. All items must be in
        the same frame a. NaN leaves a gap.
    frames : length [m] of the named frames and of the frames along paths (at most 12 per path, evenly spaced). With 0,
        no frames are drawn along paths, and named frames get a suitable length.
    ax : 3D Axes to draw into, for example from `robot`; default: a new figure.

    Raises
    ------
    ShapeError : an item has another type, a pose is invalid, `frames` is negative, or `ax` is not three-dimensional.
    """
    size = numbers(frames, "frames", ShapeError)
    if size.ndim or not 0.0 <= size < np.inf:
        raise ShapeError(f"Expected frames to be a length >= 0 m, got {frames!r}. The default is 0.")
    frames = float(size)
    checked = [_checked(item) for item in items]
    with look():
        _, panel = space(ax)
        paths, clouds = 0, 0
        for item in checked:
            if not isinstance(item, np.ndarray):
                continue
            if item.ndim == 3:
                _path(panel, item, frames, JOINT_STYLES[paths % len(JOINT_STYLES)][0])
                paths += 1
            else:
                order = np.flatnonzero(np.isfinite(item).all(axis=1))
                mark, area = _MARKS[clouds % len(_MARKS)]
                style = {"cmap": "viridis", "s": area, "marker": mark, "depthshade": False, "gid": "points"}
                panel.scatter(*item[order].T, c=order, **style)
                clouds += 1
        named = {name: T for item in checked if isinstance(item, dict) for name, T in item.items()}
        shapes = [item for item in checked if isinstance(item, (Line, Plane, Circle, Sphere))]
        size = _size(panel, named)
        for k, item in enumerate(shapes):
            feature(panel, item, size, JOINT_STYLES[(paths + k) % len(JOINT_STYLES)][0])
        length = frames or _NAMED * size
        for name, T in named.items():
            frame(panel, T, length, name)
        equal_scale(panel)
    return panel


def pose_stack(T: Any, name: str = "T") -> np.ndarray:
    """Return poses (N, 4, 4) as float64; missing poses are NaN."""
    T = numbers(T, f"poses {name}", ShapeError)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise ShapeError(f"Expected poses {name} of shape (N, 4, 4), got {T.shape}.")
    wrong = np.flatnonzero(~(se3.is_pose(T) | np.isnan(T).any(axis=(1, 2))))
    if wrong.size:
        raise ShapeError(
            f"Expected poses in {name}, got a matrix without a valid rotation in row {wrong[0]}. "
            "Use lie.se3.project to correct a rounded rotation."
        )
    return T


def _checked(item: Any) -> dict[str, np.ndarray] | np.ndarray | Line | Plane | Circle | Sphere:
    """Return validated named frames, poses (N, 4, 4), points (N, 3) or a feature."""
    if isinstance(item, (Line, Plane, Circle, Sphere)):
        return item
    if isinstance(item, Mapping):
        return {str(name): _named(T, name) for name, T in item.items()}
    array = numbers(item, "an item to draw", ShapeError)
    if array.ndim == 3:
        return pose_stack(array)
    if array.ndim == 2 and array.shape[1] == 3:
        return array
    hint = " Transpose it." if array.ndim == 2 and array.shape[0] == 3 else ""
    raise ShapeError(
        f"Expected {{name: pose}}, poses (N, 4, 4), points (N, 3) or a feature to draw, got {array.shape}.{hint}"
    )


def _named(T: Any, name: Any) -> np.ndarray:
    T = numbers(T, f"the pose of {name!r}", ShapeError)
    if T.shape != (4, 4):
        raise ShapeError(f"Expected the pose of {name!r} of shape (4, 4), got {T.shape}.")
    return pose_stack(T[None], repr(name))[0]


def _path(ax: Axes3D, T: np.ndarray, frames: float, color: str) -> None:
    """Draw a path with its start, end and frames."""
    p = T[:, :3, 3]
    ax.plot(*p.T, color=color, linewidth=1.4, gid="path")
    there = np.flatnonzero(np.isfinite(T).all(axis=(1, 2)))
    for mark, k in zip("os", there[[0, -1]] if there.size else (), strict=False):
        ax.plot(*p[k : k + 1].T, marker=mark, color=color, markersize=5.0, gid="start" if mark == "o" else "end")
    if frames:
        for k in there[np.unique(np.linspace(0, there.size - 1, min(_MOST_FRAMES, there.size)).astype(int))]:
            frame(ax, T[k], frames, letters=False)


def _size(ax: Axes3D, named: dict[str, np.ndarray]) -> float:
    """Return the largest side of the scene [m]; 1 for a single point."""
    points = np.concatenate([extent(ax), *(T[None, :3, 3] for T in named.values())])
    points = points[np.isfinite(points).all(axis=1)]
    return float(np.ptp(points, axis=0).max(initial=0.0)) or 1.0 if len(points) else 1.0
