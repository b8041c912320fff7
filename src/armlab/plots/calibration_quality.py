"""Figure of a calibration: residuals, their distribution, and the uncertainty of the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import GREY
from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.plots.model import excitation
from armlab.plots.style import JOINT_STYLES, expect, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SINGLE = ("distance", "pair distance", "point", "line")  # noise classes with one number per sample
_EDGE = 0.03  # margin beside the first and last marker, relative to the width
_MOST = 3  # maximum number of ellipses


def calibration(fit: Fit[Any], truth: ArrayLike | None = None, ax: Any = None) -> Figure:
    """Plot the residuals of each sample, their quantiles, the 2-sigma ellipses and the excitation of a calibration.

    Residuals are divided by the standard deviation of their noise class. A straight quantile plot indicates normally
    distributed residuals. The 2-sigma ellipse of two parameters contains 86 % of the probability.

    Parameters
    ----------
    fit : from a `fit_*` function of `calibrate`. A fit loaded from a file has no residuals, so only the last two panels
        are drawn.
    truth : true parameters (d,), if known, drawn as crosses in the ellipses.
    ax : four Axes, or two for a loaded fit; default: a new figure.

    Returns
    -------
    The Figure with four or two panels.

    Raises
    ------
    ShapeError : `fit` is not a Fit, or the number of true parameters or Axes is wrong.
    """
    expect(fit, Fit)
    true = None if truth is None else np.asarray(truth, dtype=float)
    if true is not None and true.shape != fit.parameters.shape:
        raise ShapeError(f"Expected {len(fit.parameters)} true parameters to draw, got shape {true.shape}.")
    with panels(2 if fit.residuals.size else 1, 2, ax, width=10.0, height=3.4) as (figure, axes):
        if fit.residuals.size:
            groups = _groups(fit)
            _per_sample(axes[0, 0], groups, fit.outliers)
            _quantiles(axes[0, 1], groups, fit.outliers)
        ellipses, told = axes[-1]
        _ellipses(ellipses, fit, true)
        excitation(fit.excitation, told)
    return figure


def _groups(fit: Fit[Any]) -> dict[str, np.ndarray]:
    """Return the residuals (N, k) of each noise class, divided by its standard deviation."""
    rows = fit.residuals.reshape(len(fit.residuals), -1)
    owner = _owners(fit.classes, rows.shape[1])
    if owner is None or fit.sigma.size != len(fit.classes) or not np.all(fit.sigma > 0):
        size = np.sqrt(np.nanmean(rows**2, axis=0))
        return {"residual": rows / np.where(size > 0, size, 1.0)}
    return {name: rows[:, owner == k] / fit.sigma.ravel()[k] for k, name in enumerate(fit.classes)}


def _owners(classes: Sequence[str], columns: int) -> np.ndarray | None:
    """Return the noise class of each column, or None if it is ambiguous.

    The sequence of noise classes repeats across the columns, with three columns per class (one for a distance or line).
    """
    if len(classes) == 1:
        return np.zeros(columns, dtype=int)
    once = np.repeat(np.arange(len(classes)), [1 if name.split(" [")[0] in _SINGLE else 3 for name in classes])
    return np.resize(once, columns) if len(once) and columns % len(once) == 0 else None


def _per_sample(panel: Axes, groups: dict[str, np.ndarray], outliers: np.ndarray) -> None:
    """Plot the residual norm of each sample and class, with outliers as crosses."""
    for (name, part), (color, _) in zip(groups.items(), JOINT_STYLES, strict=False):
        count = np.isfinite(part).sum(axis=1)
        size = np.sqrt(np.nansum(part**2, axis=1) / np.where(count > 0, count, np.nan))  # NaN: not measured
        bad = outliers if len(outliers) == len(size) else np.zeros(len(size), dtype=bool)
        good = ~bad & np.isfinite(size)
        panel.plot(np.flatnonzero(good), size[good], "o", color=color, markersize=3.0, label=name)
        if bad.any():
            panel.plot(np.flatnonzero(bad), size[bad], "x", color=GREY, markersize=5.0, label="excluded")
    panel.set_yscale("log" if outliers.any() else "linear")
    panel.set(xlabel="sample", ylabel="residual / sigma")
    handles, labels = panel.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    panel.legend(
        once.values(), once.keys(), loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(once), borderaxespad=0.2,
        handletextpad=0.1, columnspacing=1.0,
    )  # fmt: skip
    panel.margins(x=_EDGE, y=_EDGE)
    panel.set_title("residuals")


def _quantiles(panel: Axes, groups: dict[str, np.ndarray], outliers: np.ndarray) -> None:
    """Plot the sorted residuals of the inliers against the quantiles of the normal distribution."""
    from scipy.special import ndtri

    widest = 1.0
    for (name, part), (color, _) in zip(groups.items(), JOINT_STYLES, strict=False):
        kept = part[~outliers] if len(outliers) == len(part) else part
        values = np.sort(kept[np.isfinite(kept)])
        at = ndtri((np.arange(len(values)) + 0.5) / len(values)) if len(values) else values
        panel.plot(at, values, ".", color=color, markersize=3.0, label=name)
        widest = max([widest, *np.abs(at[:1])])
    panel.plot([-widest, widest], [-widest, widest], color=GREY, linestyle="--", label="normal")
    panel.set(xlabel="normal quantile", ylabel="residual / sigma")
    panel.legend(loc="upper left")
    panel.margins(x=_EDGE, y=_EDGE)
    panel.set_title("quantiles")


def _ellipses(panel: Axes, fit: Fit[Any], true: np.ndarray | None) -> None:
    """Draw the 2-sigma ellipses of the first parameter pairs with equal units, centred at the estimate."""
    round_ = np.linspace(0.0, 2.0 * np.pi, 91)
    circle = np.stack([np.cos(round_), np.sin(round_)])
    for at, (color, _) in zip(_pairs(fit), JOINT_STYLES, strict=False):
        size, axes = np.linalg.eigh(fit.cov[np.ix_(at, at)])
        x, y = 2.0 * (axes * np.sqrt(np.maximum(size, 0.0))) @ circle
        names = " and ".join(fit.names[i] for i in at)
        panel.plot(x, y, color=color, label=f"{names} [{fit.units[at[0]]}]")
        if true is not None:
            off = (true - fit.parameters)[at]
            panel.plot(off[0], off[1], "x", color=color, label="_truth")
    panel.axhline(0.0, color=GREY, linewidth=0.5)
    panel.axvline(0.0, color=GREY, linewidth=0.5)
    panel.set_aspect("equal", adjustable="datalim")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_major_formatter("{x:g}")
    panel.set(xlabel="error of the first parameter", ylabel="error of the second parameter")
    panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2))
    panel.set_title("2-sigma ellipses around the estimate")


def _pairs(fit: Fit[Any]) -> list[list[int]]:
    """Return the indices of adjacent parameter pairs with equal units; of three such parameters, use the first two."""
    found: list[list[int]] = []
    i = 0
    while i + 1 < len(fit.names) and len(found) < _MOST:
        if fit.units[i] == fit.units[i + 1] and fit.sd[i] > 0 and fit.sd[i + 1] > 0:
            found.append([i, i + 1])
            i += 3
        else:
            i += 1
    return found
