"""The histogram against NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from armlab.bridge.control.arm import Latency


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


def test_the_histogram_has_every_time_once() -> None:
    latency = Latency()
    for microseconds in (0, 1, 2, 3, 4, 1000, 1024, 10**7):
        latency.add(microseconds * 1000)
    told = latency.histogram()
    counts = dict(zip(told["below_us"], told["count"], strict=True))
    assert {limit: count for limit, count in counts.items() if count} == {2: 2, 4: 2, 8: 1, 1024: 1, 2048: 1, 32768: 1}
    assert list(counts) == [2**k for k in range(1, 16)]
