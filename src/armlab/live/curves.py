"""Curves and text of an arm in the panel, for the last few seconds of a stream or a whole run with a cursor."""

from __future__ import annotations

import html
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from armlab._display import AXIS_COLORS, COLORS
from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.robots import Robot


class RingBuffer:
    """Buffer of the samples from the last few seconds."""

    def __init__(self, width: int, seconds: float) -> None:
        self._width, self._seconds = width, seconds
        self._rows: deque[tuple[float, np.ndarray]] = deque()

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def last(self) -> float:
        """Time of the newest sample [s]; -inf if the buffer is empty."""
        return self._rows[-1][0] if self._rows else -np.inf

    @property
    def t(self) -> np.ndarray:
        """Times (N,) of the samples [s]."""
        return np.array([t for t, _ in self._rows])

    @property
    def values(self) -> np.ndarray:
        """Samples (N, width)."""
        return np.array([values for _, values in self._rows]).reshape(-1, self._width)

    def add(self, t: float, values: np.ndarray) -> None:
        """Add a sample (width,) at a time t [s], which must not precede the last sample."""
        self._rows.append((t, values))
        while self._rows[0][0] < t - self._seconds:
            self._rows.popleft()

    def clear(self) -> None:
        self._rows.clear()


_STRETCHES = 200  # segments per plot (about 400 pixels wide), each drawn as its minimum and maximum
_CURSOR = "#000000"
_BAND = "33"  # opacity of a band, as two hexadecimal digits


