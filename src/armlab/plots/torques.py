"""How well a model explains measured joint torques."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ModelMismatchError
from armlab.estimation import Fit
from armlab.glossary import label
from armlab.identify import predict
from armlab.models import TorqueModel
from armlab.plots.style import GREY, JOINT_STYLES, MODEL, band, legend, line, look, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from armlab.log import Table

__all__ = ["torque_fit", "value_of"]

_RESIDUAL = JOINT_STYLES[0][0]


def torque_fit(fit: Fit[TorqueModel] | TorqueModel, table: Table, ax: Any = None) -> Figure:
    """Draw measured and modelled torque of each joint, and the residual with its two-sigma band.

    Both are low-passed at the cut-off of the model, see `identify.predict`. The title of a residual says how much of
    the variance of the torque the model explains, the root mean square of the rest, and how much of it is in the band.

    Parameters
    ----------
    fit : identified torque model, or the fit that has it.
    table : log of free motion with q, tau (N, n), and qd where it was measured.
    ax : (n, 2) Axes to draw into; a new figure when None.

    Raises
    ------
    ModelMismatchError : something else in place of a model.
    ShapeError : a log that `identify.predict` refuses, or another number of Axes.
    """
    found = predict(value_of(fit), table)
    t, tau, model, sigma = found.t, found["tau"], found["tau_model"], found["tau_sigma"]
    joints = tau.shape[1]
    names = table.columns["tau"].labels or tuple(f"joint {i + 1}" for i in range(joints))
    with look():
        figure, axes = panels(joints, 2, ax, width=11.0, height=1.55, sharex=True, width_ratios=(3, 2))
        for i in range(joints):
            left, right = axes[i]
            line(left, t, tau[:, i], color=GREY, linewidth=3.2, alpha=0.45, label="measured")
            line(left, t, model[:, i], color=MODEL, linewidth=0.8, label="model")
            left.set_ylabel(label("tau"))
            residual = tau[:, i] - model[:, i]
            band(right, t, np.zeros(len(t)), 2 * sigma[:, i], color=_RESIDUAL, alpha=0.22, label="± 2 sigma")
            line(right, t, residual, color=_RESIDUAL, linewidth=0.7, label="measured - model")
            right.set_ylabel(label("tau").replace("tau", "residual"))
            right.set_ylim(*_scale(residual, sigma[:, i]))
            left.set_title(names[i], fontweight="bold")
            right.set_title(_verdict(tau[:, i], residual, sigma[:, i]))
        for low in axes[-1]:
            low.set_xlabel(label("t"))
        legend(figure, *axes[0])
        figure.align_ylabels()
    return figure


def value_of(fit: Fit[TorqueModel] | TorqueModel) -> TorqueModel:
    """Return the torque model of a fit, or the model itself.

    Raises
    ------
    ModelMismatchError : something else, such as the path of a file.
    """
    model = fit.value if isinstance(fit, Fit) else fit
    if not isinstance(model, TorqueModel):
        raise ModelMismatchError.no_model(model)
    return model


def _verdict(tau: np.ndarray, residual: np.ndarray, sigma: np.ndarray) -> str:
    """Return share of variance explained, size of the residual, and how much of it the band covers."""
    known = np.isfinite(residual) & np.isfinite(sigma)
    spread = np.var(tau[known]) if known.any() else 0.0
    if not spread > 0:
        return ""
    explained = 1.0 - np.var(residual[known]) / spread
    inside = np.mean(np.abs(residual[known]) < 2 * sigma[known])
    rms = np.sqrt(np.mean(residual[known] ** 2))
    return f"{100 * explained:.2f} % explained, {rms:.2g} N m RMS, {100 * inside:.0f} % in band"


def _scale(residual: np.ndarray, sigma: np.ndarray) -> tuple[float | None, float | None]:
    """Return symmetric limits that hold the band and the residual but for rare spikes."""
    sizes = [np.nanquantile(np.abs(residual), 0.999)] if np.isfinite(residual).any() else []
    sizes += [2 * np.nanmedian(sigma)] if np.isfinite(sigma).any() else []
    largest = float(max(sizes, default=0.0))
    return (-1.3 * largest, 1.3 * largest) if largest > 0 else (None, None)
