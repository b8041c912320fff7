"""Figures of all kinds of movement primitives, and of two-degree-of-freedom control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import AXIS_COLORS, GREY
from armlab._numbers import number, numbers
from armlab.errors import ShapeError
from armlab.estimation.fit import Fit, value_of
from armlab.glossary import label
from armlab.lie import so3
from armlab.motion import Dmp, PeriodicDmp, PoseDmp, ProMP, Rollout, TwoDofRun
from armlab.plots.space import pose_stack
from armlab.plots.style import JOINT_STYLES, band, expect, joint_style, legend, line, name_rows, panels, single

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TAUGHT: dict[str, Any] = {"color": "#BFBFBF", "linewidth": 3.5, "zorder": 1}
"""Style of demonstrations: thick lines below the motion."""
_SAMPLES = 501
_SETTLES = 1.5  # plotted time, relative to the duration, of motions that continue beyond their duration
Goals = Sequence[tuple[float, ArrayLike]]


def dmp(
    dmp: Dmp | Fit[Dmp], demo: tuple[ArrayLike, ArrayLike] | None = None, goals: Goals = (), ax: Any = None
) -> Figure:
    """Plot a movement primitive against time: position, velocity, forcing term, kernels with the phase, and weights.

    Parameters
    ----------
    dmp : the primitive.
    demo : times (N,) and positions (N, n) of the demonstration, drawn as a thick grey line.
    goals : goal changes (t, g), with the new goal g (n,) at time t [s], drawn as dashed lines.
    ax : five Axes to draw into; default: a new figure.

    Raises
    ------
    ShapeError : `dmp` is not a Dmp, a demonstration or goal has the wrong shape, or the number of Axes is wrong.
    """
    dmp = value_of(dmp)
    expect(dmp, Dmp)
    run, steps = _run(dmp, goals)
    with panels(5, 1, ax, width=8.0, height=1.6, sharex=True) as (figure, axes):
        position, velocity, forcing, kernels, weights = axes[:, 0]
        for i in range(dmp.n):
            color = JOINT_STYLES[i % len(JOINT_STYLES)][0]
            for panel, values in ((position, run.y), (velocity, run.yd), (forcing, run.forcing)):
                panel.plot(run.t, values[:, i], label=f"y{i + 1}", **joint_style(i))
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
        name_rows(figure, axes, names)
        legend(figure, position, kernels)
    return figure


def dmp_phase(dmp: Dmp | Fit[Dmp], ax: Any = None) -> Axes:
    """Plot the phase plane of a movement primitive: velocity against position, from the start (o) to the goal (x).

    Parameters
    ----------
    dmp : the primitive.
    ax : Axes to draw into; default: a new figure.

    Raises
    ------
    ShapeError : `dmp` is not a Dmp, or the number of Axes is wrong.
    """
    dmp = value_of(dmp)
    expect(dmp, Dmp)
    run = dmp.rollout(np.linspace(0.0, _SETTLES * dmp.duration, _SAMPLES))
    with single(ax, width=6.0, height=4.5) as (figure, panel):
        for i in range(dmp.n):
            color = JOINT_STYLES[i % len(JOINT_STYLES)][0]
            panel.plot(run.y[:, i], run.yd[:, i], label=f"y{i + 1}", **joint_style(i))
            panel.plot(run.y[0, i], run.yd[0, i], "o", color=color, markersize=4.0, label="_")
            panel.plot(dmp.g[i], 0.0, "x", color=color, markersize=6.0, label="_")
        panel.set(xlabel=label("y"), ylabel=label("yd"))
        legend(figure, panel)
    return panel


def demonstration(demo: tuple[ArrayLike, ArrayLike], n: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (N,), starting at 0, and the positions (N, n) of a demonstration, or poses (N, 4, 4) if n is
    None."""
    t = numbers(demo[0], "demo times", ShapeError)
    y = pose_stack(demo[1]) if n is None else numbers(demo[1], "demo positions", ShapeError)
    shape, what = ((4, 4), "poses (N, 4, 4)") if n is None else ((n,), f"positions (N, {n})")
    if t.ndim != 1 or len(t) < 2 or y.shape != (len(t), *shape) or not (np.diff(t) > 0).all():
        raise ShapeError(
            "Expected a demonstration that consists of increasing "
            f"times (N,) and {what}, got shapes {t.shape} and {y.shape}."
        )
    return t - t[0], y


