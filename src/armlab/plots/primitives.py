"""Movement primitives over time, with what they were taught, and their phase plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers
from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.motion import Dmp, Rollout
from armlab.plots.arguments import expect
from armlab.plots.style import GREY, JOINT_STYLES, legend, line, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["TAUGHT", "demonstration", "dmp", "dmp_phase"]

TAUGHT: dict[str, Any] = {"color": "#BFBFBF", "linewidth": 3.5, "zorder": 1}
"""Look of demonstrations: wide, below the motion."""
_SAMPLES = 501
_SETTLES = 1.5  # durations that are drawn where the motion goes on after its end
Goals = Sequence[tuple[float, ArrayLike]]


def dmp(dmp: Dmp, demo: tuple[ArrayLike, ArrayLike] | None = None, goals: Goals = (), ax: Any = None) -> Figure:
    """Draw what a movement primitive does over time: position, velocity, forcing, kernels with the phase, weights.

    Parameters
    ----------
    dmp : the primitive. demo : times (N,) and positions (N, n) that it was taught, drawn wide and grey.
    goals : (t, g) of goals (n,) for which it goes from a time on [s]; every goal is drawn dashed.
    ax : five Axes to draw into; a new figure when None.

    Returns
    -------
    The Figure.

    Raises
    ------
    ShapeError : another kind of primitive, a demonstration or goal of another shape, or another number of Axes.
    """
    expect(dmp, Dmp)
    run, steps = _run(dmp, goals)
    with look():
        figure, axes = panels(5, 1, ax, width=8.0, height=1.6, sharex=True)
        position, velocity, forcing, kernels, weights = axes[:, 0]
        for i in range(dmp.n):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            for panel, values in ((position, run.y), (velocity, run.yd), (forcing, run.forcing)):
                panel.plot(run.t, values[:, i], color=color, linestyle=style, label=f"y{i + 1}")
            weights.plot(_when(dmp), dmp.weights[:, i], ".", color=color, markersize=4.0, label="_")
            if len(steps[0]) > 1:
                position.step(*(steps[0], steps[1][:, i]), where="post", color=color, linestyle="--", linewidth=0.7)
        if len(steps[0]) > 1:
            position.plot([], [], color=GREY, linestyle="--", linewidth=0.7, label="goal")
        if demo is not None:
            _demonstration(dmp, demo, position, velocity)
        x = run.x if run.x.ndim == 2 else run.x[:, None]
        kernels.plot(run.t, dmp.kernels(x[:, 0]), color=GREY, linewidth=0.5, alpha=0.6, label="_")
        for i in range(x.shape[1]):
            color = "black" if run.x.ndim == 1 else JOINT_STYLES[i % len(JOINT_STYLES)][0]
            kernels.plot(run.t, x[:, i], color=color, linewidth=1.4, label="phase x" if not i else "_")
        names = (label("y"), label("yd"), label("forcing"), "kernels, x [1]", label("weights"))
        for panel, name in zip(axes[:, 0], names, strict=True):
            panel.set_ylabel(name)
        weights.set_xlabel(label("t"))
        figure.align_ylabels()
        legend(figure, position, kernels)
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
    ShapeError : another kind of primitive, or another number of Axes.
    """
    expect(dmp, Dmp)
    run = dmp.rollout(np.linspace(0.0, _SETTLES * dmp.duration, _SAMPLES))
    with look():
        figure, axes = panels(1, 1, ax, width=6.0, height=4.5)
        panel: Axes = axes[0, 0]
        for i in range(dmp.n):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            panel.plot(run.y[:, i], run.yd[:, i], color=color, linestyle=style, label=f"y{i + 1}")
            panel.plot(run.y[0, i], run.yd[0, i], "o", color=color, markersize=4.0, label="_")
            panel.plot(dmp.g[i], 0.0, "x", color=color, markersize=6.0, label="_")
        panel.set_xlabel(label("y"))
        panel.set_ylabel(label("yd"))
        legend(figure, panel)
    return panel


def demonstration(demo: tuple[ArrayLike, ArrayLike], n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) from 0 and positions (N, n) of a demonstration.

    Parameters
    ----------
    demo : times and positions. n : number of coordinates.

    Raises
    ------
    ShapeError : another shape, times that do not rise.
    """
    t, y = (numbers(part, name, ShapeError) for part, name in zip(demo, ("demo times", "demo positions"), strict=True))
    if t.ndim != 1 or len(t) < 2 or y.shape != (len(t), n) or not (np.diff(t) > 0).all():
        raise ShapeError(
            f"Expected a demonstration as rising times (N,) and positions (N, {n}), got {t.shape} and {y.shape}."
        )
    return t - t[0], y


def _run(dmp: Dmp, goals: Goals) -> tuple[Rollout, tuple[np.ndarray, np.ndarray]]:
    """Return the motion, and times (K,) and goals (K, n) from which on it goes for them."""
    if not goals:
        return dmp.rollout(np.linspace(0.0, dmp.duration, _SAMPLES)), (np.zeros(1), dmp.g[None])
    due = [(number(t, "time of a goal [s]"), g) for t, g in sorted(goals, key=lambda goal: goal[0])]
    times = np.linspace(0.0, max(_SETTLES * dmp.duration, due[-1][0] + 0.5 * dmp.duration), _SAMPLES)
    stepper, rows, phase, steps = dmp.stepper(), [], [], [(0.0, dmp.g)]
    for k, t in enumerate(times):
        if k:
            stepper.step(t - times[k - 1])
        while due and t >= due[0][0]:
            stepper.change_goal(due.pop(0)[1])
            steps.append((t, stepper.goal))
        rows.append((*stepper.state, stepper.goal))
        phase.append(stepper.x)
    y, yd, ydd, g = np.array(rows).swapaxes(0, 1)
    f = dmp.tau_d**2 * ydd - dmp.alpha_z * (dmp.beta_z * (g - y) - dmp.tau_d * yd)
    steps.append((times[-1], stepper.goal))
    return Rollout(times, y, yd, ydd, np.array(phase), f), tuple(map(np.array, zip(*steps)))  # pyright: ignore


def _when(dmp: Dmp) -> np.ndarray:
    """Return when the phase passes the centre of each kernel (n_basis,) [s]; for "position" as if it went evenly."""
    if dmp.schedule == "canonical":
        return -np.log(np.maximum(dmp.centres, 1e-12)) * dmp.tau_d / dmp.alpha_x
    share = dmp.centres if dmp.schedule == "time" else 1.0 - dmp.centres
    return share * dmp.duration


def _demonstration(dmp: Dmp, demo: tuple[ArrayLike, ArrayLike], position: Axes, velocity: Axes) -> None:
    t, y = demonstration(demo, dmp.n)
    for panel, values in ((position, y), (velocity, np.gradient(y, t, axis=0))):
        for i in range(dmp.n):
            line(panel, t, values[:, i], **TAUGHT, label="_" if i else "demonstration")
