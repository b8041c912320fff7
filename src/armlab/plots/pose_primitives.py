"""Movement primitives of poses over time, with what they were taught."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.lie import so3
from armlab.motion import PoseDmp
from armlab.plots.arguments import expect
from armlab.plots.primitives import TAUGHT
from armlab.plots.scenes import pose_stack
from armlab.plots.style import AXIS_COLORS, GREY, legend, line, look, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["pose_dmp"]

_SAMPLES = 501
_DASHES = ("-", "--", "-.")


def pose_dmp(dmp: PoseDmp, demo: tuple[ArrayLike, ArrayLike] | None = None, ax: Any = None) -> Figure:
    """Draw what a movement primitive of poses does over time: position, and rotation vector from the goal.

    Parameters
    ----------
    dmp : the primitive.
    demo : times (N,) and poses (N, 4, 4) that it was taught, drawn wide and grey; below, how far the motion is from
        them.
    ax : two Axes to draw into, four with a demonstration; a new figure when None.

    Returns
    -------
    The Figure.

    Raises
    ------
    ShapeError : another kind of primitive, a demonstration of another shape, or another number of Axes.
    """
    expect(dmp, PoseDmp)
    t, taught = (np.linspace(0.0, dmp.duration, _SAMPLES), None) if demo is None else _taught(demo)
    T = dmp.rollout(t).T
    with look():
        figure, axes = panels(2 if taught is None else 4, 1, ax, width=8.0, height=1.9, sharex=True)
        _draw(axes[:2, 0], t, T, dmp.T_goal, [{"linestyle": s, "label": n} for s, n in zip(_DASHES, "xyz")])
        names = ["position [m]", "rotation vector\nfrom the goal [rad]"]
        if taught is not None:
            _draw(axes[:2, 0], t, taught, dmp.T_goal, [TAUGHT | {"label": n} for n in ("demonstration", "_", "_")])
            line(axes[2, 0], t, np.linalg.norm(T[:, :3, 3] - taught[:, :3, 3], axis=1), color=GREY, label="_")
            line(axes[3, 0], t, so3.angle(T[:, :3, :3], taught[:, :3, :3]), color=GREY, label="_")
            names += ["distance off [m]", "angle off [rad]"]
        for panel, name in zip(axes[:, 0], names, strict=True):
            panel.set_ylabel(name)
        axes[-1, 0].set_xlabel(label("t"))
        figure.align_ylabels()
        legend(figure, axes[0, 0])
    return figure


def _draw(axes: np.ndarray, t: np.ndarray, T: np.ndarray, T_goal: np.ndarray, styles: list[dict[str, Any]]) -> None:
    """Draw x, y and z of position and of the rotation vector, base axes, that leads from the goal."""
    turned = so3.log(T[:, :3, :3] @ T_goal[:3, :3].T)
    for panel, values in zip(axes, (T[:, :3, 3], turned), strict=True):
        for i, style in enumerate(styles):
            line(panel, t, values[:, i], **{"color": AXIS_COLORS[i], **style})


def _taught(demo: tuple[ArrayLike, ArrayLike]) -> tuple[np.ndarray, np.ndarray]:
    t, T = numbers(demo[0], "demo times", ShapeError), pose_stack(demo[1])
    if t.shape != (len(T),) or len(t) < 2 or not (np.diff(t) > 0).all():
        raise ShapeError(
            f"Expected a demonstration as rising times (N,) and poses (N, 4, 4), got {t.shape} and {T.shape}."
        )
    return t - t[0], T