def _run(dmp: Dmp, goals: Goals) -> tuple[Rollout, tuple[np.ndarray, np.ndarray]]:
    """Return the motion, and the times (K,) and goals (K, n) of all goal changes."""
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
    """Return the times (n_basis,) [s] of the kernel centres; evenly spaced for the schedule "position"."""
    if dmp.schedule == "canonical":
        return -np.log(np.maximum(dmp.centres, 1e-12)) * dmp.tau_d / dmp.alpha_x
    share = dmp.centres if dmp.schedule == "time" else 1.0 - dmp.centres
    return share * dmp.duration


def _demonstration(dmp: Dmp, demo: tuple[ArrayLike, ArrayLike], position: Axes, velocity: Axes) -> None:
    t, y = demonstration(demo, dmp.n)
    for panel, values in ((position, y), (velocity, np.gradient(y, t, axis=0))):
        for i in range(dmp.n):
            line(panel, t, values[:, i], **TAUGHT, label="_" if i else "demonstration")


_DASHES = ("-", "--", "-.")


def pose_dmp(dmp: PoseDmp | Fit[PoseDmp], demo: tuple[ArrayLike, ArrayLike] | None = None, ax: Any = None) -> Figure:
    """Plot a pose movement primitive against time: position, and rotation vector relative to the goal.

    Parameters
    ----------
    dmp : the primitive.
    demo : times (N,) and poses (N, 4, 4) of the demonstration, drawn as a thick grey line; additional panels show its
        distance from the primitive.
    ax : two Axes to draw into, or four with a demonstration; default: a new figure.

    Raises
    ------
    ShapeError : `dmp` is not a PoseDmp, the demonstration has the wrong shape, or the number of Axes is wrong.
    """
    dmp = value_of(dmp)
    expect(dmp, PoseDmp)
    t, taught = (np.linspace(0.0, dmp.duration, _SAMPLES), None) if demo is None else demonstration(demo, None)
    T = dmp.rollout(t).T
    with panels(2 if taught is None else 4, 1, ax, width=8.0, height=1.9, sharex=True) as (figure, axes):
        _poses(axes[:2, 0], t, T, dmp.T_goal, [{"linestyle": s, "label": n} for s, n in zip(_DASHES, "xyz")])
        names = ["position [m]", "rotation vector\nfrom the goal [rad]"]
        if taught is not None:
            _poses(axes[:2, 0], t, taught, dmp.T_goal, [TAUGHT | {"label": n} for n in ("demonstration", "_", "_")])
            line(axes[2, 0], t, np.linalg.norm(T[:, :3, 3] - taught[:, :3, 3], axis=1), color=GREY, label="_")
            line(axes[3, 0], t, so3.angle(T[:, :3, :3], taught[:, :3, :3]), color=GREY, label="_")
            names += ["position error [m]", "rotation error [rad]"]
        name_rows(figure, axes, names)
        legend(figure, axes[0, 0])
    return figure


def _poses(axes: np.ndarray, t: np.ndarray, T: np.ndarray, T_goal: np.ndarray, styles: list[dict[str, Any]]) -> None:
    """Draw x, y and z of the position, and of the rotation vector relative to the goal in base axes."""
    turned = so3.log(T[:, :3, :3] @ T_goal[:3, :3].T)
    for panel, values in zip(axes, (T[:, :3, 3], turned), strict=True):
        for i, style in enumerate(styles):
            line(panel, t, values[:, i], **{"color": AXIS_COLORS[i], **style})


_TURN_SAMPLES = 500  # samples per period
_MOST = 2000  # maximum number of samples drawn per demonstration
_TICKS = {0.0: "0", np.pi / 2: "π/2", np.pi: "π", 3 * np.pi / 2: "3π/2", 2 * np.pi: "2π"}


