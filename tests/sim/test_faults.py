"""Faults are seeded, have the asked rates, and lose or keep whole datagrams."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.sim.controller.channel import CORRUPTED, Faults
from armlab.sim.controller.settings import FaultRates

N = 4000


def outcome(rates: FaultRates, seed: int = 1) -> list[list[tuple[int, bytes]]]:
    faults = Faults(rates, seed, period=0.004)
    return [faults.through([(k, f"datagram {k}".encode())], 0.004 * k) for k in range(N)]


def numbers(rates: FaultRates) -> list[int]:
    return [number for cycle in outcome(rates) for number, _ in cycle]


def test_nothing_happens_without_rates() -> None:
    assert numbers(FaultRates()) == list(range(N))


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


def waits(rates: FaultRates) -> np.ndarray:
    return np.array([k - number for k, cycle in enumerate(outcome(rates)) for number, _ in cycle])


def test_delay_to_the_nearest_cycle() -> None:
    assert set(waits(FaultRates(delay=(0.0121, 0.0))).tolist()) == {3}
    assert set(waits(FaultRates(delay=(0.0019, 0.0))).tolist()) == {0}
    spread = waits(FaultRates(delay=(0.02, 0.008)))
    assert spread.mean() == pytest.approx(5.0, abs=0.2)
    assert spread.std() == pytest.approx(2.0, abs=0.2)


def test_a_pause_holds_and_then_gives_everything() -> None:
    cycles = outcome(FaultRates(pause=(1.0, 0.4)))
    quiet = [k for k, cycle in enumerate(cycles) if not cycle]
    assert quiet == list(range(250, 350))
    assert sorted(number for number, _ in cycles[350]) == list(range(250, 351))


def test_losses_come_in_bursts_at_the_same_share() -> None:
    kept = np.zeros(N + 1, dtype=bool)
    kept[numbers(FaultRates(loss=0.2, burst=10))] = True
    kept[N] = True
    assert 1 - kept[:N].mean() == pytest.approx(0.2, abs=0.06)
    assert 1 - len(numbers(FaultRates(loss=0.6, burst=10))) / N == pytest.approx(0.6, abs=0.08)
    edges = np.flatnonzero(np.diff(kept.astype(int)))
    runs = np.diff(edges)[::2] if not kept[edges[0] + 1] else np.diff(edges)[1::2]
    assert runs[:-1].min() >= 10


def test_from_until_on_nothing_goes_wrong() -> None:
    rates = FaultRates(loss=0.5, corrupt=0.5, reorder=0.5, delay=(0.01, 0.0), pause=(7.0, 9.0), until=8.0)
    cycles = outcome(rates)
    assert not any(cycles[1760:2000])
    assert cycles[2010:] == [[(k, f"datagram {k}".encode())] for k in range(2010, N)]


def test_corrupted_can_never_be_read() -> None:
    from armlab import robots
    from armlab.wire.egm import Drop, EgmCodec

    codec = EgmCodec(robots.load("yumi_left"))
    for cycle in outcome(FaultRates(corrupt=1.0))[:300]:
        assert isinstance(codec.decode(cycle[0][1]), Drop)


def test_same_seed_same_faults() -> None:
    rates = FaultRates(loss=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1, delay=(0.004, 0.002), burst=3)
    assert outcome(rates) == outcome(rates)
    assert outcome(rates) != outcome(rates, seed=2)
