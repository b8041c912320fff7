"""Is the stated uncertainty true, and what could be seen at all."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import UnknownName
from armlab.glossary import label
from armlab.log import Table
from armlab.plots.arguments import expect
from armlab.plots.style import AXIS_COLORS, GREY, JOINT_STYLES, legend, line, look, panels, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


__all__ = ["coverage", "coverage_by_speed", "observability"]

EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the peak speed
NOMINAL = 95.4  # % of a normal variable inside two sigma
_FEWEST = 50  # samples in a bin that says anything
_WEAK = 0.5
_AXES = ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")


def coverage(table: Table, ax: Any = None) -> Axes:
    """Draw the share of errors inside two sigma per bin of speed; a true uncertainty holds 95.4 % in each.

    Of a table with tau_sigma (from `identify.predict`) the torque of each joint over its own speed; of one with
    wrench_hat each axis of the wrench over the fastest joint, against wrench_true or the sensor's `wrench`. Speeds are
    shares of the joint's peak in the table. Bins of fewer than 50 samples are left out.

    Parameters
    ----------
    table : as above, with qd (N, n).
    ax : Axes to draw into; a new figure when None.

    Raises
    ------
    UnknownName : the table has neither, or nothing to compare the wrench with. ShapeError : no table.
    """
    names, shares = coverage_by_speed(table)
    with look():
        _, axes = panels(1, 1, ax, width=7.5, height=3.6)
        panel: Axes = axes[0, 0]
        places = np.arange(len(EDGES) - 1)
        for i, name in enumerate(names):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            panel.plot(places, 100 * shares[i], "o", linestyle=style, color=color, markersize=4, label=name)
        panel.axhline(NOMINAL, color=GREY, linestyle="--", label=f"{NOMINAL} %")
        panel.set_xticks(places, [f"{100 * a:g} to {100 * b:g} %" for a, b in pairwise(EDGES)])
        panel.set_xlabel("speed, share of its peak")
        panel.set_ylabel("inside 2 sigma [%]")
        known = shares[np.isfinite(shares)]
        panel.set_ylim(min(80.0, 100 * float(known.min(initial=1.0)) - 2.0), 101.0)
        panel.legend(loc="lower right", ncols=4)
    return panel


def coverage_by_speed(table: Table) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of joints or axes and the share (k, 5) of their errors inside two sigma, per bin of speed.

    Parameters
    ----------
    table : as of `coverage`.

    Raises
    ------
    UnknownName : as of `coverage`.
    """
    expect(table, Table)
    if "qd" not in table:
        raise UnknownName.among("column of a coverage figure", "qd", table.names)
    speed = np.abs(table["qd"]) / np.maximum(np.nanmax(np.abs(table["qd"]), axis=0), 1e-12)
    if "tau_sigma" in table:
        error, sigma = table["tau"] - table["tau_model"], table["tau_sigma"]
        names = table.columns["tau"].labels or tuple(f"joint {i + 1}" for i in range(error.shape[1]))
    else:
        truth = next((name for name in ("wrench_true", "wrench") if name in table), None)
        if truth is None or "wrench_hat_cov" not in table:
            raise UnknownName.among(
                "column of a coverage figure", "tau_sigma, or wrench_hat_cov with wrench_true or wrench", table.names
            )
        error = table["wrench_hat"] - table[truth]
        sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
        names, speed = _AXES, np.repeat(speed.max(axis=1)[:, None], 6, axis=1)
    return names, _shares(error, sigma, speed)


def _shares(error: np.ndarray, sigma: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the share (k, bins) of samples inside two sigma; NaN where a bin holds too few."""
    shares = np.full((error.shape[1], len(EDGES) - 1), np.nan)
    for i in range(error.shape[1]):
        known = np.isfinite(error[:, i]) & np.isfinite(sigma[:, i])
        place = np.clip(np.digitize(speed[:, i], EDGES) - 1, 0, len(EDGES) - 2)
        inside = np.abs(error[:, i]) <= 2 * sigma[:, i]
        for k in range(len(EDGES) - 1):
            rows = known & (place == k)
            if rows.sum() >= _FEWEST:
                shares[i, k] = inside[rows].mean()
    return shares


def observability(table: Table, ax: Any = None) -> Figure:
    """Draw how well the torques showed each axis of the wrench over time: 1 they determine it, 0 only the prior speaks.

    Times when an axis is weak (below 0.5) are shaded.

    Parameters
    ----------
    table : with observability (N, 6), from `contact.Estimator.run`.
    ax : two Axes (forces, moments); a new figure when None.

    Raises
    ------
    UnknownName : the table has none. ShapeError : no table, or another number of Axes.
    """
    expect(table, Table)
    if "observability" not in table:
        raise UnknownName.among("column of an observability figure", "observability", table.names)
    values = table["observability"]
    with look():
        figure, axes = panels(2, 1, ax, width=10.0, height=1.8, sharex=True, sharey=True)
        for row, panel in enumerate(axes[:, 0]):
            part = values[:, 3 * row : 3 * row + 3]
            shade(panel, table.t, np.any(part < _WEAK, axis=1), label="weak")
            for i in range(3):
                line(panel, table.t, part[:, i], color=AXIS_COLORS[i], label=_AXES[3 * row + i][-1])
            panel.axhline(_WEAK, color=GREY, linestyle="--", linewidth=0.8)
            panel.set_ylabel(("force", "moment")[row])
            panel.set_ylim(-0.02, 1.04)
        axes[0, 0].set_title("observability per axis, base axes")
        axes[1, 0].set_xlabel(label("t"))
        legend(figure, *axes[:, 0])
    return figure
