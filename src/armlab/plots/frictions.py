"""Friction over speed, with what is not known of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.estimation import Fit
from armlab.glossary import lookup
from armlab.models import TorqueModel
from armlab.plots.arguments import expect
from armlab.plots.style import MODEL, band, cloud, legend, look, panels
from armlab.plots.torques import value_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from armlab.log import Table

__all__ = ["friction", "own_parameters"]

_COLUMNS = 4
_POINTS = 3_000


def friction(fit: Fit[TorqueModel], table: Table | None = None, ax: Any = None) -> Figure:
    """Draw the friction of each joint in steady motion over its velocity, with a two-sigma band.

    The dark band is what is uncertain in the friction parameters; the light one adds the torque error that the model
    states for that velocity, so 95 % of the points belong inside it. A point is the curve plus the residual of a row.

    Parameters
    ----------
    fit : of `identify.fit_dynamics`.
    table : of free motion, with qd and tau_error (N, n), from `contact.Estimator.run`; points are drawn where given.
    ax : as many Axes as joints; a new figure when None.

    Raises
    ------
    ModelMismatchError : a fit of something else. ShapeError : no fit, or another number of Axes than joints.
    """
    expect(fit, Fit)
    model = value_of(fit)
    n = model.n
    with look():
        rows = -(-n // _COLUMNS) if ax is None else 1
        figure, axes = panels(rows, min(n, _COLUMNS) if ax is None else n, ax, width=11.0, height=2.6)
        for panel in axes.ravel()[n:]:
            panel.remove()
        for i, panel in enumerate(axes.ravel()[:n]):
            qd = _speeds(model.training.qd_peak[i])
            if table is not None:
                _points(panel, model, table, i)
            grid = np.repeat(qd[:, None], n, axis=1)
            torque = _curve(model, grid)[:, i]
            known = _parameter_variance(fit, i, qd)
            stated = np.sqrt(known + model.covariance.variance(grid)[:, i])
            band(panel, qd, torque, 2 * np.sqrt(known), color=MODEL, alpha=0.4, label="± 2 sigma of the parameters")
            band(panel, qd, torque, 2 * stated, color=MODEL, alpha=0.15, label="with the torque error")
            panel.plot(qd, torque, color=MODEL, linewidth=1.4, label="model")
            panel.set_title(f"joint {i + 1}")
            panel.set_xlabel(f"qd [{lookup('qd').unit}]")
            panel.set_ylabel(f"friction [{lookup('tau').unit}]")
        legend(figure, axes.ravel()[0])
    return figure


def _speeds(peak: float) -> np.ndarray:
    half = np.geomspace(1e-4, 1.0, 200) * (peak if peak > 0 else 1.0)
    return np.concatenate([-half[::-1], half])


def _curve(model: TorqueModel, qd: np.ndarray) -> np.ndarray:
    """Return the friction (N, n) of joints that slide at `qd` (N, n)."""
    return model.friction.torque(qd, _sign(model, qd))


def _sign(model: TorqueModel, qd: np.ndarray) -> np.ndarray:
    smooth = model.friction.smooth_speed
    return np.where(smooth > 0, np.tanh(qd / np.where(smooth > 0, smooth, 1.0)), np.sign(qd))


def _points(panel: Any, model: TorqueModel, table: Table, i: int) -> None:
    """Draw the friction that each row shows: what the model has, plus what it misses."""
    every = max(1, len(table) // _POINTS)
    qd, missed = table["qd"][::every], -table["tau_error"][::every]
    shown = _curve(model, qd)[:, i] + missed[:, i]
    cloud(panel, qd[:, i], shown, "measured")


def _parameter_variance(fit: Fit[TorqueModel], i: int, qd: np.ndarray) -> np.ndarray:
    """Return the variance (N,) of the friction curve of joint i from the covariance of its parameters."""
    friction = fit.value.friction
    s = _sign(fit.value, np.repeat(qd[:, None], fit.value.n, axis=1))[:, i]
    slopes = {
        "viscous": qd,
        "coulomb": s,
        "coulomb+": np.maximum(s, 0.0),
        "coulomb-": np.minimum(s, 0.0),
        "offset": np.ones_like(qd),
        "stribeck": s * np.exp(-((qd / friction.stribeck_speed[i]) ** 2)),
        "root": s * np.sqrt(np.abs(qd)),
    }
    own = own_parameters(fit)[i]
    found = [(own[kind], slope) for kind, slope in slopes.items() if kind in own]
    if not found:
        return np.zeros_like(qd)
    columns = [k for k, _ in found]
    G = np.stack([g for _, g in found], axis=1)
    return np.einsum("ka,ab,kb->k", G, fit.cov[np.ix_(columns, columns)], G)


def own_parameters(fit: Fit[TorqueModel]) -> list[dict[str, int]]:
    """Return, for each joint, the place of each friction parameter in the fit: {"viscous": 45, "coulomb+": 46, ...}.

    Parameters
    ----------
    fit : of `identify.fit_dynamics`: after the base parameters, those of each joint begin with viscous.
    """
    joints: list[dict[str, int]] = []
    for place in range(len(fit.value.base_names), len(fit.names)):
        kind = fit.names[place].split()[0]
        if kind == "viscous":
            joints.append({})
        if joints:
            joints[-1].setdefault(kind, place)
    return (joints + [{} for _ in range(fit.value.n)])[: fit.value.n]
