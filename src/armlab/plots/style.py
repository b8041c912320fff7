"""Style of all figures: colours, lines that preserve gaps and spikes, argument checks, and PNG output."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab._display import COLORS, GREY, VERMILION
from armlab.errors import ConfigError, ShapeError, shortened
from armlab.glossary import label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from armlab.log import Table

JOINT_STYLES = tuple((color, style) for style in ("-", "-.") for color in COLORS)
"""Colour and line style of joints 1, 2, ... in all figures."""
MODEL = VERMILION

_MOST_POINTS = 20_000  # maximum number of points in a line; longer lines are drawn as envelopes
_ENVELOPE_COLUMNS = 4_000
_COLUMNS = 4  # joint panels side by side
_RC: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.xmargin": 0.01,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "figure.constrained_layout.use": True,
}


@contextmanager
def look() -> Iterator[None]:
    """Apply armlab's style in a `with` block, and restore the user's settings afterwards."""
    import matplotlib as mpl

    with mpl.rc_context(_RC):
        yield
        interactive = mpl.is_interactive()  # the first figure's notebook backend enables interactive mode
    mpl.interactive(interactive)


@contextmanager
def panels(
    rows: int, columns: int, ax: Any = None, *, width: float = 9.0, height: float = 1.8, **layout: Any
) -> Iterator[tuple[Figure, np.ndarray]]:
    """Yield a figure in armlab's style and its axes (rows, columns); the figure is new or belongs to the caller's Axes
    `ax`."""
    with look():
        if ax is None:
            import matplotlib.pyplot as plt

            size = (width, max(height * rows, 2.6))
            yield plt.subplots(rows, columns, figsize=size, squeeze=False, **layout)
            return
        given = np.atleast_1d(np.asarray(ax, dtype=object))
        if given.size != rows * columns:
            raise ShapeError(f"Expected {rows * columns} Axes in ax= ({rows} x {columns} panels), got {given.size}.")
        given = given.reshape(rows, columns)
        yield given[0, 0].figure, given


@contextmanager
def single(ax: Any, *, width: float, height: float) -> Iterator[tuple[Figure, Axes]]:
    """Yield a figure and its single Axes, as in `panels`."""
    with panels(1, 1, ax, width=width, height=height) as (figure, axes):
        yield figure, axes[0, 0]


def name_rows(figure: Figure, axes: np.ndarray, names: Iterable[str]) -> None:
    """Label the y axes of stacked panels (N, 1) and their common time axis."""
    for panel, name in zip(axes[:, 0], names, strict=True):
        panel.set_ylabel(name)
    axes[-1, 0].set_xlabel(label("t"))
    figure.align_ylabels()


def joint_style(i: int) -> dict[str, Any]:
    """Return the colour and line style of the joint with index i, from 0."""
    color, style = JOINT_STYLES[i % len(JOINT_STYLES)]
    return {"color": color, "linestyle": style}


def joint_names(table: Table, count: int) -> tuple[str, ...]:
    """Return the names of the joints in the torque column of a table."""
    return table.columns["tau"].labels or tuple(f"joint {i + 1}" for i in range(count))


def joints_shown(joints: Sequence[int] | None, n: int) -> list[int]:
    """Return the indices of the joints to draw (from 0); None means all joints."""
    shown = list(range(n)) if joints is None else list(joints)
    if not shown or not all(0 <= i < n for i in shown):
        raise ShapeError(f"Expected joint numbers from 0 to {n - 1} to draw, got {shown}.")
    return shown


@contextmanager
def joint_panels(count: int, ax: Any) -> Iterator[tuple[Figure, np.ndarray]]:
    """Yield a figure and one panel per joint in rows of up to four; unused panels of a new grid are removed."""
    rows = -(-count // _COLUMNS) if ax is None else 1
    columns = min(count, _COLUMNS) if ax is None else count
    with panels(rows, columns, ax, width=11.0 if count > 1 else 6.5, height=2.6) as (figure, axes):
        for panel in axes.ravel()[count:]:
            panel.remove()
        yield figure, axes.ravel()[:count]


def line(ax: Axes, t: np.ndarray, values: np.ndarray, **style: Any) -> None:
    """Plot values (N,) against t; NaN leaves a gap, and more than 20 000 points are drawn as an envelope."""
    ax.plot(*envelope(t, values), **style)


def cloud(ax: Axes, x: np.ndarray, y: np.ndarray, label: str) -> None:
    """Plot y (N,) against x (N,) as small grey points, with a larger marker in the legend."""
    ax.plot(x, y, ".", color=GREY, markersize=1.5, alpha=0.35, label="_")
    ax.plot([], [], ".", color=GREY, markersize=5.0, label=label)


def envelope(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and values to draw: up to 20 000 points unchanged, otherwise the extremes of each segment.

    Segments without values are NaN, to preserve gaps.
    """
    values = np.asarray(values, dtype=float)
    if len(values) <= _MOST_POINTS:
        return t, values
    first, low, high = _extremes(values, values)
    return np.repeat(t[first], 2), np.stack([low, high], axis=1).ravel()


