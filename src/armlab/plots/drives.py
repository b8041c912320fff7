"""Figures of drives: friction against velocity and position, and the spectrum of torque ripple."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import GREY
from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.glossary import label, lookup
from armlab.identify.residuals import model_residuals
from armlab.kernels import Drive
from armlab.models import TorqueModel
from armlab.models.friction import FRICTION_TERMS, Ripple
from armlab.plots.model import value_of
from armlab.plots.style import JOINT_STYLES, MODEL, band, cloud, expect, joint_panels, joints_shown, legend, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from armlab.log import Table

_POINTS = 3_000


def friction(fit: Fit[TorqueModel], table: Table | None = None, ax: Any = None) -> Figure:
    """Plot the steady-state friction of each joint against velocity, with 2-sigma bands.

    The dark band is the uncertainty of the friction parameters. The light band adds the model's torque error at that
    velocity, and should contain 95 % of the points. Each point is the curve value plus the torque residual of one row.

    Parameters
    ----------
    fit : from `identify.fit_dynamics`.
    table : log of free motion with qd and tau_error (N, n), from `contact.Estimator.run`, drawn as points.
    ax : one Axes per joint; default: a new figure.

    Raises
    ------
    ModelMismatchError : `fit` is not the fit of a torque model.
    ShapeError : `fit` is not a Fit, or the number of Axes is wrong.
    """
    expect(fit, Fit)
    model = value_of(fit)
    n = model.n
    with joint_panels(n, ax) as (figure, axes):
        for i, panel in enumerate(axes):
            peak = model.training.qd_peak[i]
            half = np.geomspace(1e-4, 1.0, 200) * (peak if peak > 0 else 1.0)
            qd = np.concatenate([-half[::-1], half])
            if table is not None:
                every = max(1, len(table) // _POINTS)
                speeds = table["qd"][::every]
                shown = _curve(model, speeds) - table["tau_error"][::every]  # model plus residual
                cloud(panel, speeds[:, i], shown[:, i], "measured")
            grid = np.repeat(qd[:, None], n, axis=1)
            torque = _curve(model, grid)[:, i]
            known = _parameter_variance(fit, i, qd)
            stated = np.sqrt(known + model.covariance.variance(grid)[:, i])
            band(panel, qd, torque, 2 * np.sqrt(known), color=MODEL, alpha=0.4, label="± 2 sigma of the parameters")
            band(panel, qd, torque, 2 * stated, color=MODEL, alpha=0.15, label="with the torque error")
            panel.plot(qd, torque, color=MODEL, linewidth=1.4, label="model")
            panel.set(title=f"joint {i + 1}", xlabel=label("qd"), ylabel=f"friction [{lookup('tau').unit}]")
        legend(figure, axes[0])
    return figure


def _curve(model: TorqueModel, qd: np.ndarray) -> np.ndarray:
    """Return the sliding friction (N, n) at joint velocities `qd` (N, n)."""
    return model.friction.torque(qd, _sign(model, qd))


def _sign(model: TorqueModel, qd: np.ndarray) -> np.ndarray:
    smooth = model.friction.smooth_speed
    return np.where(smooth > 0, np.tanh(qd / np.where(smooth > 0, smooth, 1.0)), np.sign(qd))


def _parameter_variance(fit: Fit[TorqueModel], i: int, qd: np.ndarray) -> np.ndarray:
    """Return the variance (N,) of joint i's friction curve due to the parameter covariance."""
    friction = fit.value.friction
    s = _sign(fit.value, np.repeat(qd[:, None], fit.value.n, axis=1))[:, i]
    slopes = {name: term.column(qd, s) for name, term in FRICTION_TERMS.items() if term.column and name != "load"}
    slopes["stribeck"] = slopes["stribeck"] * np.exp(-((qd / friction.stribeck_speed[i]) ** 2))
    own = own_parameters(fit)[i]
    found = [(own[kind], slope) for kind, slope in slopes.items() if kind in own]
    if not found:
        return np.zeros_like(qd)
    columns = [k for k, _ in found]
    G = np.stack([g for _, g in found], axis=1)
    return np.einsum("ka,ab,kb->k", G, fit.cov[np.ix_(columns, columns)], G)


