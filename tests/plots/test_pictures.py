"""`plots.png`: a figure as bytes, and closed; `plots.show`: windows."""

from __future__ import annotations

import struct

import matplotlib.pyplot as plt
import pytest

from armlab.errors import ConfigError
from armlab.plots.style import png, show


def test_a_figure_and_its_axes_give_a_picture_of_the_size_asked_for_and_are_closed() -> None:
    for drawn in (plt.figure(figsize=(2, 1)), plt.figure(figsize=(2, 1)).add_subplot()):
        picture = png(drawn, dpi=50)
        assert picture.startswith(b"\x89PNG\r\n\x1a\n")
        assert struct.unpack(">II", picture[16:24]) == (100, 50)
    assert not plt.get_fignums()


def test_windows_are_left_to_the_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(plt, "show", lambda: asked.append(True))
    with pytest.raises(ConfigError, match=r"Expected a screen .* \(matplotlib draws by [Aa]gg\)"):
        show()
    monkeypatch.setattr(plt, "get_backend", lambda: "QtAgg")
    show()
    assert asked == [True]
