"""Limits of velocity and acceleration: met exactly, on the same path."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import Dmp, fit_dmp
from armlab.motion.timing import peaks, shortest_duration

U = np.linspace(0.0, 1.0, 501)
S = U**3 * (10 - 15 * U + 6 * U**2)


@pytest.fixture(scope="module")
def dmp() -> Dmp:
    return fit_dmp(U, np.stack([S, 0.3 * np.sin(2 * np.pi * S)], axis=1), n_basis=20).value


@pytest.mark.parametrize("limits", [(0.5, np.inf), (np.inf, 1.5), ([0.8, 0.9], [1.0, 9.0])])
def test_limits_are_met_exactly_on_the_same_path(dmp: Dmp, limits: tuple) -> None:
    duration = shortest_duration(dmp, *limits)
    k = duration / dmp.duration
    assert k > 1.0
    t = np.linspace(0, 1.3, 9001)
    slow, run = dmp.rollout(k * t, duration=duration), dmp.rollout(t)
    np.testing.assert_allclose(slow.y, run.y, rtol=0, atol=1e-10)
    shares = [(np.abs(slow.yd) / limits[0]).max(), (np.abs(slow.ydd) / limits[1]).max()]
    assert max(shares) <= 1.0 + 1e-9
    assert max(shares) > 1.0 - 1e-5  # between samples the limit is reached


@pytest.mark.parametrize("seed", range(3))
def test_accelerations_of_many_kernels_keep_to_the_limit(seed: int) -> None:
    waves = sum(np.sin(np.pi * k * U + phase) for k, phase in enumerate(np.random.default_rng(seed).normal(size=5)))
    dmp = fit_dmp(U, (S + waves)[:, None], n_basis=60, schedule="time", convention="ijspeert").value
    duration = shortest_duration(dmp, np.inf, 1.0)
    top = dmp.rollout(np.linspace(0.0, duration, 200_001), duration=duration).ydd
    assert 1.0 - 1e-6 <= np.abs(top).max() <= 1.0 + 1e-9


def test_slow_motion_keeps_its_duration_and_far_goals_take_longer(dmp: Dmp) -> None:
    assert shortest_duration(dmp, 100.0, 1000.0) == dmp.duration
    near, far = (shortest_duration(dmp, [0.5, 100.0], g=dmp.y0 + s * (dmp.g - dmp.y0)) for s in (1.0, 3.0))
    assert far == pytest.approx(3 * near, rel=1e-9)


def test_peaks_are_found_between_samples(dmp: Dmp) -> None:
    coarse, fine = (peaks(dmp.rollout(np.linspace(0, 1, N))) for N in (1001, 20001))
    np.testing.assert_allclose(coarse, fine, rtol=1e-6)


def test_bad_input_is_refused_by_a_sentence(dmp: Dmp) -> None:
    for words, call in {
        "v_max above zero": lambda: shortest_duration(dmp, 0.0),
        "a_max as one number": lambda: shortest_duration(dmp, 1.0, [1.0, 2.0, 3.0]),
        "g with 2": lambda: shortest_duration(dmp, 1.0, g=[0.0]),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
