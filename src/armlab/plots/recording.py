"""Figures of a recording: columns of its table, poses, and loop latency."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import AXIS_COLORS, GREY
from armlab._numbers import flag, numbers
from armlab.errors import ShapeError, UnknownName
from armlab.glossary import label
from armlab.lie import quaternion
from armlab.log import Table
from armlab.log.column import heading
from armlab.plots.space import pose_stack
from armlab.plots.style import JOINT_STYLES, expect, joint_style, legend, line, panels, shade, single

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHES: dict[str, tuple[Any, str]] = {"_ref": ((0, (6, 2.5)), "commanded"), "_sent": ((0, (2, 1.5)), "sent")}
"""Dash pattern and legend text by suffix of the column name."""
_USUAL = ("q", "qd", "tau", "wrench_hat")
_MOST_COMPONENTS = 14


def table(data: Table, *names: str, split: bool = False, ax: Any = None) -> Axes | Figure:
    """Plot columns against time, with one panel per quantity and one colour per joint.

    Columns that differ only in ``_ref`` or ``_sent`` share a panel; commanded and sent values are dashed. Intervals
    with an active command limit are shaded.

    Parameters
    ----------
    data : the table.
    names : columns; default: q, qd, tau and wrench_hat, if they exist.
    split : draw one panel per component (joint) instead of one panel per quantity.
    ax : Axes to draw into, one per panel; default: a new figure.

    Returns
    -------
    The Axes of a single panel, or the Figure of several panels.

    Raises
    ------
    UnknownName : a column does not exist, or no default column exists.
    ShapeError : `data` is not a Table, a column has text or too many components, or the number of Axes is wrong.
    """
    expect(data, Table)
    names = names or tuple(name for name in _USUAL if name in data)
    if not names:
        raise UnknownName.among("column to draw", " or ".join(_USUAL), data.names)
    quantities: dict[str, list[str]] = {}
    for name in names:
        count = 0 if data[name].dtype.kind == "U" else int(np.prod(data[name].shape[1:]))
        if not 0 < count <= _MOST_COMPONENTS:
            raise ShapeError(f"Expected at most {_MOST_COMPONENTS} numbers per row to draw in {name}, got {count}.")
        quantities.setdefault(_quantity(name), []).append(name)
    split = flag(split, "split of a drawn table")
    parts = [
        (shown, component)
        for shown in quantities.values()
        for component in (range(int(np.prod(data[shown[0]].shape[1:]))) if split else (None,))
    ]
    with panels(len(parts), 1, ax, width=9.0, height=1.5 if split else 2.2, sharex=True) as (figure, axes):
        for panel, (shown, component) in zip(axes[:, 0], parts, strict=True):
            _draw(panel, data, shown, component)
        axes[-1, 0].set_xlabel(label("t"))
        figure.align_ylabels()
        _legends(list(axes[:, 0]))
    return axes[0, 0] if len(parts) == 1 else figure


def _draw(ax: Axes, data: Table, names: list[str], component: int | None) -> None:
    """Draw one or all components of a quantity's columns."""
    ax.set_ylabel(heading(data.columns[names[0]], _quantity(names[0])))
    for name in names:
        flat = data[name].reshape(len(data), -1)
        dashes, word = next((_DASHES[end] for end in _DASHES if name.endswith(end)), (None, None))
        for i in range(flat.shape[1]) if component is None else (component,):
            style = joint_style(i) | ({"linestyle": dashes} if word else {})
            line(ax, data.t, flat[:, i], label="_" if word or component is not None else _label(data, name, i), **style)
        if word:
            ax.plot([], [], color=GREY, linestyle=dashes, label=word)
    if component is not None:
        ax.set_title(_label(data, names[0], component))
    if "clamped" in data and _quantity(names[0]) in ("q", "qd", "tau"):
        clamped = np.nan_to_num(data["clamped"]) != 0
        shade(ax, data.t, clamped.any(axis=1) if component is None else clamped[:, component], label="limit active")


def _legends(axes: list[Axes]) -> None:
    """Put a legend to the right of each panel, omitting lines already listed in a legend above it."""
    said: set[str] = set()
    for ax in axes:
        handles, names = ax.get_legend_handles_labels()
        new = {name: handle for name, handle in zip(names, handles, strict=True) if name not in said}
        if new:
            ax.legend(new.values(), new, loc="upper left", bbox_to_anchor=(1.0, 1.03), borderaxespad=0.3)
        said |= set(new)


def _label(data: Table, name: str, i: int) -> str:
    """Return the name of a component: the joint name, or the column name with an index."""
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