def envelope(t: np.ndarray, values: np.ndarray, stretches: int = _STRETCHES) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (M,), and the minima and maxima (M, k) of segments of samples (N, k) at increasing times (N,).

    Spikes thus remain visible in a plot. Segments begin at integer multiples of their length, so a sliding window does
    not flicker. Short series are returned unchanged. Segments without finite values are NaN.
    """
    if len(t) <= 2 * stretches:
        return t, values
    step = (t[-1] - t[0]) / stretches
    edges = np.r_[0, np.flatnonzero(np.diff(np.floor(t / step))) + 1]
    holes = np.isnan(values)
    empty = np.minimum.reduceat(holes, edges)
    low = np.where(empty, np.nan, np.minimum.reduceat(np.where(holes, np.inf, values), edges))
    high = np.where(empty, np.nan, np.maximum.reduceat(np.where(holes, -np.inf, values), edges))
    middle = 0.5 * (t[edges] + t[np.r_[edges[1:], len(t)] - 1])
    return np.repeat(middle, 2), np.stack([low, high], axis=1).reshape(-1, values.shape[1])


class Curves:
    """Plot of k curves against time, with optional bands and an optional cursor."""

    k: int

    def __init__(
        self,
        gui: Any,
        title: str,
        labels: Sequence[str],
        colors: Sequence[str],
        *,
        band: bool = False,
        cursor: bool = False,
        limits: tuple[float, float] | None = None,
        height: int = 130,
    ) -> None:
        self.k, self._band, self._cursor, self._limits = len(labels), band, cursor, limits
        series: list[dict[str, Any]] = [{"label": "t [s]"}]
        series += [{"label": name, "stroke": color, "width": 1.3} for name, color in zip(labels, colors, strict=True)]
        bands = []
        if band:
            for name, color in zip(labels, colors):
                series += [{"label": f"{name} {sign}2σ", "width": 0} for sign in "+-"]  # no line, only the fill
                bands.append({"series": (len(series) - 2, len(series) - 1), "fill": color + _BAND})
        if cursor:
            series.append({"label": "now", "stroke": _CURSOR, "width": 1.5})
        for one in series[1:]:
            one["points"] = {"show": False}
        y: dict[str, Any] = {} if limits is None else {"range": limits}
        names = "".join(
            f" <span style='color:{color}'>●</span>{html.escape(name)}" for name, color in zip(labels, colors)
        )
        self._heading = gui.add_html(
            f"<div style='font-size:0.75em;margin:0 1em -0.5em'><b>{html.escape(title)}</b>{names}</div>"
        )
        self._plot = gui.add_uplot(
            data=tuple(np.array([0.0]) for _ in series),
            series=tuple(series),
            bands=tuple(bands) or None,
            scales={"x": {"time": False}, "y": y},
            legend={"show": False},
            cursor={"show": False},
            height=height,
            axes=({"size": 24, "gap": 2, "ticks": {"size": 4}}, {"size": 44, "gap": 2, "ticks": {"size": 4}}),
            padding=(6, 10, 0, 0),
        )

    def hide(self) -> None:
        self._heading.visible = self._plot.visible = False

    def show(self, t: ArrayLike, values: ArrayLike, half: ArrayLike | None = None, *, at: float | None = None) -> None:
        """Plot curves (N, k), with bands of half-width `half` (N, k), against t (N,) [s]; NaN leaves gaps.

        Long series are drawn as envelopes.
        """
        t, values = numbers(t, "times of curves", ShapeError), numbers(values, "curves", ShapeError)
        if t.ndim != 1 or values.shape != (len(t), self.k):
            raise ShapeError(f"Expected curves of shape (N, {self.k}) over t (N,), got {values.shape} over {t.shape}.")
        columns = values
        if self._band:
            half = np.full_like(values, np.nan) if half is None else numbers(half, "bands", ShapeError)
            if half.shape != values.shape:
                raise ShapeError(f"Expected bands of shape {values.shape}, got {half.shape}.")
            half = np.nan_to_num(half)  # uPlot would draw NaN as a wedge to the next finite value
            columns = np.concatenate([values, np.stack([values + half, values - half], axis=2).reshape(len(t), -1)], 1)
        elif half is not None:
            raise ShapeError("Expected no bands for these curves, got half-widths. Create the plot with band=True.")
        t, columns = envelope(t, columns)
        drawn = columns.shape[1]
        if self._cursor:
            t, columns = self._marked(t, columns, at)
        if len(t):
            t, *columns = np.ascontiguousarray(np.column_stack([t, columns]).T)
            # a list, because viser takes 0.3 ms to check the item types of a tuple
            self._plot.data = [t, *_interrupted(columns[:drawn]), *columns[drawn:]]

    def _marked(self, t: np.ndarray, columns: np.ndarray, at: float | None) -> tuple[np.ndarray, np.ndarray]:
        """Add a column for the cursor, and two rows at the cursor time for the lower and upper ends of the scale."""
        columns = np.column_stack([columns, np.full(len(t), np.nan)])
        if at is None or not len(t):
            return t, columns
        if self._limits is not None:
            ends = self._limits
        else:
            known = columns[np.isfinite(columns)]
            ends = (known.min(), known.max()) if len(known) else (0.0, 1.0)
        k = int(np.searchsorted(t, at))
        row = columns[min(k, len(t) - 1)].copy()
        rows = np.stack([row, row])
        rows[:, -1] = ends
        return np.insert(t, k, [at, at]), np.insert(columns, k, rows, axis=0)


def _interrupted(columns: Sequence[np.ndarray]) -> list[Any]:
    """Return the columns with null instead of NaN, because uPlot connects points across NaN but leaves gaps at null."""
    found: list[Any] = []
    missing = np.isnan(columns)
    count = missing.sum(axis=1)
    for column, holes, some in zip(columns, missing, (count > 0) & (count < len(columns[0]))):
        if some:
            values = column.astype(object)
            values[holes] = None
            found.append(msgspec.Raw(msgspec.msgpack.encode(values.tolist())))  # viser sends it unchanged
        else:
            found.append(column)
    return found


class Window:
    """Plot of the last few seconds of a stream. `rate`: maximum number of updates per second of stream time."""

    def __init__(self, curves: Curves, seconds: float = 10.0, rate: float = 10.0) -> None:
        self._curves, self._period = curves, 1.0 / rate
        self._recent = RingBuffer(2 * curves.k, seconds)
        self._drawn = -np.inf

    def push(self, t: float, values: ArrayLike, half: ArrayLike | None = None) -> None:
        """Add a sample (k,) at time t [s] for the next `draw`; a non-increasing time clears the window."""
        if t <= self._recent.last:
            self._recent.clear()
            self._drawn = -np.inf
        values = numbers(values, "a sample of curves", ShapeError)
        half = np.full_like(values, np.nan) if half is None else numbers(half, "a sample of bands", ShapeError)
        if not values.shape == half.shape == (self._curves.k,):
            raise ShapeError(f"Expected a sample of {self._curves.k} curves, got {values.shape} and {half.shape}.")
        self._recent.add(t, np.concatenate([values, half]))

    def draw(self) -> None:
        """Update the plot if at least one update period has passed since the last update."""
        recent = self._recent
        if not len(recent) or recent.last - self._drawn < self._period:
            return
        self._drawn = recent.last
        values, half = np.split(recent.values, 2, axis=1)
        self._curves.show(recent.t, values, None if np.isnan(half).all() else half)


class Markup:
    """Text in the panel; unchanged content is not sent again."""

    def __init__(self, gui: Any) -> None:
        self._html, self._shown = gui.add_html(""), ""

    def show(self, content: str) -> None:
        if content != self._shown:
            self._html.content = self._shown = content

    def remove(self) -> None:
        self._html.remove()


class Lines(Markup):
    """Lines of text in the panel."""

    def show(self, content: str) -> None:
        text = html.escape(content).replace("\n", "<br>")
        super().show(f"<div style='font-size:0.85em;margin:0.3em 0.8em'>{text}</div>")


class ArmPanel:
    """Text and plots of an arm in the current GUI folder or tab. `limits`: limits of the y axis, by plot name."""

    def __init__(self, gui: Any, robot: Robot, limits: Mapping[str, tuple[float, float]] | None = None) -> None:
        limits = limits or {}
        self._words = Markup(gui)
        joints = [COLORS[i % len(COLORS)] for i in range(robot.n)]
        forces, moments = ("f_x", "f_y", "f_z"), ("m_x", "m_y", "m_z")
        self.force: Curves = Curves(gui, "force [N]", forces, AXIS_COLORS, band=True, limits=limits.get("force"))
        self.torque: Curves = Curves(gui, "torque [N m]", robot.joint_names, joints, limits=limits.get("torque"))
        self.moment: Curves = Curves(
            gui, "moment [N m]", moments, AXIS_COLORS, band=True, limits=limits.get("moment"), height=110
        )

    def say(self, words: Mapping[str, str]) -> None:
        """Show the status of the arm: state, rate, latency, clamps, drops."""
        key, value = "padding:0 1em 0 0;opacity:0.65", "padding:0"
        rows = "".join(
            f"<tr><td style='{key}'>{html.escape(what)}</td><td style='{value}'>{html.escape(word)}</td></tr>"
            for what, word in words.items()
        )
        self._words.show(f"<table style='font-size:0.8em;line-height:1.3;margin:0 1em'>{rows}</table>")
