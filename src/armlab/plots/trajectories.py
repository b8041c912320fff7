"""Poses over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.lie import quaternion
from armlab.plots.scenes import pose_stack
from armlab.plots.style import AXIS_COLORS, legend, line, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["poses"]


def poses(T: ArrayLike, t: ArrayLike | None = None, *, rotation: bool = True, ax: Any = None) -> Axes | Figure:
    """Draw x, y and z of poses over time and, below, the rotation vector.

    The rotation vector starts with an angle of at most π and goes on without jumps until a full turn.

    Parameters
    ----------
    T : (N, 4, 4) poses; NaN leaves a gap.
    t : (N,) times [s]; the number of the sample when None.
    rotation : draw the rotation vector too.
    ax : Axes to draw into, two with `rotation`, else one; a new figure when None.

    Returns
    -------
    The Figure of both panels, or the Axes of the one.

    Raises
    ------
    ShapeError : T are not poses, t is not one finite time per pose, or `ax` has another number of Axes.
    """
    T = pose_stack(T)
    times = np.arange(len(T), dtype=float) if t is None else numbers(t, "t", ShapeError)
    if times.shape != (len(T),) or not np.isfinite(times).all():
        raise ShapeError(f"Expected one finite time per pose, {len(T)} in all, got t of shape {times.shape}.")
    drawn = [("position [m]", T[:, :3, 3])]
    if rotation:
        drawn.append(("rotation vector [rad]", _rotation_vectors(T[:, :3, :3])))
    with look():
        figure, axes = panels(len(drawn), 1, ax, width=8.0, height=2.2, sharex=True)
        for panel, (name, values) in zip(axes[:, 0], drawn, strict=True):
            for i, color in enumerate(AXIS_COLORS):
                line(panel, times, values[:, i], color=color, linestyle=("-", "--", "-.")[i], label="xyz"[i])
            panel.set_ylabel(name)
        axes[-1, 0].set_xlabel("sample" if t is None else label("t"))
        figure.align_ylabels()
        legend(figure, *axes[:, 0])
    return figure if rotation else axes[0, 0]


def _rotation_vectors(R: np.ndarray) -> np.ndarray:
    """Return rotation vectors (N, 3) of R (N, 3, 3), from continuous quaternions: angles up to 2π."""
    q = quaternion.continuous(quaternion.from_matrix(R))
    first = q[np.isfinite(q).all(axis=1)][:1]
    q = q * np.where(first[:, 0] < 0, -1.0, 1.0) if len(first) else q
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[:, :1])
    return q[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)
