"""Rhythmic primitives: invariances, the wrap, order, files, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import PeriodicDmp

M = 15
T = np.linspace(0.0, 6.0, 1501)


@pytest.fixture(scope="module")
def dmp() -> PeriodicDmp:
    rng = np.random.default_rng(0)
    centres = 2 * np.pi / M * np.arange(M)
    return PeriodicDmp(100 * rng.normal(size=(M, 2)), centres, (M / (2 * np.pi)) ** 2, 2.0, np.array([0.5, -0.2]))


def test_amplitude_scales_the_motion_around_the_baseline(dmp: PeriodicDmp) -> None:
    once, twice = dmp.rollout(T), dmp.rollout(T, r=2.0)
    np.testing.assert_allclose(twice.y - dmp.g, 2 * (once.y - dmp.g), rtol=0, atol=1e-10)
    moved = dmp.rollout(T, g=[1.5, 0.0])
    np.testing.assert_allclose(moved.y, once.y + np.array([1.0, 0.2]), rtol=0, atol=1e-10)


def test_the_motion_repeats_itself_and_does_not_jump_at_the_wrap(dmp: PeriodicDmp) -> None:
    run = dmp.rollout(T)
    for values in (run.y, run.yd, run.ydd):
        np.testing.assert_allclose(values[1000:], values[500:-500], rtol=0, atol=1e-8 * np.abs(values).max())
    np.testing.assert_allclose(run.x, np.pi * T, atol=1e-12)
    near = dmp.rollout(np.array([0.0, 1.999, 2.0, 2.001]))
    assert np.abs(np.diff(near.y[1:], axis=0)).max() < 0.002 * np.abs(run.yd).max()


def test_another_period_is_another_clock(dmp: PeriodicDmp) -> None:
    once, slow = dmp.rollout(T), dmp.rollout(3 * T, period=6.0)
    np.testing.assert_allclose(slow.y, once.y, rtol=0, atol=1e-10)
    np.testing.assert_allclose(3 * slow.yd, once.yd, rtol=0, atol=1e-9)
    assert dmp.rollout(0.1, period=4.0).t[-1] == pytest.approx(4.0)


def test_it_starts_anywhere_and_at_any_phase(dmp: PeriodicDmp) -> None:
    whole, half = dmp.rollout(T), dmp.rollout(T[:501], phase=np.pi)
    np.testing.assert_allclose(half.y, whole.y[250:751], rtol=0, atol=1e-8)
    y, rate = dmp.steady(whole.x)
    np.testing.assert_allclose(dmp.g + y, whole.y, rtol=0, atol=1e-7)
    np.testing.assert_allclose(rate * np.pi, whole.yd, rtol=0, atol=1e-6)
    away = dmp.rollout(T, y0=[3.0, 3.0], v0=[0.0, 0.0])
    np.testing.assert_array_equal(away.y[0], [3.0, 3.0])
    np.testing.assert_allclose(away.y[-1], whole.y[-1], atol=1e-6)


def test_order_is_four(dmp: PeriodicDmp) -> None:
    errors = [
        np.abs(dmp.g + dmp.steady(2 * np.pi)[0] - dmp.rollout(np.linspace(0, 2, N + 1)).y[-1]).max()
        for N in (40, 80, 160)
    ]
    assert np.log2(np.divide(errors[:-1], errors[1:])).min() > 3.8


def test_bad_input_is_refused_by_a_sentence(dmp: PeriodicDmp) -> None:
    assert dmp.n == 2
    for words, call in {
        "period .* above zero": lambda: dmp.rollout(T, period=-1.0),
        "finite amplitude": lambda: dmp.rollout(T, r=np.inf),
        "y0 with 2": lambda: dmp.rollout(T, y0=[0.0]),
        "times that increase": lambda: dmp.rollout(T[::-1]),
        "weights of shape": lambda: replace(dmp, weights=np.zeros(3)),
        "finite weights": lambda: replace(dmp, weights=np.full((M, 2), np.nan)),
        "g of shape": lambda: replace(dmp, g=np.zeros(3)),
        "h above zero": lambda: replace(dmp, h=0.0),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
