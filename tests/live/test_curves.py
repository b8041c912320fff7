"""Curves: plot contents, envelopes that keep spikes, sliding windows."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.live import curves
from armlab.live.curves import ArmPanel, Curves, RingBuffer, Window, envelope


class Gui:
    def __init__(self) -> None:
        self.plots: list[Any] = []
        self.headings: list[str] = []

    def add_html(self, content: str) -> SimpleNamespace:
        self.headings.append(content)
        return SimpleNamespace(visible=True)

    def add_uplot(self, **given: Any) -> Any:
        class Plot:
            sent = 0

            def __setattr__(self, name: str, value: Any) -> None:
                object.__setattr__(self, name, value)
                if name == "data":
                    object.__setattr__(self, "sent", self.sent + 1)

        plot = Plot()
        plot.__dict__.update(given)
        self.plots.append(plot)
        return plot


def test_an_envelope_keeps_spikes_and_gaps() -> None:
    t = np.arange(0.0, 10.0, 0.004)
    values = np.stack([np.sin(t), np.zeros_like(t)], axis=1)
    values[777, 0] = 9.0
    values[1000:1100] = np.nan
    times, found = envelope(t, values, 100)
    assert 200 <= len(times) <= 204
    assert (np.diff(times) >= 0).all()
    assert np.nanmax(found[:, 0]) == 9.0
    inside = (times > 4.1) & (times < 4.3)
    assert inside.any()
    assert np.isnan(found[inside]).all()
    assert envelope(t[:150], values[:150], 100)[1] is not found
    np.testing.assert_array_equal(envelope(t[:150], values[:150], 100)[1], values[:150])


def test_an_envelope_does_not_flicker_when_it_slides() -> None:
    """Intervals begin at multiples of their length, so the overlap of two windows is drawn identically."""
    t = np.arange(0.0, 30.0, 0.004)
    noise = np.random.default_rng(1).normal(size=(len(t), 1))
    first, second = ((t >= a) & (t < a + 10.0) for a in (5.0, 5.1))
    (t1, v1), (t2, v2) = (envelope(t[rows], noise[rows]) for rows in (first, second))
    shared = {(round(a, 6), b) for a, b in zip(t1, v1[:, 0])} & {(round(a, 6), b) for a, b in zip(t2, v2[:, 0])}
    assert len(shared) > 350


def test_curves_bands_and_cursor_are_columns_of_the_plot() -> None:
    gui = Gui()
    plot = Curves(gui, "force [N]", ["x", "y"], ["#D55E00", "#009E73"], band=True, cursor=True, limits=(-3.0, 3.0))
    t, values, half = np.arange(4.0), np.arange(8.0).reshape(4, 2), np.full((4, 2), 0.5)
    plot.show(t, values, half, at=1.5)
    data = gui.plots[0].data
    assert re.sub("<[^>]*>", "", gui.headings[0]) == "force [N] ●x ●y"
    labels = ["t [s]", "x", "y", "x +2σ", "x -2σ", "y +2σ", "y -2σ", "now"]
    assert [one["label"] for one in gui.plots[0].series] == labels
    assert [band["series"] for band in gui.plots[0].bands] == [(3, 4), (5, 6)]
    np.testing.assert_array_equal(data[0], [0.0, 1.0, 1.5, 1.5, 2.0, 3.0])
    np.testing.assert_array_equal(np.delete(data[1], [2, 3]), values[:, 0])
    np.testing.assert_array_equal(np.delete(data[5], [2, 3]), values[:, 1] + 0.5)
    np.testing.assert_array_equal(np.delete(data[6], [2, 3]), values[:, 1] - 0.5)
    np.testing.assert_array_equal(data[7], [np.nan, np.nan, -3.0, 3.0, np.nan, np.nan])
    assert gui.plots[0].scales["y"] == {"range": (-3.0, 3.0)}
    free = Curves(gui, "x", ["x"], ["#000000"], cursor=True)  # without a scale the cursor spans the data
    free.show([0.0, 1.0], [[-2.0], [5.0]], at=9.0)
    np.testing.assert_array_equal(gui.plots[1].data[2], [np.nan, np.nan, -2.0, 5.0])


def test_a_band_that_is_missing_has_no_width() -> None:
    gui = Gui()
    plot = Curves(gui, "x", ["x"], ["#000000"], band=True)
    for half, sizes in ((None, [0.0, 0.0]), ([[np.nan], [2.0]], [0.0, 4.0])):
        plot.show([0.0, 1.0], [[1.0], [2.0]], half)
        np.testing.assert_array_equal(gui.plots[0].data[1], [1.0, 2.0])
        np.testing.assert_array_equal(gui.plots[0].data[2] - gui.plots[0].data[3], sizes)


def test_curves_are_interrupted_where_they_are_missing() -> None:
    """uPlot leaves a gap at null, but would bridge NaN with a line. All other columns are sent as plain numbers."""
    gui = Gui()
    plot = Curves(gui, "x", ["x", "y", "z"], ["#000000"] * 3, band=True, cursor=True)
    values = np.arange(12.0).reshape(4, 3)
    values[1, 0], values[:, 2] = np.nan, np.nan
    plot.show(np.arange(4.0), values, np.ones((4, 3)), at=2.0)
    t, x, y, z, x_high, x_low, *rest, now = gui.plots[0].data
    assert [isinstance(one, msgspec.Raw) for one in (t, x, y, z, x_high, x_low, *rest, now)] == (
        [False, True, False, False, True, True, False, False, False, False, False]
    )
    assert msgspec.msgpack.decode(x) == [0.0, None, 6.0, 6.0, 6.0, 9.0]
    assert msgspec.msgpack.decode(x_low) == [-1.0, None, 5.0, 5.0, 5.0, 8.0]
    assert np.isnan(z).all(), "nothing to interrupt"


def test_a_window_slides_and_draws_ten_times_a_second() -> None:
    gui = Gui()
    window = Window(Curves(gui, "x", ["x"], ["#000000"], band=True))
    for k in range(5000):
        window.push(0.004 * k, [float(k)], [1.0] if k % 2 else None)
        window.draw()
    data = gui.plots[0].data
    assert data[0][-1] == pytest.approx(20.0, abs=0.11)
    assert data[0][0] == pytest.approx(10.0, abs=0.2)
    assert 190 <= gui.plots[0].sent <= 201
    window.push(1.0, [5.0])  # another run
    window.draw()
    np.testing.assert_array_equal(gui.plots[0].data[1], [5.0])


def test_shapes_that_do_not_fit_are_refused() -> None:
    plot = curves.Curves(Gui(), "x", ["x"], ["#000000"])
    with pytest.raises(ShapeError, match=r"\(N, 1\)"):
        plot.show([0.0, 1.0], [[1.0, 2.0], [1.0, 2.0]])
    with pytest.raises(ShapeError, match="band=True"):
        plot.show([0.0], [[1.0]], [[1.0]])
    with pytest.raises(ShapeError, match="a sample of 1 curves"):
        Window(plot).push(0.0, [1.0, 2.0])
    with pytest.raises(ShapeError, match="bands of shape"):
        Curves(Gui(), "x", ["x"], ["#000000"], band=True).show([0.0], [[1.0]], [1.0])


@pytest.mark.parametrize("step", [0.004, 0.033, 0.4, 20.0])
def test_it_keeps_the_last_seconds(step: float) -> None:
    recent, all_t = RingBuffer(2, 10.0), step * np.arange(6000)
    for k, t in enumerate(all_t):
        recent.add(t, np.array([k, -k]))
        if k % 501 == 0:
            inside = np.flatnonzero((all_t <= t) & (all_t >= t - 10.0))
            np.testing.assert_array_equal(recent.values, np.stack([inside, -inside], axis=1))
            np.testing.assert_array_equal(recent.t, all_t[inside])
            assert len(recent) == len(inside)


def test_words_are_escaped_and_sent_when_they_change(server: Any) -> None:
    panel = ArmPanel(server.gui, robots.load("irb2400"))
    panel.say({"state": "holding", "why": "<no> packet"})
    text = panel._words._html.content
    assert "holding" in text
    assert "&lt;no&gt; packet" in text
    panel.say({"state": "holding", "why": "<no> packet"})
    assert panel._words._html.content is text
