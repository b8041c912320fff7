"""Contact figures: wrench, hypothesis probabilities, coverage of the uncertainty, observability."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab._display import AXIS_COLORS, GREY
from armlab.contact import contacts
from armlab.contact.contacts import Hypotheses
from armlab.errors import ShapeError, UnknownName, shortened
from armlab.glossary import label, lookup
from armlab.log import Table
from armlab.plots.style import JOINT_STYLES, band, expect, joint_names, joint_style, legend, line, panels, shade, single

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHADE = "#B3B3B3"


def wrench(table: Table, ax: Any = None) -> Figure:
    """Plot the estimated wrench against time, one panel per axis, with 2-sigma bands; contact intervals are shaded.

    The true wrench (`wrench_true`), the measured wrench (`wrench`) and guaranteed limits (`wrench_interval`) are drawn
    if the table contains them. All forces have the same scale, and so do all moments. The estimates determine the
    scales; wider bands are clipped.

    Parameters
    ----------
    table : table with wrench_hat (N, 6) and, for the bands, wrench_hat_cov (N, 6, 6), in base axes at the tool point.
    ax : Axes (3, 2), or three Axes for the forces only; default: a new figure.

    Raises
    ------
    UnknownName : the table has no wrench_hat.
    ShapeError : `table` is not a Table, or the number of Axes is wrong.
    """
    expect(table, Table)
    if "wrench_hat" not in table:
        raise UnknownName.among("column of a wrench figure", "wrench_hat", table.names)
    columns = 1 if ax is not None and np.size(ax) == 3 else 2
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"])) if "wrench_hat_cov" in table else None
    touched = np.zeros(len(table), dtype=bool)
    for contact in contacts(table) if sigma is not None else ():
        touched |= (table.t >= contact.start) & (table.t <= contact.end)
    with panels(3, columns, ax, width=10.0, height=1.9, sharex=True) as (figure, axes):
        for column in range(columns):
            limit = _limit(table, sigma, column)
            for row in range(3):
                _panel(axes[row, column], table, sigma, 3 * column + row, touched)
                axes[row, column].set_ylim(-limit, limit)
            axes[2, column].set_xlabel(label("t"))
            axes[0, column].set_title(("force", "moment")[column] + ", base axes, at the tool point")
        legend(figure, axes[0, 0])
        figure.align_ylabels()
    return figure


def wrenches(tables: Mapping[str, Table], ax: Any = None) -> Figure:
    """Plot the estimated forces of several arms side by side on the same scale, one column per arm.

    Parameters
    ----------
    tables : tables as in `wrench`, keyed by arm name.
    ax : Axes (3, k) for k arms; default: a new figure.

    Raises
    ------
    UnknownName : a table has no wrench_hat.
    ShapeError : `tables` does not contain Tables, or the number of Axes is wrong.
    """
    if not isinstance(tables, Mapping) or not tables:
        raise ShapeError(f"Expected {{name: table}} with at least one arm to draw, got {shortened(tables)}.")
    with panels(3, len(tables), ax, width=max(6.0, 4.5 * len(tables)), height=1.9, sharex="col") as (figure, axes):
        for column, (name, table) in enumerate(tables.items()):
            wrench(table, ax=axes[:, column])
            axes[0, column].set_title(name, fontweight="bold")
    limit = max(panel.get_ylim()[1] for panel in axes.ravel())
    for panel in axes.ravel():
        panel.set_ylim(-limit, limit)
    for extra in figure.legends[1:]:  # one legend for all panels
        extra.remove()
    return figure


def _panel(ax: Axes, table: Table, sigma: np.ndarray | None, i: int, touched: np.ndarray) -> None:
    unit = lookup("wrench_hat").unit.split(", ")[i // 3]
    color, t = AXIS_COLORS[i % 3], table.t
    shade(ax, t, touched, color=_SHADE, alpha=0.35, label="contact")
    if sigma is not None:
        band(ax, t, table["wrench_hat"][:, i], 2 * sigma[:, i], color=color, alpha=0.22, label="± 2 sigma")
    if "wrench_interval" in table:
        for side, word in enumerate(("limits", "_")):
            limit = table["wrench_interval"][:, i, side]
            line(ax, t, limit, color=color, linewidth=0.8, linestyle=":", label=word)
    if "wrench" in table:
        line(ax, t, table["wrench"][:, i], color=GREY, linewidth=0.9, label="sensor")
    line(ax, t, table["wrench_hat"][:, i], color=color, linewidth=1.0, label="estimate")
    if "wrench_true" in table:
        line(ax, t, table["wrench_true"][:, i], color="black", linewidth=1.1, linestyle="--", label="true")
    ax.set_ylabel(f"{'fm'[i // 3]}_{'xyz'[i % 3]} [{unit}]")


def _limit(table: Table, sigma: np.ndarray | None, column: int) -> float:
    """Return an axis limit that leaves room for the lines and a band of typical width."""
    part = slice(3 * column, 3 * column + 3)
    lines = [table[name][:, part] for name in ("wrench_hat", "wrench_true", "wrench") if name in table]
    sizes = [np.nanquantile(np.abs(array), 0.9995) for array in lines if np.isfinite(array).any()]
    if sigma is not None and np.isfinite(sigma).any():
        sizes.append(1.5 * float(np.nanmedian(2 * sigma[:, part])))
    largest = max(sizes, default=0.0)
    return 1.2 * largest if largest > 0 else 1.0


_LEAST = 0.02  # peak probability; less probable hypotheses are merged


def hypotheses(found: Hypotheses, ax: Any = None) -> Axes:
    """Plot stacked hypothesis probabilities against time, with a bar while contact on a link is possible.

    Parameters
    ----------
    found : from `contact.hypotheses`.
    ax : Axes to draw into; default: a new figure.

    Raises
    ------
    ShapeError : `found` is not of type Hypotheses, or `ax` is not one Axes.
    """
    expect(found, Hypotheses)
    with single(ax, width=10.0, height=2.8) as (figure, panel):
        shown = found.posterior.max(axis=0) >= _LEAST
        parts = [found.posterior[:, i] for i in np.flatnonzero(shown)]
        names = [name for name, large in zip(found.names, shown) if large]
        colors = ["#D9D9D9" if name == "none" else JOINT_STYLES[i % 7][0] for i, name in enumerate(names)]
        if not shown.all():
            parts, names, colors = [*parts, found.posterior[:, ~shown].sum(axis=1)], [*names, "others"], [*colors, GREY]
        panel.stackplot(found.t, parts, labels=names, colors=colors, alpha=0.8, step="mid", linewidth=0)
        doubt = np.where(found.link, 0.985, np.nan)
        panel.plot(found.t, doubt, color="black", linewidth=3.0, marker="s", markersize=3.0, label="possibly on a link")
        panel.set_ylim(0.0, 1.0)
        panel.set(xlabel=label("t"), ylabel="probability")
        legend(figure, panel)
    return panel


EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # bin edges, relative to the peak speed
NOMINAL = 95.4  # %, two-sigma coverage of a normal distribution
_FEWEST = 50  # minimum number of samples in a bin
_WEAK = 0.5
_AXES = ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")


def coverage(table: Table, ax: Any = None) -> Axes:
    """Plot the fraction of errors within 2 sigma against speed; a well-calibrated uncertainty covers 95.4 %.

    With tau_sigma (from `identify.predict`), the figure shows the coverage of each joint torque against the speed of
    that joint. With wrench_hat, it shows the coverage of each wrench axis against the speed of the fastest joint; the
    reference is wrench_true or the sensor's `wrench`. Speeds are relative to the joint's peak speed in the table. Bins
    with fewer than 50 samples are omitted.

    Parameters
    ----------
    table : table with the columns named above and qd (N, n).
    ax : Axes to draw into; default: a new figure.

    Raises
    ------
    UnknownName : the table has neither tau_sigma nor wrench_hat, or no reference for the wrench.
    ShapeError : `table` is not a Table.
    """
    names, shares = coverage_by_speed(table)
    with single(ax, width=7.5, height=3.6) as (_, panel):
        places = np.arange(len(EDGES) - 1)
        for i, name in enumerate(names):
            panel.plot(places, 100 * shares[i], "o", markersize=4, label=name, **joint_style(i))
        panel.axhline(NOMINAL, color=GREY, linestyle="--", label=f"{NOMINAL} %")
        panel.set_xticks(places, [f"{100 * a:g} to {100 * b:g} %" for a, b in pairwise(EDGES)])
        panel.set(xlabel="speed relative to its peak", ylabel="within 2 sigma [%]")
        known = shares[np.isfinite(shares)]
        panel.set_ylim(min(80.0, 100 * float(known.min(initial=1.0)) - 2.0), 101.0)
        panel.legend(loc="lower right", ncols=4)
    return panel


def coverage_by_speed(table: Table) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of joints or axes, and the fraction (k, 5) of errors within 2 sigma in each speed bin."""
    expect(table, Table)
    if "qd" not in table:
        raise UnknownName.among("column of a coverage figure", "qd", table.names)
    speed = np.abs(table["qd"]) / np.maximum(np.nanmax(np.abs(table["qd"]), axis=0), 1e-12)
    if "tau_sigma" in table:
        error, sigma = table["tau"] - table["tau_model"], table["tau_sigma"]
        names = joint_names(table, error.shape[1])
    else:
        truth = next((name for name in ("wrench_true", "wrench") if name in table), None)
        if truth is None or "wrench_hat_cov" not in table:
            raise UnknownName.among(
                "column of a coverage figure", "tau_sigma, or wrench_hat_cov with wrench_true or wrench", table.names
            )
        error = table["wrench_hat"] - table[truth]
        sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
        names, speed = _AXES, np.repeat(speed.max(axis=1)[:, None], 6, axis=1)
    shares = np.full((error.shape[1], len(EDGES) - 1), np.nan)
    known, inside = np.isfinite(error) & np.isfinite(sigma), np.abs(error) <= 2 * sigma
    place = np.clip(np.digitize(speed, EDGES) - 1, 0, len(EDGES) - 2)
    for i, k in np.ndindex(shares.shape):
        rows = known[:, i] & (place[:, i] == k)
        if rows.sum() >= _FEWEST:
            shares[i, k] = inside[rows, i].mean()
    return names, shares


def observability(table: Table, ax: Any = None) -> Figure:
    """Plot the observability of each wrench axis against time, from 0 (prior alone) to 1 (determined by the torques).

    Intervals with a weakly observable axis (below 0.5) are shaded.

    Parameters
    ----------
    table : table with observability (N, 6), from `contact.Estimator.run`.
    ax : two Axes (forces, moments); default: a new figure.

    Raises
    ------
    UnknownName : the table has no observability.
    ShapeError : `table` is not a Table, or the number of Axes is wrong.
    """
    expect(table, Table)
    if "observability" not in table:
        raise UnknownName.among("column of an observability figure", "observability", table.names)
    values = table["observability"]
    with panels(2, 1, ax, width=10.0, height=1.8, sharex=True, sharey=True) as (figure, axes):
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
