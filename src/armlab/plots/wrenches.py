"""The contact wrench over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.contact import contacts
from armlab.errors import ShapeError, UnknownName, shortened
from armlab.glossary import label, lookup
from armlab.log import Table
from armlab.plots.arguments import expect
from armlab.plots.style import AXIS_COLORS, GREY, band, legend, line, look, panels, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


__all__ = ["wrench", "wrenches"]

_SHADE = "#B3B3B3"


def wrench(table: Table, ax: Any = None) -> Figure:
    """Draw the estimated wrench, one panel per axis, with two-sigma bands; contact is shaded.

    The true wrench (`wrench_true`), that of a force sensor (`wrench`) and guaranteed limits (`wrench_interval`) are
    drawn where the table has them. Forces share one scale and moments another, chosen by the estimates: a band that is
    wider is cut off.

    Parameters
    ----------
    table : with wrench_hat (N, 6), and wrench_hat_cov (N, 6, 6) for the bands; base axes, at the tool point.
    ax : (3, 2) Axes, or 3 for the forces alone; a new figure when None.

    Raises
    ------
    UnknownName : the table has no wrench_hat. ShapeError : no table, or `ax` has another number of Axes.
    """
    expect(table, Table)
    if "wrench_hat" not in table:
        raise UnknownName.among("column of a wrench figure", "wrench_hat", table.names)
    columns = 1 if ax is not None and np.size(ax) == 3 else 2
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"])) if "wrench_hat_cov" in table else None
    touched = np.zeros(len(table), dtype=bool)
    for contact in contacts(table) if sigma is not None else ():
        touched |= (table.t >= contact.start) & (table.t <= contact.end)
    with look():
        figure, axes = panels(3, columns, ax, width=10.0, height=1.9, sharex=True)
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
    """Draw the estimated forces of several arms side by side, one column each, on one scale.

    Parameters
    ----------
    tables : name of the arm -> table as of `wrench`.
    ax : (3, k) Axes for k arms; a new figure when None.

    Raises
    ------
    UnknownName : a table has no wrench_hat. ShapeError : no table, or `ax` has another number of Axes.
    """
    if not isinstance(tables, Mapping) or not tables:
        raise ShapeError(f"Expected {{name: table}} of at least one arm to draw, got {shortened(tables)}.")
    with look():
        figure, axes = panels(3, len(tables), ax, width=max(6.0, 4.5 * len(tables)), height=1.9, sharex="col")
        for column, (name, table) in enumerate(tables.items()):
            wrench(table, ax=axes[:, column])
            axes[0, column].set_title(name, fontweight="bold")
    limit = max(panel.get_ylim()[1] for panel in axes.ravel())
    for panel in axes.ravel():
        panel.set_ylim(-limit, limit)
    for extra in figure.legends[1:]:  # one for all
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
    """Return the end of the scale: what the lines need, and room for the usual band."""
    part = slice(3 * column, 3 * column + 3)
    lines = [table[name][:, part] for name in ("wrench_hat", "wrench_true", "wrench") if name in table]
    sizes = [np.nanquantile(np.abs(array), 0.9995) for array in lines if np.isfinite(array).any()]
    if sigma is not None and np.isfinite(sigma).any():
        sizes.append(1.5 * float(np.nanmedian(2 * sigma[:, part])))
    largest = max(sizes, default=0.0)
    return 1.2 * largest if largest > 0 else 1.0
