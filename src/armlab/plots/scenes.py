"""Anything with a place in space: named frames, paths of poses, points, lines, planes, circles, spheres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.frames import Circle, Line, Plane, Sphere
from armlab.lie import se3
from armlab.plots import features, space
from armlab.plots.style import JOINT_STYLES, look

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["pose_stack", "scene"]

_MOST_FRAMES = 12  # along one path
_MARKS = (("o", 8), ("^", 22), ("s", 14), ("D", 14))  # of one cloud after the other, with their areas
_NAMED = 0.15  # length of a named frame over the size of the scene, when none is given


def scene(*items: Any, frames: float = 0.0, ax: Any = None) -> Axes3D:
    """Draw frames, paths, points and features in one set of axes of equal scale [m].

    Parameters
    ----------
    *items : each is a mapping {name: T_a_x (4, 4)} of named frames; or poses (N, 4, 4), drawn as a path from a dot to
        a square; or points (N, 3), coloured from first to last, with other marks in each set; or a `frames.Line` with
        its foot where that is near, a `frames.Plane` as a patch with its normal, a `frames.Circle` or a
        `frames.Sphere`. All in the same frame a. NaN leaves a gap.
    frames : length [m] of the frames along paths (at most 12 of each, evenly spaced) and of the named ones. With 0
        paths have none, and the named ones a length that fits.
    ax : three-dimensional Axes to draw into, for example those of `robot`; a new figure when None.

    Returns
    -------
    The Axes.

    Raises
    ------
    ShapeError : an item is none of these, a pose has no rotation, `frames` is no length from 0 on, or `ax` is not
        three-dimensional.
    """
    size = numbers(frames, "frames", ShapeError)
    if size.ndim or not 0.0 <= size < np.inf:
        raise ShapeError(f"Expected frames to be one length from 0 on [m], got {frames!r}. 0 is the default.")
    frames = float(size)
    checked = [_checked(item) for item in items]
    with look():
        _, panel = space.space(ax)
        paths, clouds = 0, 0
        for item in checked:
            if not isinstance(item, np.ndarray):
                continue
            if item.ndim == 3:
                _path(panel, item, frames, JOINT_STYLES[paths % len(JOINT_STYLES)][0])
                paths += 1
            else:
                shown = item[np.isfinite(item).all(axis=1)]
                order = np.flatnonzero(np.isfinite(item).all(axis=1))
                mark, area = _MARKS[clouds % len(_MARKS)]
                panel.scatter(*shown.T, c=order, cmap="viridis", s=area, marker=mark, depthshade=False, gid="points")
                clouds += 1
        named = {name: T for item in checked if isinstance(item, dict) for name, T in item.items()}
        shapes = [item for item in checked if isinstance(item, (Line, Plane, Circle, Sphere))]
        size = _size(panel, named)
        for k, item in enumerate(shapes):
            features.feature(panel, item, size, JOINT_STYLES[(paths + k) % len(JOINT_STYLES)][0])
        length = frames or _NAMED * size
        for name, T in named.items():
            space.frame(panel, T, length, name)
        space.equal_scale(panel)
    return panel


def pose_stack(T: Any, name: str = "T") -> np.ndarray:
    """Return poses (N, 4, 4) as float64; NaN is a missing pose.

    Raises
    ------
    ShapeError : another shape, or a matrix that is no pose.
    """
    T = numbers(T, f"poses {name}", ShapeError)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise ShapeError(f"Expected poses {name} of shape (N, 4, 4), got {T.shape}.")
    wrong = np.flatnonzero(~(se3.is_pose(T) | np.isnan(T).any(axis=(1, 2))))
    if wrong.size:
        raise ShapeError(
            f"Expected poses in {name}, got a matrix at row {wrong[0]} whose rotation is none. "
            "Project it first if it is nearly one (lie.se3.project)."
        )
    return T


def _checked(item: Any) -> dict[str, np.ndarray] | np.ndarray | Line | Plane | Circle | Sphere:
    """Return named frames, poses (N, 4, 4), points (N, 3) or a feature."""
    if isinstance(item, (Line, Plane, Circle, Sphere)):
        return item
    if isinstance(item, Mapping):
        return {str(name): _named(T, name) for name, T in item.items()}
    array = numbers(item, "what is drawn", ShapeError)
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
    """Draw a path with its start, its end, and frames along it."""
    p = T[:, :3, 3]
    ax.plot(*p.T, color=color, linewidth=1.4, gid="path")
    there = np.flatnonzero(np.isfinite(T).all(axis=(1, 2)))
    for mark, k in zip("os", there[[0, -1]] if there.size else (), strict=False):
        ax.plot(*p[k : k + 1].T, marker=mark, color=color, markersize=5.0, gid="start" if mark == "o" else "end")
    if frames:
        for k in there[np.unique(np.linspace(0, there.size - 1, min(_MOST_FRAMES, there.size)).astype(int))]:
            space.frame(ax, T[k], frames, letters=False)


def _size(ax: Axes3D, named: dict[str, np.ndarray]) -> float:
    """Return the largest side of what is drawn and named [m]; 1 for a single place."""
    points = np.concatenate([space.extent(ax), *(T[None, :3, 3] for T in named.values())])
    points = points[np.isfinite(points).all(axis=1)]
    return float(np.ptp(points, axis=0).max(initial=0.0)) or 1.0 if len(points) else 1.0
