"""Figure of a soak test: memory, descriptors, threads and delays over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soak.series import Held, Recorded

__all__ = ["draw"]

_POINTS = 300  # per curve


def draw(
    about: Mapping[str, Any],
    held: Mapping[str, Held],
    recorded: Mapping[str, Recorded],
    clients: Mapping[str, np.ndarray],
    path: Path,
) -> None:
    """Write the figure.

    Parameters
    ----------
    about, held, recorded, clients : see `series`. path : output file.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 8, "axes.grid": True, "grid.alpha": 0.3, "lines.linewidth": 1.0}):
        figure = Figure(figsize=(9.0, 8.0 if clients else 6.0), layout="constrained")
        rows = figure.subplots(3 if clients else 2, 2, sharex=True)
        for ax, name, scale, text in (
            (rows[0][0], "memory", 2**-20, "memory [MiB]"),
            (rows[0][1], "descriptors", 1.0, "descriptors"),
            (rows[1][1], "threads", 1.0, "threads"),
        ):
            for k, (process, one) in enumerate(held.items()):
                ax.plot(one.t / 60.0, scale * one.values[name], label=process, linestyle=("-", "--")[k // 10 % 2])
            ax.set(ylabel=text, ylim=(0.0, None))
        _delays(rows[1][0], recorded)
        if clients:
            _clients(*rows[2], clients, recorded)
        for ax in rows[-1]:
            ax.set_xlabel("wall-clock time [min]")
        figure.legend(*rows[0][0].get_legend_handles_labels(), loc="outside right upper")
        figure.suptitle(f"Soak, {about['part']}, {about['date']}")
        figure.savefig(path, dpi=110)


def _delays(ax: Any, recorded: Mapping[str, Recorded]) -> None:
    for k, (name, one) in enumerate(recorded.items()):
        ax.plot(one.t / 60.0, 1e3 * one.p50, label=f"{name}, median", color=f"C{k}")
        ax.plot(one.t / 60.0, 1e3 * one.p99, label="99 %", color=f"C{k}", linestyle=":")
    _finish(ax, "arrival to reply [ms]", 2)


def _clients(ax: Any, other: Any, clients: Mapping[str, np.ndarray], recorded: Mapping[str, Recorded]) -> None:
    for name, lines in clients.items():
        step = -(-len(lines) // _POINTS)
        ax.plot(lines[::step, 0] / 60.0, 1e3 * lines[::step, 2], label=name.removeprefix("reader of "))
    _finish(ax, "stamp to receipt, median [ms]", 3)
    for name, one in recorded.items():
        other.plot(one.t / 60.0, 100.0 * one.missed, label=name)
    _finish(other, "ticks missed or late [%]", 2)


def _finish(ax: Any, text: str, columns: int) -> None:
    """Leave space for the legend above the curves."""
    ax.set(ylabel=text, ylim=(0.0, max(1.6 * ax.get_ylim()[1], 1e-3)))
    ax.legend(fontsize=6, ncols=columns, loc="upper center")