def periodic_dmp(
    dmp: PeriodicDmp | Fit[PeriodicDmp],
    demo: tuple[ArrayLike, ArrayLike] | None = None,
    turns: float = 3.0,
    ax: Any = None,
) -> Figure:
    """Plot a periodic movement primitive: position, forcing term and kernels over one period, and several periods.

    The motion in the last panel begins at rest on the baseline (dashed) and converges to the periodic motion.

    Parameters
    ----------
    dmp : the primitive.
    demo : times (N,) and positions (N, n) of the demonstration, drawn as dots; the first sample has phase 0.
    turns : number of periods in the last panel.
    ax : four Axes to draw into; default: a new figure.

    Raises
    ------
    ShapeError : `dmp` is not a PeriodicDmp, the demonstration has the wrong shape, `turns` is not positive, or the
        number of Axes is wrong.
    """
    dmp = value_of(dmp)
    expect(dmp, PeriodicDmp)
    if not 0.0 < number(turns, "turns") < np.inf:
        raise ShapeError(f"Expected turns above zero, got {turns:g}. Try 3.")
    phi = 2 * np.pi / _TURN_SAMPLES * np.arange(_TURN_SAMPLES + 1)
    once = dmp.rollout(phi * dmp.period / (2 * np.pi))
    t = np.linspace(0.0, turns * dmp.period, round(_TURN_SAMPLES * turns) + 1)
    begun = dmp.rollout(t, y0=dmp.g, v0=np.zeros(dmp.n))
    with panels(4, 1, ax, width=8.0, height=1.9) as (figure, axes):
        position, forcing, kernels, several = axes[:, 0]
        if demo is not None:
            times, y = (part[:: max(1, len(part) // _MOST)] for part in demonstration(demo, dmp.n))
            for i in range(dmp.n):
                name, at = "_" if i else "demonstration", 2 * np.pi * np.mod(times / dmp.period, 1.0)
                position.plot(at, y[:, i], ".", color="#999999", markersize=2.5, label=name)
        for i in range(dmp.n):
            style = joint_style(i)
            position.plot(phi, once.y[:, i], label=f"y{i + 1}", **style)
            forcing.plot(phi, once.forcing[:, i], label="_", **style)
            several.plot(t, begun.y[:, i], label="_", **style)
            several.axhline(dmp.g[i], label="_", **{**style, "linestyle": "--", "linewidth": 0.7})
        kernels.plot(phi, dmp.primitive_from().basis(phi), color=GREY, linewidth=0.7, label="_")
        name_rows(figure, axes, (label("y"), label("forcing"), "kernels [1]", label("y")))
        for panel in axes[:3, 0]:
            panel.set_xticks(list(_TICKS), list(_TICKS.values()))
        kernels.set_xlabel(label("phi"))
        legend(figure, position)
    return figure


_BAND_SAMPLES = 301


def promp(
    promp: ProMP | Fit[ProMP],
    demos: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    *,
    prior: ProMP | None = None,
    points: Sequence[tuple[float, ArrayLike]] = (),
    samples: int = 0,
    seed: int = 0,
    ax: Any = None,
) -> Figure:
    """Plot the mean and 2-sigma band of a distribution over motions, with one panel per coordinate.

    Parameters
    ----------
    promp : the distribution.
    demos : times (N,) and positions (N, n) of each demonstration, drawn as thin lines, scaled to the duration of
        `promp`.
    prior : distribution before conditioning, drawn in grey.
    points : via-points (t, y) with time t [s] and position y (n,).
    samples : number of random motions to sample from the distribution and draw as dotted lines.
    seed : random seed of the sampled motions.
    ax : n Axes to draw into; default: a new figure.

    Raises
    ------
    ShapeError : `promp` is not a ProMP, the number of Axes is wrong, or a demonstration, the prior or a via-point has
        the wrong shape.
    """
    promp = value_of(promp)
    expect(promp, ProMP)
    t = np.linspace(0.0, promp.duration, _BAND_SAMPLES)
    marks = [(number(when, "time of a point [s]"), _point(y, promp.n)) for when, y in points]
    if prior is not None and prior.n != promp.n:
        raise ShapeError(
            f"Expected a prior of {promp.n} coordinates, got {prior.n}. Use the distribution before conditioning."
        )
    with panels(promp.n, 1, ax, width=8.0, height=1.9, sharex=True) as (figure, axes):
        for demo in demos:
            times, y = demonstration(demo, promp.n)
            for i, panel in enumerate(axes[:, 0]):
                line(panel, times * promp.duration / times[-1], y[:, i], color=GREY, linewidth=0.4, label="_")
        if prior is not None:
            _bands(axes[:, 0], t, prior, ["#999999"] * promp.n, ("before", None))
        colors = [JOINT_STYLES[i % len(JOINT_STYLES)][0] for i in range(promp.n)]
        _bands(axes[:, 0], t, promp, colors, ("mean", "± 2 sd"))
        drawn = promp.sample(t, seed, samples) if samples else np.zeros((0, len(t), promp.n))
        for i, panel in enumerate(axes[:, 0]):
            for k, one in enumerate(drawn):
                panel.plot(t, one[:, i], color=colors[i], linewidth=0.7, linestyle=":", label="_" if k else "samples")
            for k, (when, y) in enumerate(marks):
                panel.plot(when, y[i], "o", color="black", markersize=4.0, label="_" if k else "points")
        if len(demos):
            axes[0, 0].plot([], [], color=GREY, linewidth=0.8, label="demonstrations")
        name_rows(figure, axes, [label("y").replace("y ", f"y{i + 1} ", 1) for i in range(promp.n)])
        legend(figure, axes[0, 0])
    return figure


def _bands(axes: np.ndarray, t: np.ndarray, promp: ProMP, colors: list[str], names: tuple[str, str | None]) -> None:
    motion = promp.marginal(t, duration=t[-1])
    for panel, color, mean, sd in zip(axes, colors, motion.y.T, motion.sd.T, strict=True):
        panel.plot(t, mean, color=color, label=names[0])
        band(panel, t, mean, 2.0 * sd, color=color, alpha=0.25, label=names[1] or "_")


def _point(y: ArrayLike, n: int) -> np.ndarray:
    point = np.atleast_1d(numbers(y, "point", ShapeError))
    if point.shape != (n,):
        raise ShapeError(f"Expected points y of shape ({n},), got {point.shape}. Use NaN to omit a coordinate.")
    return point


def two_dof(run: TwoDofRun, dofs: Sequence[int] | None = None, ax: Any = None) -> Figure:
    """Plot the disturbance and recovery of a primitive under two-degree-of-freedom control.

    The top panel shows the arm position ya (solid), the coupled path yc (dashed) and the undisturbed primitive
    (dotted). The middle panel shows the filtered error e, and the bottom panel the slow-down factor of the path.
    Disturbances are shaded.

    Parameters
    ----------
    run : from `TwoDofDmp.simulate` or `TwoDofDmp.recorded`.
    dofs : indices of the coordinates to draw, from 0; default: all coordinates.
    ax : three Axes to draw into; default: a new figure.

    Raises
    ------
    ShapeError : `run` is not a TwoDofRun, a coordinate is invalid, or the number of Axes is wrong.
    """
    expect(run, TwoDofRun)
    which = range(run.yc.shape[1]) if dofs is None else dofs
    if not all(isinstance(i, int | np.integer) and 0 <= i < run.yc.shape[1] for i in which):
        raise ShapeError(f"Expected dofs to be indices from 0 to {run.yc.shape[1] - 1}, got {list(which)}.")
    with panels(3, 1, ax, width=8.0, height=2.0, sharex=True) as (figure, axes):
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
        for panel in axes[:, 0]:
            for k, (t0, t1) in enumerate(run.disturbed):
                _mark(panel, t0, t1, "disturbed" if not k and panel is position else "_")
        slower.set_yscale("log", subs=[2, 5])
        slower.set_ylim(0.9, 1.2 * max(run.tau_a.max() / run.tau_a.min(), 2.0))
        for formatter in (slower.yaxis.set_major_formatter, slower.yaxis.set_minor_formatter):
            formatter("{x:g}")
        name_rows(figure, axes, (label("y"), label("e"), "slow-down [1]"))
        legend(figure, position)
    return figure


def _mark(panel: Axes, t0: float, t1: float, name: str) -> None:
    if t1 > t0:
        panel.axvspan(t0, t1, color="#999999", alpha=0.25, linewidth=0.0, zorder=0, label=name)
    else:
        panel.axvline(t0, color="#999999", alpha=0.6, zorder=0, label=name)
