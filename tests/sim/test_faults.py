"""Faults are seeded, have the asked rates, and lose or keep whole datagrams."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError
from armlab.sim.faults import CORRUPTED, FaultRates, Faults

N = 4000


def outcome(rates: FaultRates, seed: int = 1) -> list[list[tuple[int, bytes]]]:
    faults = Faults(rates, seed)
    return [faults.through([(k, f"datagram {k}".encode())]) for k in range(N)]


def numbers(rates: FaultRates) -> list[int]:
    return [number for cycle in outcome(rates) for number, _ in cycle]


def test_nothing_happens_without_rates() -> None:
    assert numbers(FaultRates()) == list(range(N))
    assert not FaultRates().any
    assert FaultRates(loss=0.1).any


def test_rates() -> None:
    spread = 4 * np.sqrt(0.1 * 0.9 / N)
    assert 1 - len(numbers(FaultRates(loss=0.1))) / N == pytest.approx(0.1, abs=spread)
    assert len(numbers(FaultRates(duplicate=0.1))) / N - 1 == pytest.approx(0.1, abs=spread)
    assert numbers(FaultRates(corrupt=0.1)).count(CORRUPTED) / N == pytest.approx(0.1, abs=spread)
    swapped = (np.diff(numbers(FaultRates(reorder=0.1))) < 0).mean()
    assert 0.05 < swapped < 0.1 + spread


def test_reordered_come_behind_their_successor() -> None:
    late = numbers(FaultRates(reorder=0.1))
    assert sorted(late) == list(range(len(late)))
    position = np.argsort(late)
    assert np.abs(position - np.arange(len(late))).max() <= 2


def test_delay_in_cycles() -> None:
    waits = [k - number for k, cycle in enumerate(outcome(FaultRates(delay=3.0))) for number, _ in cycle]
    assert min(waits) == 0
    assert np.mean(waits) == pytest.approx(3.0 - 0.5, abs=0.3)


def test_corrupted_can_never_be_read() -> None:
    from armlab import robots
    from armlab.wire.egm import Drop, EgmCodec

    codec = EgmCodec(robots.load("yumi_left"))
    for cycle in outcome(FaultRates(corrupt=1.0))[:300]:
        assert isinstance(codec.decode(cycle[0][1]), Drop)


def test_same_seed_same_faults() -> None:
    rates = FaultRates(loss=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1, delay=1.0)
    assert outcome(rates) == outcome(rates)
    assert outcome(rates) != outcome(rates, seed=2)


def test_rates_out_of_range() -> None:
    with pytest.raises(ConfigError, match="loss"):
        FaultRates(loss=1.1)
    with pytest.raises(ConfigError, match="delay"):
        FaultRates(delay=-1)
