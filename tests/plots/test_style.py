"""Parts shared by all figures."""

from __future__ import annotations

import struct

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ConfigError
from armlab.plots.style import band, legend, look, panels, png, shade, show


def test_a_backend_that_turns_interactive_while_drawing_stays_so() -> None:
    """Otherwise a notebook shows only the first figure, which loads the backend that turns interactive mode on."""
    was = mpl.is_interactive()
    try:
        mpl.interactive(False)
        with look():
            mpl.interactive(True)
        assert mpl.is_interactive()
        with look():
            pass
        assert mpl.is_interactive()
    finally:
        mpl.interactive(was)


def test_spikes_of_bands_stay_and_spans_of_one_sample_are_seen(spans) -> None:
    _, ax = plt.subplots()
    t = np.arange(150_000) * 0.004
    half = np.ones(len(t))
    half[77_777] = 50.0
    half[:1000] = np.nan
    band(ax, t, np.zeros(len(t)), half)
    vertices = np.concatenate([path.vertices for path in ax.collections[0].get_paths()])
    assert (vertices[:, 1].min(), vertices[:, 1].max()) == (-50.0, 50.0)
    assert len(vertices) < 10_000
    assert vertices[:, 0].min() >= t[900]
    shade(ax, t, np.arange(len(t)) % 2 == 0)  # as fast as a limit can flicker
    assert spans(ax) == [pytest.approx((0.0, t[-1]))]
    shade(ax, t, np.arange(len(t)) == 50_000)
    assert spans(ax)[1] == pytest.approx((t[50_000], t[50_001]))
    assert ax.collections[-1].get_linewidth()[0] > 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rows"), [("shoulder_pan_joint_{}", 3), ("{}" + 300 * "x", 7)])
def test_a_legend_is_as_wide_as_the_figure_at_most(name: str, rows: int) -> None:
    with panels(1, 1, width=6.4) as (figure, axes):
        for i in range(7):
            axes[0, 0].plot([0, 1], label=name.format(i))
        legend(figure, axes[0, 0])
        figure.canvas.draw()
    box = figure.legends[0].get_window_extent()
    assert len({round(text.get_window_extent().y0) for text in figure.legends[0].get_texts()}) == rows
    assert rows == 7 or figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1


def test_a_figure_and_its_axes_give_a_picture_of_the_size_asked_for_and_are_closed() -> None:
    for drawn in (plt.figure(figsize=(2, 1)), plt.figure(figsize=(2, 1)).add_subplot()):
        picture = png(drawn, dpi=50)
        assert picture.startswith(b"\x89PNG\r\n\x1a\n")
        assert struct.unpack(">II", picture[16:24]) == (100, 50)
    assert not plt.get_fignums()


def test_windows_are_left_to_the_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(plt, "show", lambda: asked.append(True))
    with pytest.raises(ConfigError, match=r"Expected a screen .* backend [Aa]gg"):
        show()
    monkeypatch.setattr(plt, "get_backend", lambda: "QtAgg")
    show()
    assert asked == [True]
