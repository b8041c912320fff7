"""Columns of a table over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab._numbers import flag
from armlab.errors import ShapeError, UnknownName
from armlab.glossary import label
from armlab.log import Table
from armlab.plots.arguments import expect
from armlab.plots.style import GREY, JOINT_STYLES, line, look, panels, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["table"]

_DASHES: dict[str, tuple[Any, str]] = {"_ref": ((0, (6, 2.5)), "asked"), "_sent": ((0, (2, 1.5)), "sent")}
"""Dashes, long and short, of the ending of a name, and their word in the legend."""
_USUAL = ("q", "qd", "tau", "wrench_hat")
_MOST_COMPONENTS = 14


def table(data: Table, *names: str, split: bool = False, ax: Any = None) -> Axes | Figure:
    """Draw columns over time: one panel per quantity, each joint in its own colour, asked and sent values dashed.

    Columns that differ only in ``_ref`` or ``_sent`` share a panel. Times when a limit acted on the command are shaded.

    Parameters
    ----------
    data : the table.
    names : columns; q, qd, tau and wrench_hat, as far as there are, when none is named.
    split : one panel per component (joint) instead of all in one.
    ax : Axes to draw into, as many as panels; a new figure when None.

    Returns
    -------
    The Axes of one panel, or the Figure of several.

    Raises
    ------
    UnknownName : a column does not exist, or none of the usual ones.
    ShapeError : no table; a column is text or has too many components; `ax` has another number of Axes.
    """
    expect(data, Table)
    names = names or tuple(name for name in _USUAL if name in data)
    if not names:
        raise UnknownName.among("column to draw", " or ".join(_USUAL), data.names)
    quantities: dict[str, list[str]] = {}
    for name in names:
        _check(data, name)
        quantities.setdefault(_quantity(name), []).append(name)
    split = flag(split, "split of a drawn table")
    parts = [
        (shown, component)
        for shown in quantities.values()
        for component in (range(_components(data, shown[0])) if split else (None,))
    ]
    with look():
        figure, axes = panels(len(parts), 1, ax, width=9.0, height=1.5 if split else 2.2, sharex=True)
        for panel, (shown, component) in zip(axes[:, 0], parts, strict=True):
            _draw(panel, data, shown, component)
        axes[-1, 0].set_xlabel(label("t"))
        figure.align_ylabels()
        _legends(list(axes[:, 0]))
    return axes[0, 0] if len(parts) == 1 else figure


def _draw(ax: Axes, data: Table, names: list[str], component: int | None) -> None:
    """Draw columns of one quantity, all components or one."""
    ax.set_ylabel(data.columns[names[0]].heading(_quantity(names[0])))
    for name in names:
        flat = data[name].reshape(len(data), -1)
        dashes, word = next((_DASHES[end] for end in _DASHES if name.endswith(end)), (None, None))
        for i in range(flat.shape[1]) if component is None else (component,):
            color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
            line(
                ax,
                data.t,
                flat[:, i],
                color=color,
                linestyle=dashes or style,
                label="_" if word or component is not None else _label(data, name, i),
            )
        if word:
            ax.plot([], [], color=GREY, linestyle=dashes, label=word)
    if component is not None:
        ax.set_title(_label(data, names[0], component))
    if "clamped" in data and _quantity(names[0]) in ("q", "qd", "tau"):
        clamped = np.nan_to_num(data["clamped"]) != 0
        shade(ax, data.t, clamped.any(axis=1) if component is None else clamped[:, component], label="limit acted")


def _legends(axes: list[Axes]) -> None:
    """Put a legend to the right of each panel, of the lines that no panel above it has."""
    said: set[str] = set()
    for ax in axes:
        handles, names = ax.get_legend_handles_labels()
        new = {name: handle for name, handle in zip(names, handles, strict=True) if name not in said}
        if new:
            ax.legend(new.values(), new, loc="upper left", bbox_to_anchor=(1.0, 1.03), borderaxespad=0.3)
        said |= set(new)


def _label(data: Table, name: str, i: int) -> str:
    """Return the name of a component: the joint's, or the column's and its number."""
    if data[name].ndim == 1:
        return name
    labels = data.columns[name].labels
    if data.columns[name].frame == "joint":
        labels = labels or next((c.labels for c in data.columns.values() if c.frame == "joint" and c.labels), ())
        return labels[i] if i < len(labels) else f"joint {i + 1}"
    if data.units[name] == "N, N m":
        return f"{'fm'[i // 3]}_{'xyz'[i % 3]}"
    return labels[i] if labels else f"{_quantity(name)} {i + 1}"


def _quantity(name: str) -> str:
    return name.removesuffix("_ref").removesuffix("_sent")


def _components(data: Table, name: str) -> int:
    return int(np.prod(data[name].shape[1:]))


def _check(data: Table, name: str) -> None:
    count = 0 if data[name].dtype.kind == "U" else _components(data, name)
    if not 0 < count <= _MOST_COMPONENTS:
        raise ShapeError(f"Expected numbers, at most {_MOST_COMPONENTS} per row, to draw in {name}, got {count}.")