def band(ax: Axes, t: np.ndarray, middle: np.ndarray, half: np.ndarray, **style: Any) -> None:
    """Fill the band from middle - half to middle + half (N,); more than 20 000 points are drawn as an envelope."""
    low, high = np.asarray(middle) - half, np.asarray(middle) + half
    if len(t) > _MOST_POINTS:
        first, low, high = _extremes(low, high)
        t = t[first]
    ax.fill_between(t, low, high, **{"linewidth": 0.0, **style})


def _extremes(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first row, the minimum of `low` and the maximum of `high` of each segment; NaN for empty segments."""
    first = np.linspace(0, len(low), _ENVELOPE_COLUMNS + 1).astype(int)[:-1]
    return first, np.fmin.reduceat(low, first), np.fmax.reduceat(high, first)


def shade(ax: Axes, t: np.ndarray, on: np.ndarray, **style: Any) -> None:
    """Shade the intervals in which a mask (N,) is true, each extended to the next sample.

    An outline keeps intervals of a single sample visible in a long log. Intervals closer than a pixel are merged.
    """
    edges = np.flatnonzero(np.diff(np.asarray(on, dtype=int), prepend=0, append=0)).reshape(-1, 2)
    if not len(edges):
        return
    start, end = t[np.minimum(edges, len(t) - 1)].T
    apart = start[1:] - end[:-1] > (t[-1] - t[0]) / _ENVELOPE_COLUMNS
    start, end = start[np.r_[True, apart]], end[np.r_[apart, True]]
    style = {"color": "#999999", "alpha": 0.25, "linewidth": 0.6, "zorder": 0, **style}
    spans = np.column_stack([start, end - start]).tolist()
    ax.broken_barh(spans, (0.0, 1.0), transform=ax.get_xaxis_transform(), gid="shade", **style)


def legend(figure: Figure, *axes: Axes) -> None:
    """Put a common legend above the figure, or in the first axes if the user's layout has no room."""
    entries: dict[str, Any] = {}
    for ax in axes:
        entries |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    handles, labels = list(entries.values()), list(entries)
    if figure.get_layout_engine() is None:
        axes[0].legend(handles, labels)
    else:
        figure.legend(handles, labels, loc="outside upper right", ncols=_legend_columns(figure, labels))


def _legend_columns(figure: Figure, labels: list[str]) -> int:
    """Return the number of legend columns that fit, at most seven; matplotlib would clip the others."""
    from matplotlib.textpath import TextPath

    size = _RC["legend.fontsize"]  # line, padding and column spacing together take 4.8 times this size
    widest = max((TextPath((0.0, 0.0), label, size=size).get_extents().width for label in labels), default=0.0)
    room = 72.0 * figure.bbox.width / figure.dpi + 2.0 * size
    return max(1, min(len(labels), 7, int(room / (widest + 4.8 * size))))


_MAKERS = {
    "Dmp": "Use motion.fit_dmp",
    "Excitation": "Use fit.excitation",
    "Fit": "Use a fit_* function or estimation.Fit.load",
    "Hypotheses": "Use contact.hypotheses",
    "PeriodicDmp": "Use motion.fit_periodic_dmp",
    "PoseDmp": "Use motion.fit_pose_dmp",
    "ProMP": "Use motion.fit_promp",
    "Table": "Use log.read",
    "TwoDofRun": "Use TwoDofDmp.simulate or TwoDofDmp.recorded",
}


def expect(value: object, kind: type) -> None:
    """Reject a value of a type that the figure cannot draw."""
    if not isinstance(value, kind):
        raise ShapeError(f"Expected {kind.__name__} to draw, got {shortened(value)}. {_MAKERS[kind.__name__]}.")


def png(drawn: Figure | Axes, dpi: int = 110) -> bytes:
    """Return the bytes of a PNG image of a figure, and close the figure."""
    import matplotlib.pyplot as plt
    from matplotlib.figure import Figure

    figure = drawn if isinstance(drawn, Figure) else drawn.get_figure(root=True)
    memory = BytesIO()
    if figure is not None:
        figure.savefig(memory, format="png", dpi=dpi)
        plt.close(figure)
    return memory.getvalue()


def show() -> None:
    """Show all open figures in windows, and wait until they are closed; raise an error if there is no screen."""
    import matplotlib.pyplot as plt
    from matplotlib.backends.registry import BackendFilter, backend_registry

    if plt.get_backend().lower() in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
        raise ConfigError(
            f"Expected a screen for the figure, got the non-interactive backend {plt.get_backend()}. Save the figure "
            "instead."
        )
    plt.show()