def poses(T: ArrayLike, t: ArrayLike | None = None, *, rotation: bool = True, ax: Any = None) -> Axes | Figure:
    """Plot the positions of poses against time, with the rotation vectors in a second panel.

    The rotation vector starts at an angle of at most π and is continuous up to a full revolution.

    Parameters
    ----------
    T : poses (N, 4, 4); NaN leaves a gap.
    t : times (N,) [s]; default: the sample index.
    rotation : also draw the rotation vector.
    ax : two Axes to draw into, or one without `rotation`; default: a new figure.

    Returns
    -------
    The Figure with both panels, or the Axes of a single panel.

    Raises
    ------
    ShapeError : a pose is invalid, `t` does not contain one finite time per pose, or the number of Axes is wrong.
    """
    T = pose_stack(T)
    times = np.arange(len(T), dtype=float) if t is None else numbers(t, "t", ShapeError)
    if times.shape != (len(T),) or not np.isfinite(times).all():
        raise ShapeError(f"Expected {len(T)} finite times, one per pose, got t of shape {times.shape}.")
    drawn = [("position [m]", T[:, :3, 3])]
    if rotation:
        drawn.append(("rotation vector [rad]", _rotation_vectors(T[:, :3, :3])))
    with panels(len(drawn), 1, ax, width=8.0, height=2.2, sharex=True) as (figure, axes):
        for panel, (name, values) in zip(axes[:, 0], drawn, strict=True):
            for i, color in enumerate(AXIS_COLORS):
                line(panel, times, values[:, i], color=color, linestyle=("-", "--", "-.")[i], label="xyz"[i])
            panel.set_ylabel(name)
        axes[-1, 0].set_xlabel("sample" if t is None else label("t"))
        figure.align_ylabels()
        legend(figure, *axes[:, 0])
    return figure if rotation else axes[0, 0]


def _rotation_vectors(R: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (N, 3) of R (N, 3, 3) from continuous quaternions, with angles up to 2π."""
    q = quaternion.continuous(quaternion.from_matrix(R))
    first = q[np.isfinite(q).all(axis=1)][:1]
    q = q * np.where(first[:, 0] < 0, -1.0, 1.0) if len(first) else q
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[:, :1])
    return q[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)


_BINS_PER_DECADE = 40
_QUANTILES = (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0))


def latency(table: Table, ax: Any = None) -> Axes:
    """Plot histograms of the packet-to-reply time, the controller's computing time and the wake-up latency of the loop.

    Parameters
    ----------
    table : recording with receive_ns and send_ns, or step_ns, or wake_ns (N,).
    ax : Axes to draw into; default: a new figure.

    Returns
    -------
    The Axes. The legend gives p50, p99, p99.9 and the maximum, and the title gives the numbers of missed and late
    ticks.

    Raises
    ------
    UnknownName : the table has no loop times.
    ShapeError : `table` is not a Table, or has no positive loop time.
    """
    from matplotlib.ticker import EngFormatter

    spans = _spans(table)
    shortest, longest = min(map(np.min, spans.values())), max(map(np.max, spans.values()))
    low, high = 10 ** np.floor(np.log10(shortest)), 10 ** np.ceil(np.log10(longest * 1.001))
    bins = np.geomspace(low, high, max(round(np.log10(high / low) * _BINS_PER_DECADE), 2))
    words = EngFormatter("s")
    counts = [f"{int(np.nansum(table[name]))} {name}" for name in ("missed", "late") if name in table]
    with single(ax, width=7.5, height=3.8) as (_, panel):
        for (name, values), (color, _) in zip(spans.items(), JOINT_STYLES, strict=False):
            numbers = "  ".join(f"{label} {words(float(f'{np.quantile(values, p):.3g}'))}" for label, p in _QUANTILES)
            panel.hist(values, bins=bins, color=color, alpha=0.35, histtype="stepfilled")
            panel.hist(values, bins=bins, color=color, histtype="step", linewidth=1.2, label=f"{name}:  {numbers}")
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_ylim(0.7, 8.0 * panel.get_ylim()[1])  # room for the legend
        panel.xaxis.set_major_formatter(words)
        panel.set(xlabel="time [s]", ylabel="ticks", title=", ".join([f"{len(table)} ticks", *counts]))
        panel.legend(loc="upper right")
    return panel


def _spans(table: Table) -> dict[str, np.ndarray]:
    """Return the positive durations of each measured part of the loop [s]."""
    expect(table, Table)
    found = {}
    if "receive_ns" in table and "send_ns" in table:
        found["packet to reply"] = (table["send_ns"] - table["receive_ns"]) / 1e9
    if "step_ns" in table:
        found["controller"] = table["step_ns"] / 1e9
    if "wake_ns" in table:
        found["wake-up"] = table["wake_ns"] / 1e9
    if not found:
        raise UnknownName.among("column of loop times", "receive_ns, send_ns, step_ns or wake_ns", table.names)
    kept = {name: values[np.isfinite(values) & (values > 0)] for name, values in found.items()}
    if not any(map(len, kept.values())):
        raise ShapeError(
            f"Expected loop times above 0 s, got only zeros or NaN in {len(table)} rows. Use the log of a run."
        )
    return {name: values for name, values in kept.items() if len(values)}
