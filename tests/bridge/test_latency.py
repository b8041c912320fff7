"""The histogram against NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from armlab.bridge.latency import Latency


def test_percentiles_are_numpys_to_a_bin() -> None:
    times = np.random.default_rng(1).lognormal(11.0, 1.0, 20_000).astype(int)
    latency = Latency()
    for nanoseconds in times.tolist():
        latency.add(nanoseconds)
    summary = latency.summary()
    for name, percent in (("p50", 50.0), ("p90", 90.0), ("p99", 99.0), ("p99.9", 99.9)):
        assert summary[name] == pytest.approx(np.percentile(times, percent, method="inverted_cdf") / 1e3, abs=1.0)
    assert summary["max"] == pytest.approx(times.max() / 1e3)
    assert latency.count == len(times)


def test_nothing_counted_is_nan() -> None:
    assert math.isnan(Latency().percentile(50.0))


def test_the_last_bin_takes_everything_longer() -> None:
    latency = Latency()
    latency.add(10**10)
    latency.add(-5)
    assert latency.percentile(100.0) == 1e7
    assert latency.percentile(50.0) <= 1.0
