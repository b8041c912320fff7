"""Movement primitives: demonstration and reproduction, phase plane, recovery with two degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.motion import Dmp, TwoDofRun
from armlab.plots.style import GREY, JOINT_STYLES, legend, line, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["dmp", "dmp_phase", "two_dof"]

_SAMPLES = 500


def dmp(dmp: Dmp, demo: tuple[ArrayLike, ArrayLike] | None = None, ax: Any = None) -> Figure:
    """Draw what a movement primitive does over time: position, velocity, forcing, kernels and weights.

    Parameters
    ----------
    dmp : the primitive. demo : times (N,) and positions (N, n) that it was taught, drawn dotted.
    ax : five Axes to draw into; a new figure when None.

    Returns
    -------
    The Figure.

    Raises
    ------
    ShapeError : a demonstration of another shape, or another number of Axes.
    """
    times = np.linspace(0.0, dmp.duration, _SAMPLES)
    run = dmp.rollout(times)
    x = run.x if run.x.ndim == 1 else run.x[:, 0]
    with look():
        figure, axes = panels(5, 1, ax, width=8.0, height=1.6, sharex=True)
        position, velocity, forcing, kernels, weights = axes[:, 0]
        for i in range(dmp.n):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            for panel, values in ((position, run.y), (velocity, run.yd), (forcing, run.forcing)):
                panel.plot(times, values[:, i], color=color, linestyle=style, label=f"y{i + 1}")
            weights.plot(_when(dmp), dmp.weights[:, i], ".", color=color, label="_")
        if demo is not None:
            _demonstration(dmp, demo, position, velocity)
        kernels.plot(times, dmp.kernels(x), color=GREY, linewidth=0.6)
        names = ("position [rad]", "velocity [rad/s]", "forcing [rad]", "kernels [1]", "weights [rad]")
        for panel, name in zip(axes[:, 0], names, strict=True):
            panel.set_ylabel(name)
        weights.set_xlabel("t [s]")
        figure.align_ylabels()
        legend(figure, position)
    return figure


def dmp_phase(dmp: Dmp, ax: Any = None) -> Axes:
    """Draw the phase plane of a movement primitive: velocity over position, from the start (o) to the goal (x).

    Parameters
    ----------
    dmp : the primitive. ax : Axes to draw into; a new figure when None.

    Returns
    -------
    The Axes.

    Raises
    ------
    ShapeError : another number of Axes.
    """
    run = dmp.rollout(np.linspace(0.0, 1.5 * dmp.duration, _SAMPLES))
    with look():
        figure, axes = panels(1, 1, ax, width=6.0, height=4.5)
        panel: Axes = axes[0, 0]
        for i in range(dmp.n):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            panel.plot(run.y[:, i], run.yd[:, i], color=color, linestyle=style, label=f"y{i + 1}")
            panel.plot(run.y[0, i], run.yd[0, i], "o", color=color, markersize=4.0, label="_")
            panel.plot(dmp.g[i], 0.0, "x", color=color, markersize=6.0, label="_")
        panel.set_xlabel("position [rad]")
        panel.set_ylabel("velocity [rad/s]")
        legend(figure, panel)
    return panel


def two_dof(run: TwoDofRun, dofs: Sequence[int] | None = None, ax: Any = None) -> Figure:
    """Draw how a primitive with two degrees of freedom is held up and recovers.

    Above the arm (line), the coupled path (dashed) and the primitive undisturbed (dotted), then the filtered error,
    then how many times slower the path runs. Where something moved the arm it is shaded.

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
    ShapeError : a coordinate that does not exist, or another number of Axes.
    """
    which = range(run.yc.shape[1]) if dofs is None else dofs
    if not all(isinstance(i, int | np.integer) and 0 <= i < run.yc.shape[1] for i in which):
        raise ShapeError(f"Expected dofs as numbers from 0 to {run.yc.shape[1] - 1}, got {list(which)}.")
    with look():
        figure, axes = panels(3, 1, ax, width=8.0, height=2.0, sharex=True)
        position, error, slower = axes[:, 0]
        for i in which:
            color, _ = JOINT_STYLES[i % len(JOINT_STYLES)]
            line(position, run.t, run.ya[:, i], color=color, label=f"arm y{i + 1}")
            line(position, run.t, run.yc[:, i], color=color, linestyle="--", label=f"path y{i + 1}")
            line(position, run.t, run.free.y[:, i], color=color, linestyle=":", label=f"undisturbed y{i + 1}")
            line(error, run.t, run.e[:, i], color=color, label="_")
        line(slower, run.t, run.tau_a / run.tau_a.min(), color=GREY, label="_")
        for panel, name in zip(axes[:, 0], ("position [rad]", "filtered error [rad]", "times slower [1]"), strict=True):
            for k, (t0, t1) in enumerate(run.disturbed):
                _mark(panel, t0, t1, "disturbed" if not k and panel is position else "_")
            panel.set_ylabel(name)
        slower.set_yscale("log")
        slower.set_xlabel("t [s]")
        figure.align_ylabels()
        legend(figure, position)
    return figure


def _mark(panel: Axes, t0: float, t1: float, label: str) -> None:
    if t1 > t0:
        panel.axvspan(t0, t1, color="#999999", alpha=0.25, linewidth=0.0, zorder=0, label=label)
    else:
        panel.axvline(t0, color="#999999", alpha=0.6, zorder=0, label=label)


def _when(dmp: Dmp) -> np.ndarray:
    """Return when the phase passes the centre of each kernel (n_basis,) [s]; for "position" as if it went evenly."""
    if dmp.schedule == "canonical":
        return -np.log(np.maximum(dmp.centres, 1e-12)) * dmp.tau_d / dmp.alpha_x
    share = dmp.centres if dmp.schedule == "time" else 1.0 - dmp.centres
    return share * dmp.duration


def _demonstration(dmp: Dmp, demo: tuple[ArrayLike, ArrayLike], position: Axes, velocity: Axes) -> None:
    t, y = (numbers(part, name, ShapeError) for part, name in zip(demo, ("demo times", "demo positions"), strict=True))
    if t.ndim != 1 or len(t) < 2 or y.shape != (len(t), dmp.n) or not (np.diff(t) > 0).all():
        raise ShapeError(
            f"Expected a demonstration as rising times (N,) and positions (N, {dmp.n}), got {t.shape} and {y.shape}."
        )
    for panel, values in ((position, y), (velocity, np.gradient(y, t, axis=0))):
        for i in range(dmp.n):
            label = "demonstration" if panel is position and not i else "_"
            line(panel, t - t[0], values[:, i], color="black", linestyle=":", label=label)
