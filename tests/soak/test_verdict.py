"""What leaks is found at the size that is claimed, and what only scatters is not."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2]))

from soak import verdict

MIB = 2**20
T = np.linspace(0.0, 1800.0, 300)  # s: half an hour at 250 Hz, as the soak in real time
TICKS = 250.0 * T
SEEDS = range(10)


def scattered(seed: int) -> np.ndarray:
    """Memory that fills at first, then comes and goes in arenas, and has bursts."""
    rng = np.random.default_rng(seed)
    arenas = rng.integers(0, 2, len(T)) * verdict.ARENA
    bursts = (rng.uniform(size=len(T)) < 0.1) * rng.uniform(0.0, 30.0 * MIB, len(T))
    return 40.0 * MIB + np.minimum(T, 400.0) / 400.0 * 20.0 * MIB + arenas + bursts


def late(seed: int) -> np.ndarray:
    """Delays [s] on a machine that others use for minutes."""
    rng = np.random.default_rng(seed)
    busy = np.repeat(rng.uniform(1.0, 5.0, 20), 15)
    return 4e-4 * (1.0 + busy * rng.exponential(0.5, len(T)))


@pytest.mark.parametrize("seed", SEEDS)
def test_memory_that_leaks_16_bytes_per_tick_is_found_and_what_scatters_is_not(seed: int) -> None:
    """The bound is 2 MiB in the second half: 9 bytes per tick in half an hour. Fails for the slope of all of it."""
    held = scattered(seed)
    assert verdict.memory("", T, held).is_met
    assert not verdict.memory("", T, held + 16.0 * TICKS).is_met
    assert verdict.growth(T, held + 16.0 * TICKS) == pytest.approx(16.0 * 225e3, rel=0.4)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_descriptor_that_is_lost_is_found_and_those_that_come_and_go_are_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    held = 20 + 5 * (rng.uniform(size=len(T)) < 0.2)
    held[-1] = 3  # seen while it ended
    assert verdict.count("", held).is_met
    assert not verdict.count("", held + (0.6 * T[-1] < T)).is_met


@pytest.mark.parametrize("seed", SEEDS)
def test_delays_that_double_from_quarter_to_quarter_are_found_and_a_busy_machine_is_not(seed: int) -> None:
    seconds = late(seed)
    assert verdict.delay("", seconds).is_met
    assert not verdict.delay("", seconds * (1.0 + 4.0 * T / T[-1])).is_met, "five times as long in the end"
    assert not verdict.delay("", seconds + 1e-6 * T).is_met, "a queue that grows by 1 us a second"


def test_too_little_is_no_proof() -> None:
    some = np.arange(3.0)
    for finding in (verdict.memory("", some, some), verdict.count("", some), verdict.delay("", some)):
        assert not finding.is_met
    assert not verdict.memory("", np.zeros(0), np.zeros(0)).is_met


def test_a_finding_says_what_it_is() -> None:
    assert str(verdict.equal("rows", 4.0, 5.0)) == "FAIL rows (4 of 5), difference: 1, at most 0"
    assert str(verdict.Finding("x", " ms", 1.0, 2.0)) == "ok   x: 1 ms, at most 2 ms"
