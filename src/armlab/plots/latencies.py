"""How fast the loop answered."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ShapeError, UnknownName
from armlab.log import Table
from armlab.plots.arguments import expect
from armlab.plots.style import JOINT_STYLES, look, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes


__all__ = ["latency"]

_BINS_PER_DECADE = 40
_QUANTILES = (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0))


def latency(table: Table, ax: Any = None) -> Axes:
    """Draw histograms of packet to reply, of the controller's step and of the loop's wake-up on a logarithmic axis.

    Parameters
    ----------
    table : recording with receive_ns and send_ns, or step_ns, or wake_ns (N,).
    ax : Axes to draw into; a new figure when None.

    Returns
    -------
    The Axes; p50, p99, p99.9 and the maximum are in the legend, missed and late ticks in the title.

    Raises
    ------
    UnknownName : the table has no times of the loop. ShapeError : no table, or one in which no answer took time.
    """
    from matplotlib.ticker import EngFormatter

    spans = _spans(table)
    shortest, longest = min(map(np.min, spans.values())), max(map(np.max, spans.values()))
    low, high = 10 ** np.floor(np.log10(shortest)), 10 ** np.ceil(np.log10(longest * 1.001))
    bins = np.geomspace(low, high, max(round(np.log10(high / low) * _BINS_PER_DECADE), 2))
    words = EngFormatter("s")
    with look():
        _, axes = panels(1, 1, ax, width=7.5, height=3.8)
        panel: Axes = axes[0, 0]
        for (name, values), (color, _) in zip(spans.items(), JOINT_STYLES, strict=False):
            numbers = "  ".join(f"{label} {words(_rounded(np.quantile(values, p)))}" for label, p in _QUANTILES)
            panel.hist(values, bins=bins, color=color, alpha=0.35, histtype="stepfilled")
            panel.hist(values, bins=bins, color=color, histtype="step", linewidth=1.2, label=f"{name}:  {numbers}")
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_ylim(0.7, 8.0 * panel.get_ylim()[1])  # room for the legend
        panel.xaxis.set_major_formatter(words)
        panel.set_xlabel("time [s]")
        panel.set_ylabel("ticks")
        panel.set_title(_counts(table))
        panel.legend(loc="upper right")
    return panel


def _spans(table: Table) -> dict[str, np.ndarray]:
    """Return the measured times [s], those above zero."""
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
        raise ShapeError(f"Expected times of a loop above zero, got none in {len(table)} rows. Draw a log of a run.")
    return {name: values for name, values in kept.items() if len(values)}


def _rounded(number: float) -> float:
    """Return three digits of a number."""
    return float(f"{number:.3g}")


def _counts(table: Table) -> str:
    words = [f"{len(table)} ticks"]
    for name in ("missed", "late"):
        if name in table:
            words.append(f"{int(np.nansum(table[name]))} {name}")
    return ", ".join(words)
