"""What a torque model leaves: residuals over speed, and how long they remember."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ShapeError, UnknownName
from armlab.estimation import correlation_time
from armlab.glossary import lookup
from armlab.log import Table
from armlab.models import VelocityCovariance
from armlab.plots.arguments import expect
from armlab.plots.style import GREY, JOINT_STYLES, MODEL, cloud, legend, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["autocorrelation", "residual_speed"]

_COLUMNS = 4  # panels side by side
_POINTS = 4_000  # of a cloud; more are thinned
_LAG = 1.0  # s
_MODELS = (MODEL, JOINT_STYLES[0][0], JOINT_STYLES[2][0])


def residual_speed(
    table: Table,
    covariances: Mapping[str, VelocityCovariance] | None = None,
    joints: Sequence[int] | None = None,
    ax: Any = None,
) -> Figure:
    """Draw torque residuals over joint velocity, with the two-sigma curves of one or several covariance models.

    Parameters
    ----------
    table : of free motion, with qd and tau_error (N, n), from `contact.Estimator.run`.
    covariances : name -> `models.VelocityCovariance`, drawn as curves at two sigma.
    joints : numbers of the joints to draw, from 0; all when None.
    ax : as many Axes as joints; a new figure when None.

    Raises
    ------
    UnknownName : a column is missing. ShapeError : no table, a joint that is not there, or another number of Axes.
    """
    residuals, qd = _residuals(table), table["qd"]
    shown = _joints(residuals, joints)
    every = max(1, len(qd) // _POINTS)
    peak = np.nanmax(np.abs(qd), axis=0)
    with look():
        figure, axes = _grid(len(shown), ax)
        for panel, i in zip(axes, shown, strict=True):
            cloud(panel, qd[::every, i], residuals[::every, i], "residual")
            speeds = _signed(peak[i])
            grid = np.repeat(speeds[:, None], residuals.shape[1], axis=1)
            for (name, covariance), color in zip((covariances or {}).items(), _MODELS, strict=False):
                half = 2 * np.sqrt(covariance.variance(grid)[:, i])
                panel.plot(speeds, half, color=color, linewidth=1.4, label=f"± 2 sigma, {name}")
                panel.plot(speeds, -half, color=color, linewidth=1.4, label="_")
            panel.set_title(f"joint {i + 1}")
            panel.set_xlabel(f"qd [{lookup('qd').unit}]")
            panel.set_ylabel(f"residual [{lookup('tau').unit}]")
        legend(figure, axes[0])
    return figure


def autocorrelation(table: Table, joints: Sequence[int] | None = None, ax: Any = None) -> Axes:
    """Draw the autocorrelation of the torque residuals over the lag; white noise would stay inside the grey band.

    The correlation time of each joint, in the legend, says how many samples count as one.

    Parameters
    ----------
    table : of free motion, with tau_error (N, n), from `contact.Estimator.run`, evenly sampled.
    joints : numbers of the joints to draw, from 0; all when None.
    ax : Axes to draw into; a new figure when None.

    Raises
    ------
    UnknownName : a column is missing. ShapeError : no table, a joint that is not there, fewer than 10 whole rows.
    """
    residuals = _residuals(table)
    shown = _joints(residuals, joints)
    known = np.asarray(np.isfinite(residuals).all(axis=1))
    if known.sum() < 10:
        raise ShapeError(f"Expected at least 10 rows with a residual to correlate, got {known.sum()}.")
    whole = slice(int(np.argmax(known)), len(known) - int(np.argmax(known[::-1])))
    t, residuals, known = table.t[whole], residuals[whole], known[whole]
    step = float(np.median(np.diff(t)))
    most = min(int(_LAG / step), len(residuals) // 2)
    with look():
        _, axes = panels(1, 1, ax, width=7.5, height=3.6)
        panel: Axes = axes[0, 0]
        for i in shown:
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            seconds = correlation_time(np.interp(t, t[known], residuals[known, i]), step)
            panel.plot(
                np.arange(most) * step,
                _correlation(residuals[:, i], known, most),
                color=color,
                linestyle=style,
                label=f"joint {i + 1}: {1e3 * seconds:.0f} ms",
            )
        white = 2 / np.sqrt(known.sum())
        panel.axhspan(-white, white, color=GREY, alpha=0.2, linewidth=0.0, label="white noise")
        panel.set_xlabel("lag [s]")
        panel.set_ylabel("autocorrelation of the residual")
        panel.legend(loc="upper right", ncols=2)
    return panel


def _residuals(table: Table) -> np.ndarray:
    """Return measured minus modelled torque (N, n)."""
    expect(table, Table)
    for name in ("tau_error", "qd"):
        if name not in table:
            raise UnknownName.among("column of torque residuals", name, table.names)
    return -table["tau_error"]


def _joints(residuals: np.ndarray, joints: Sequence[int] | None) -> list[int]:
    n = residuals.shape[1]
    shown = list(range(n)) if joints is None else list(joints)
    if not shown or not all(0 <= i < n for i in shown):
        raise ShapeError(f"Expected numbers of joints from 0 to {n - 1} to draw, got {shown}.")
    return shown


def _grid(count: int, ax: Any) -> tuple[Figure, np.ndarray]:
    """Return as many panels as joints, in rows of up to four; what is too much of a new grid is taken out."""
    if ax is not None:
        figure, axes = panels(1, count, ax)
        return figure, axes[0]
    rows = -(-count // _COLUMNS)
    figure, axes = panels(rows, min(count, _COLUMNS), width=11.0 if count > 1 else 6.5, height=2.6)
    for panel in axes.ravel()[count:]:
        panel.remove()
    return figure, axes.ravel()[:count]


def _signed(peak: float) -> np.ndarray:
    """Return speeds from -peak to peak, close together near zero."""
    half = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 300)]) * (peak if peak > 0 else 1.0)
    return np.concatenate([-half[:0:-1], half])


def _correlation(x: np.ndarray, known: np.ndarray, most: int) -> np.ndarray:
    """Return the autocorrelation (most,) of x (N,), at each lag the mean over the pairs of which both are known."""
    size = 2 ** int(np.ceil(np.log2(2 * len(x))))

    def pairs(values: np.ndarray) -> np.ndarray:
        spectrum = np.fft.rfft(values, size)
        return np.fft.irfft(spectrum * np.conj(spectrum), size)[:most]

    count = np.round(pairs(known.astype(float)))
    found = pairs(np.where(known, x - x[known].mean(), 0.0)) / np.where(count > 0, count, np.nan)
    return found / found[0] if found[0] > 0 else found