def own_parameters(fit: Fit[TorqueModel]) -> list[dict[str, int]]:
    """Return, per joint, the index of each friction parameter in the fit, such as {"viscous": 45, "coulomb+": 46}."""
    joints: list[dict[str, int]] = []
    for place in range(len(fit.value.base_names), len(fit.names)):
        kind = fit.names[place].split()[0]
        if kind == "viscous":
            joints.append({})
        if joints:
            joints[-1].setdefault(kind, place)
    return (joints + [{} for _ in range(fit.value.n)])[: fit.value.n]


_CELLS = 61  # cells of the map per axis
_SLICES = 3
_BINS = 16  # bins of the sample coverage per axis
_ROWS = 8_000  # maximum number of rows for a spectrum; longer logs are thinned
_BEYOND = 1.25  # upper limit of the spectrum, relative to the line at twice the gear ratio
_FEWEST = 100  # minimum number of rows for an amplitude
_SLOWEST, _UNGEARED = 1.0, 50.0  # cycles per revolution: lower limit of the spectrum, and minimum upper limit


def friction_map(
    model: Fit[TorqueModel] | TorqueModel,
    joint: int,
    table: Table | None = None,
    slices: ArrayLike | None = None,
    ax: Any = None,
) -> Figure:
    """Plot the sliding friction of a joint against position and velocity, as a colour map and as slices.

    If a table is given, its samples are drawn on the map, and cells without samples, where the map extrapolates, are
    hatched.

    Parameters
    ----------
    model : torque model with or without a `models.friction.FrictionMap`, or its fit.
    joint : index of the joint, from 0.
    table : training data of the map with q and qd (N, n).
    slices : positions (k,) of the slices [rad]; default: three, evenly spaced.
    ax : two Axes; default: a new figure.

    Raises
    ------
    ModelMismatchError : `model` is not a torque model.
    ShapeError : the joint index is invalid, a position is not finite, or the number of Axes is wrong.
    """
    model = value_of(model)
    joints_shown([joint], model.n)
    known = model.training
    q = np.linspace(known.q_min[joint], known.q_max[joint], _CELLS)
    qd = np.linspace(-1.0, 1.0, 2 * (_CELLS // 2)) * known.qd_peak[joint]  # an even number excludes zero velocity
    torque = _sliding(model, joint, q, qd)
    cuts = np.linspace(q[0], q[-1], _SLICES + 2)[1:-1] if slices is None else numbers(slices, "slices", ShapeError)
    if cuts.ndim != 1 or not len(cuts) or not np.isfinite(cuts).all():
        raise ShapeError(f"Expected slices to be finite positions (k,) [rad], got {slices!r}.")
    with panels(1, 2, ax, width=11.0, height=3.8, width_ratios=(3, 2)) as (figure, axes):
        left, right = axes[0]
        mesh = left.pcolormesh(q, qd, torque.T, cmap="cividis", shading="nearest", rasterized=True)
        figure.colorbar(mesh, ax=left, label=f"friction [{lookup('tau').unit}]")
        if table is not None:
            _cover(left, table["q"][:, joint], table["qd"][:, joint], q, qd)
        left.set(xlabel=label("q"), ylabel=label("qd"), title=f"joint {joint + 1}")
        left.grid(visible=False)
        for at, values, (color, _) in zip(cuts, _sliding(model, joint, cuts, qd), cycle(JOINT_STYLES)):
            right.plot(qd, values, color=color, label=f"q = {at:.2f} {lookup('q').unit}")
            left.axvline(at, color=color, linewidth=1.2, ymax=0.04)
        right.set(xlabel=label("qd"), ylabel=f"friction [{lookup('tau').unit}]")
        right.legend(loc="upper left")
    return figure


def _sliding(model: TorqueModel, joint: int, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return the sliding friction (Q, V) of one joint, without torque ripple."""
    rows = None if model.friction_map is None else model.friction_map.kernel_rows()
    drive = Drive(model.friction.rows, np.zeros((3, model.n)), map=rows)
    at = np.zeros((2, len(q), len(qd), model.n))
    at[0, :, :, joint], at[1, :, :, joint] = np.meshgrid(q, qd, indexing="ij")
    return drive.torque(at[0], at[1], _sign(model, at[1]))[:, :, joint]


def _cover(panel: Any, q: np.ndarray, qd: np.ndarray, q_shown: np.ndarray, qd_shown: np.ndarray) -> None:
    """Draw samples on a map, and hatch the cells without samples."""
    edges = np.linspace(q_shown[0], q_shown[-1], _BINS + 1), np.linspace(qd_shown[0], qd_shown[-1], _BINS + 1)
    count = np.histogram2d(q, qd, bins=edges)[0]
    every = max(1, len(q) // 4000)
    panel.plot(q[::every], qd[::every], ",", color="white", alpha=0.5)
    middles = [0.5 * (edge[1:] + edge[:-1]) for edge in edges]
    ends = [np.concatenate([edge[:1], middle[1:-1], edge[-1:]]) for edge, middle in zip(edges, middles)]
    holes = panel.contourf(*ends, (count == 0).T.astype(float), levels=[0.5, 1.5], colors="none", hatches=["///"])
    holes.set_edgecolor("white")
    holes.set_linewidth(0.0)


def spectrum(
    fit: Fit[TorqueModel] | TorqueModel, table: Table, joints: Sequence[int] | None = None, ax: Any = None
) -> Figure:
    """Plot the amplitude of the torque residual against cycles per joint revolution, with and without the ripple model.

    Ripple depends on position, so its spectral lines do not depend on speed; the model's lines are marked. If the gear
    ratios are known, the upper axis shows cycles per motor revolution. The amplitude of a spectral line is computed
    only from rows in which its frequency is below a quarter of the sampling rate.

    Parameters
    ----------
    fit : identified torque model, or its fit.
    table : log of free motion with q, qd and tau (N, n).
    joints : indices of the joints to draw, from 0; default: all joints.
    ax : one Axes per joint; default: a new figure.

    Raises
    ------
    ModelMismatchError : `fit` is not a torque model.
    ShapeError : a joint index is invalid, the number of Axes is wrong, or `identify.prepare` rejects the log.
    """
    model = value_of(fit)
    shown = joints_shown(joints, model.n)
    still = np.zeros(model.n)
    bare = replace(model, ripple=Ripple(model.ripple.cycles, still, still), lines=None)
    with_ripple, without = model_residuals(table, model), model_residuals(table, bare)
    every = max(1, len(without.y) // _ROWS)
    with panels(len(shown), 1, ax, width=9.0, height=1.9) as (figure, axes):
        for panel, i in zip(axes[:, 0], shown, strict=True):
            q, qd = without.data.q[::every, i], without.data.qd[::every, i]
            gear = 0.5 * model.ripple.cycles[i]
            step = 0.5 * np.pi / max(float(np.ptp(q)), 1e-3)  # the range of motion determines the resolution
            cycles = np.arange(_SLOWEST, _BEYOND * max(2.0 * gear, _UNGEARED), step)
            slow = without.data.rate / 4.0 / np.maximum(np.abs(qd) / (2 * np.pi), 1e-9)  # cycles per revolution
            for found, color, label in ((without, GREY, "without"), (with_ripple, MODEL, "with")):
                amplitude = _amplitude(q, found.y[::every, i], cycles, slow)
                panel.plot(cycles, amplitude, color=color, linewidth=0.8, label=label)
            for k, line in enumerate(_lines(model, i)):
                panel.axvline(line, color=MODEL, linestyle=":", linewidth=0.8, label="_" if k else "model line")
            if 2.0 * gear >= _UNGEARED:
                top = panel.secondary_xaxis("top", functions=(lambda x, g=gear: x / g, lambda x, g=gear: x * g))
                top.set_xlabel("cycles per motor revolution" if panel is axes[0, 0] else "")
            panel.set(title=f"joint {i + 1}", ylabel=f"amplitude [{lookup('tau').unit}]")
        axes[-1, 0].set_xlabel("cycles per joint revolution")
        legend(figure, axes[0, 0])
    return figure


def _amplitude(q: np.ndarray, y: np.ndarray, cycles: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return the amplitude (C,) of each line ``a cos(c q) + b sin(c q)`` of y, from the rows with `most` > c."""
    y = y - y.mean()
    found = np.full(len(cycles), np.nan)
    for k, c in enumerate(cycles):
        rows = most > c
        if rows.sum() >= _FEWEST:
            found[k] = 2.0 * np.abs(np.mean(y[rows] * np.exp(-1j * c * q[rows])))
    return found


def _lines(model: TorqueModel, joint: int) -> list[float]:
    """Return the ripple lines of a joint in the model [cycles per revolution]."""
    found = [] if model.lines is None else model.lines.cycles[model.lines.joint == joint].tolist()
    if np.hypot(model.ripple.cosine[joint], model.ripple.sine[joint]) > 0:
        found.append(float(model.ripple.cycles[joint]))
    return sorted(found)
