"""Blends of distributions over motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import ProMP, TrajectoryDistribution, blend
from armlab.motion.promp import SAME

M, N_JOINTS = 8, 2
T = np.linspace(0.0, 2.0, 21)


@pytest.fixture(scope="module")
def promp() -> ProMP:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(M * N_JOINTS, M * N_JOINTS))
    centres = np.linspace(0, 1, M)
    return ProMP(
        rng.normal(size=(M, N_JOINTS)), 0.1 * root @ root.T, centres, np.full(M, 0.12), 2.0, np.array([0.1, 0.2])
    )


def test_blending_goes_from_one_motion_to_the_other(promp: ProMP) -> None:
    other = replace(promp, mean=promp.mean + 1.0)
    share = np.linspace(0, 1, 21)[:, None]
    band = blend([promp, other], np.hstack([1 - share, share]), T)
    np.testing.assert_allclose(band.y[0], promp.marginal(T).y[0], atol=1e-6)
    np.testing.assert_allclose(band.y[-1], other.marginal(T).y[-1], atol=1e-6)
    both = blend([promp, other], [1.0, 1.0], T)
    np.testing.assert_allclose(both.y, promp.marginal(T).y + 0.5, atol=1e-6)
    np.testing.assert_allclose(both.cov, 0.5 * promp.marginal(T).cov, rtol=1e-3, atol=1e-6)


def test_a_band_is_frozen_and_has_deviations() -> None:
    cov = np.array([[[4.0, 0.0], [0.0, 9.0]]])
    band = TrajectoryDistribution(np.zeros(1), np.zeros((1, 2)), np.zeros((1, 2)), cov, cov)
    np.testing.assert_array_equal(band.sd, [[2.0, 3.0]])
    assert SAME < 1e-6
    with pytest.raises(ValueError, match="read-only"):
        band.y[0] = 1


def test_bad_input_is_refused_by_a_sentence(promp: ProMP) -> None:
    for words, call in {
        "activation of shape": lambda: blend([promp, promp], [1.0], T),
        "never all zero": lambda: blend([promp, promp], [0.0, 0.0], T),
        "not negative": lambda: blend([promp, promp], [2.0, -1.0], T),
        "as many coordinates": lambda: blend([], [1.0], T),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
