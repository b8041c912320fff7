"""Figures of torque models: fit to a log, residuals, autocorrelation, covariance, excitation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab._display import GREY
from armlab.errors import ModelMismatchError, ShapeError, UnknownName
from armlab.estimation import Excitation, Fit
from armlab.estimation.robust import correlation_time
from armlab.glossary import label, lookup
from armlab.identify import predict
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.uncertainty import VelocityCovariance
from armlab.plots.style import (
    JOINT_STYLES,
    MODEL,
    band,
    cloud,
    expect,
    joint_names,
    joint_panels,
    joint_style,
    joints_shown,
    legend,
    line,
    panels,
    single,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RESIDUAL = JOINT_STYLES[0][0]


def torque_fit(fit: Fit[TorqueModel] | TorqueModel, table: Table, ax: Any = None) -> Figure:
    """Plot the measured and modelled torque of each joint, and the residual with its 2-sigma band.

    Measured and modelled torques are low-pass filtered at the cut-off frequency of the model; see `identify.predict`.
    The title of a residual panel gives the explained variance, the RMS residual, and the fraction within the band.

    Parameters
    ----------
    fit : identified torque model, or its fit.
    table : log of free motion with q, tau (N, n), and qd if measured.
    ax : Axes (n, 2) to draw into; default: a new figure.

    Raises
    ------
    ModelMismatchError : `fit` is not a torque model.
    ShapeError : `identify.predict` rejects the log, or the number of Axes is wrong.
    """
    found = predict(value_of(fit), table)
    t, tau, model, sigma = found.t, found["tau"], found["tau_model"], found["tau_sigma"]
    joints = tau.shape[1]
    names = joint_names(table, joints)
    with panels(joints, 2, ax, width=11.0, height=1.55, sharex=True, width_ratios=(3, 2)) as (figure, axes):
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
    """Return the torque model of a fit, or the model itself."""
    model = fit.value if isinstance(fit, Fit) else fit
    if not isinstance(model, TorqueModel):
        raise ModelMismatchError.no_model(model)
    return model


def _verdict(tau: np.ndarray, residual: np.ndarray, sigma: np.ndarray) -> str:
    """Return the explained variance, the RMS residual and the fraction within the band as text."""
    known = np.isfinite(residual) & np.isfinite(sigma)
    spread = np.var(tau[known]) if known.any() else 0.0
    if not spread > 0:
        return ""
    explained = 1.0 - np.var(residual[known]) / spread
    inside = np.mean(np.abs(residual[known]) < 2 * sigma[known])
    rms = np.sqrt(np.mean(residual[known] ** 2))
    return f"{100 * explained:.2f} % explained, {rms:.2g} N m RMS, {100 * inside:.0f} % in band"


def _scale(residual: np.ndarray, sigma: np.ndarray) -> tuple[float | None, float | None]:
    """Return symmetric limits that contain the band and, except for rare spikes, the residual."""
    sizes = [np.nanquantile(np.abs(residual), 0.999)] if np.isfinite(residual).any() else []
    sizes += [2 * np.nanmedian(sigma)] if np.isfinite(sigma).any() else []
    largest = float(max(sizes, default=0.0))
    return (-1.3 * largest, 1.3 * largest) if largest > 0 else (None, None)


_CLOUD_POINTS = 4_000  # maximum number of points in a cloud; longer logs are thinned
_LAG = 1.0  # s, maximum lag
_MODELS = (MODEL, JOINT_STYLES[0][0], JOINT_STYLES[2][0])


def residual_speed(
    table: Table,
    covariances: Mapping[str, VelocityCovariance] | None = None,
    joints: Sequence[int] | None = None,
    ax: Any = None,
) -> Figure:
    """Plot torque residuals against joint velocity, with the 2-sigma curves of one or several covariance models.

    Parameters
    ----------
    table : log of free motion with qd and tau_error (N, n), from `contact.Estimator.run`.
    covariances : `models.VelocityCovariance` objects, keyed by name.
    joints : indices of the joints to draw, from 0; default: all joints.
    ax : one Axes per joint; default: a new figure.

    Raises
    ------
    UnknownName : a column is missing.
    ShapeError : `table` is not a Table, a joint index is invalid, or the number of Axes is wrong.
    """
    residuals, qd = _residuals(table), table["qd"]
    shown = joints_shown(joints, residuals.shape[1])
    every = max(1, len(qd) // _CLOUD_POINTS)
    peak = np.nanmax(np.abs(qd), axis=0)
    with joint_panels(len(shown), ax) as (figure, axes):
        for panel, i in zip(axes, shown, strict=True):
            cloud(panel, qd[::every, i], residuals[::every, i], "residual")
            half = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 300)]) * (peak[i] if peak[i] > 0 else 1.0)
            speeds = np.concatenate([-half[:0:-1], half])  # dense near zero
            grid = np.repeat(speeds[:, None], residuals.shape[1], axis=1)
            for (name, covariance), color in zip((covariances or {}).items(), _MODELS, strict=False):
                sigma = np.sqrt(covariance.variance(grid)[:, i])
                panel.plot(speeds, 2 * sigma, color=color, linewidth=1.4, label=f"± 2 sigma, {name}")
                panel.plot(speeds, -2 * sigma, color=color, linewidth=1.4, label="_")
            panel.set(title=f"joint {i + 1}", xlabel=label("qd"), ylabel=f"residual [{lookup('tau').unit}]")
        legend(figure, axes[0])
    return figure


def autocorrelation(table: Table, joints: Sequence[int] | None = None, ax: Any = None) -> Axes:
    """Plot the autocorrelation of the torque residuals; white noise stays within the grey band.

    The legend gives the correlation time of each joint: the spacing of effectively independent samples.

    Parameters
    ----------
    table : evenly sampled log of free motion with tau_error (N, n), from `contact.Estimator.run`.
    joints : indices of the joints to draw, from 0; default: all joints.
    ax : Axes to draw into; default: a new figure.

    Raises
    ------
    UnknownName : a column is missing.
    ShapeError : `table` is not a Table, a joint index is invalid, or fewer than 10 rows are complete.
    """
    residuals = _residuals(table)
    shown = joints_shown(joints, residuals.shape[1])
    known = np.asarray(np.isfinite(residuals).all(axis=1))
    if known.sum() < 10:
        raise ShapeError(f"Expected at least 10 rows with a residual to compute an autocorrelation, got {known.sum()}.")
    whole = slice(int(np.argmax(known)), len(known) - int(np.argmax(known[::-1])))
    t, residuals, known = table.t[whole], residuals[whole], known[whole]
    step = float(np.median(np.diff(t)))
    most = min(int(_LAG / step), len(residuals) // 2)
    with single(ax, width=7.5, height=3.6) as (_, panel):
        for i in shown:
            seconds = correlation_time(np.interp(t, t[known], residuals[known, i]), step)
            found, words = _correlation(residuals[:, i], known, most), f"joint {i + 1}: {1e3 * seconds:.0f} ms"
            panel.plot(np.arange(most) * step, found, label=words, **joint_style(i))
        white = 2 / np.sqrt(known.sum())
        panel.axhspan(-white, white, color=GREY, alpha=0.2, linewidth=0.0, label="white noise")
        panel.set(xlabel="lag [s]", ylabel="autocorrelation of the residual")
        panel.legend(loc="upper right", ncols=2)
    return panel


def _residuals(table: Table) -> np.ndarray:
    """Return measured minus modelled torque (N, n)."""
    expect(table, Table)
    for name in ("tau_error", "qd"):
        if name not in table:
            raise UnknownName.among("column of torque residuals", name, table.names)
    return -table["tau_error"]


def _correlation(x: np.ndarray, known: np.ndarray, most: int) -> np.ndarray:
    """Return the autocorrelation (most,) of x (N,), averaged over all pairs of known samples at each lag."""
    size = 2 ** int(np.ceil(np.log2(2 * len(x))))

    def pairs(values: np.ndarray) -> np.ndarray:
        spectrum = np.fft.rfft(values, size)
        return np.fft.irfft(spectrum * np.conj(spectrum), size)[:most]

    count = np.round(pairs(known.astype(float)))
    found = pairs(np.where(known, x - x[known].mean(), 0.0)) / np.where(count > 0, count, np.nan)
    return found / found[0] if found[0] > 0 else found


_VELOCITIES = 601


def velocity_covariance(
    model: Fit[TorqueModel] | TorqueModel | VelocityCovariance, qd_max: float = 1.0, ax: Any = None
) -> Axes:
    """Plot the standard deviation of each joint's torque error against joint velocity.

    Parameters
    ----------
    model : torque model, its fit, or its covariance alone.
    qd_max : limit of the velocity axis, which extends from -qd_max to qd_max [rad/s].
    ax : Axes to draw into; default: a new figure.

    Raises
    ------
    ModelMismatchError : `model` is not a torque model.
    """
    covariance = model if isinstance(model, VelocityCovariance) else value_of(model).covariance
    joints = len(covariance.C0)
    qd = np.linspace(-qd_max, qd_max, _VELOCITIES)
    sigma = np.sqrt(covariance.variance(np.repeat(qd[:, None], joints, axis=1)))
    with single(ax, width=7.5, height=4.0) as (figure, panel):
        for i in range(joints):
            panel.plot(qd, sigma[:, i], linewidth=1.4, label=f"joint {i + 1}", **joint_style(i))
        panel.set_yscale("log")
        panel.set(xlabel=label("qd"), ylabel=f"sigma of the torque error [{lookup('tau').unit}]")
        panel.set_ylim(0.7 * sigma.min(), 1.4 * sigma.max())
        legend(figure, panel)
    return panel


_WEAK, _REFUSED = 300.0, 1e4  # condition-number limits of the fits


def excitation(found: Excitation, ax: Any = None) -> Axes:
    """Plot the singular values of the scaled regressor in descending order, relative to the largest singular value.

    Directions below 1/300 are weakly excited and need a longer or richer log. Below 1/10000, the fit raises NotExcited.

    Parameters
    ----------
    found : excitation of a fit, ``fit.excitation``.
    ax : Axes to draw into; default: a new figure.

    Raises
    ------
    ShapeError : `found` is not an Excitation, or has no positive singular values.
    """
    expect(found, Excitation)
    values = found.singular_values
    if not len(values) or not values[0] > 0:
        raise ShapeError(f"Expected positive singular values to draw, got {len(values)} values. Use fit.excitation.")
    relative = np.where(values > 0, values / values[0], np.nan)
    with single(ax, width=7.5, height=3.2) as (_, panel):
        panel.semilogy(np.arange(1, len(values) + 1), relative, "o-", color=JOINT_STYLES[0][0], markersize=3.5)
        for condition, color, words in ((_WEAK, GREY, "weak below"), (_REFUSED, MODEL, "refused below")):
            panel.axhline(1 / condition, color=color, linestyle="--")
            panel.text(1, 1.1 / condition, words, color=color, fontsize=8.0, va="bottom")
        panel.set(xlabel="direction", ylabel="singular value, relative")
        panel.set_title(f"condition {found.condition:.0f}; weakest: {found.weakest}", wrap=True)
    return panel
