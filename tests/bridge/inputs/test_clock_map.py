"""Stamps of another clock on ours."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.bridge.inputs.fusion import ClockMap

MS = 1_000_000
OFFSET = 10**15


def test_the_least_delay_is_the_offset() -> None:
    """With delays from 1 ms up, all but the first moments are mapped to within the least of them."""
    rng = np.random.default_rng(1)
    clock, errors = ClockMap(), []
    for k in range(3000):
        source = 4 * MS * k
        delay = int(1 * MS + rng.exponential(2 * MS))
        errors.append(clock.add(source, source + OFFSET + delay) - (source + OFFSET))
    assert clock.resets == 0
    assert np.abs(np.array(errors[100:]) - MS).max() < 0.3 * MS


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_a_drift_is_followed(drift: float) -> None:
    """A clock that is fast by 100 ppm runs off by a millisecond in the 10 s of the minimum."""
    rng = np.random.default_rng(2)
    clock, errors = ClockMap(), []
    for k in range(10_000):
        ours = 4 * MS * k
        source = round(ours * (1.0 + drift))
        errors.append(clock.add(source, ours + OFFSET + int(rng.exponential(1 * MS))) - (ours + OFFSET))
    assert np.abs(np.array(errors[3000:])).max() < 0.2 * MS


@pytest.mark.parametrize("step", [-60 * MS, 60 * MS, 10**12])
def test_a_clock_that_was_set_is_mapped_anew(step: int) -> None:
    clock = ClockMap()
    for k in range(100):
        clock.add(4 * MS * k, 4 * MS * k + OFFSET)
    for k in range(100, 120):
        mapped = clock.add(4 * MS * k + step, 4 * MS * k + OFFSET)
    assert clock.resets == 1
    assert mapped == 4 * MS * 119 + OFFSET


def test_a_late_packet_is_no_step() -> None:
    clock = ClockMap()
    for k in range(100):
        mapped = clock.add(4 * MS * k, 4 * MS * k + OFFSET + (80 * MS if k in (50, 51, 52) else 0))
        assert mapped == 4 * MS * k + OFFSET
    assert clock.resets == 0


def test_reset() -> None:
    clock = ClockMap()
    clock.add(0, OFFSET)
    clock.reset()
    assert clock.add(5, 7) == 7
