"""`plots.latency`: histograms and quantiles of the loop."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.log import Table
from armlab.plots.recording import latency


def test_every_tick_is_in_the_histogram() -> None:
    rng = np.random.default_rng(1)
    receive = 10**18 + np.arange(1000) * 4_000_000
    late = np.arange(1000) % 100 == 0
    reply = rng.integers(20_000, 300_000, 1000)
    values = {"receive_ns": receive, "send_ns": receive + reply, "step_ns": reply // 4, "wake_ns": reply // 8}
    ax = latency(Table(np.arange(1000) * 0.004, {**values, "late": late, "missed": np.ones(1000, dtype=int)}))
    assert ax.get_title(loc="left") == "1000 ticks, 1000 missed, 10 late"
    assert ax.get_xlabel() == "time [s]"
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts[0].startswith(f"packet to reply:  p50 {np.median(reply) / 1e3:.0f} µs  p99 ")
    assert f"p99.9 {np.quantile(reply, 0.999) / 1e3:.0f} µs  max {reply.max() / 1e3:.0f} µs" in texts[0]
    low, high = ax.patches[0].get_path().get_extents().intervalx
    assert low <= reply.min() * 1e-9 < reply.max() * 1e-9 <= high  # seconds
    assert ax.xaxis.get_major_formatter()(2e-4) == "200 µs"
    steps = [patch for patch in ax.patches if not patch.get_fill()]
    assert [text.split(":")[0] for text in texts] == ["packet to reply", "controller", "wake-up"]
    assert f"p50 {np.median(reply // 8) / 1e3:.1f} µs" in texts[2]
    assert len(steps) == 3
    for outline in steps:
        assert outline.get_path().vertices[1:-1:2, 1].sum() == 1000
    assert ax.get_xscale() == "log"


def test_ticks_without_a_reply_do_not_count() -> None:
    table = Table([0.0, 1.0], {"receive_ns": [1000, 5000], "send_ns": [np.nan, 9000.0]})
    ax = latency(table)
    assert "p50 4 µs " in ax.get_legend().get_texts()[0].get_text()
    with pytest.raises(UnknownName, match="loop times"):
        latency(table.select("receive_ns"))
    with pytest.raises(ShapeError, match="got none in 2 rows"):
        latency(Table([0.0, 1.0], {"step_ns": [0, 0]}))
