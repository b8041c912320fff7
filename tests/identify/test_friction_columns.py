"""Columns of friction: of one joint the same as among all, filtered and thinned."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.identify.columns import Bell, Decimation, FrictionColumns
from armlab.kernels import presliding

DELTA, SMOOTH, SPEED = np.array([1e-3, 2e-3, 3e-3]), np.array([0.0, 0.02, 0.0]), np.array([0.1, 0.2, 0.3])


@pytest.fixture(scope="module")
def motion() -> FrictionColumns:
    """Three joints over two segments, every second row kept, a filter of five taps."""
    rng = np.random.default_rng(0)
    qd = np.cumsum(0.01 * rng.standard_normal((900, 3)), axis=0)
    segments = ((0, 400), (400, 900))
    rows = np.concatenate([np.arange(0, 400, 2), np.arange(400, 900, 2)])
    taps = np.array([0.1, 0.2, 0.4, 0.2, 0.1])
    return FrictionColumns(Decimation(segments, 2, taps, rows), np.cumsum(0.004 * qd, axis=0), qd, np.full(3, 1e-5))


def test_the_sign_is_the_presliding_state_of_each_segment_or_smooth(motion: FrictionColumns) -> None:
    s = motion.sign(DELTA, SMOOTH)
    for a, b in motion.thinning.segments:
        z = presliding(motion.q[a:b], DELTA, motion.resolution)
        np.testing.assert_array_equal(s[a:b, [0, 2]], z[:, [0, 2]])
    np.testing.assert_array_equal(s[:, 1], np.tanh(motion.qd[:, 1] / 0.02))


def test_columns_are_filtered_products_of_the_sign(motion: FrictionColumns) -> None:
    s, bell = motion.sign(DELTA, SMOOTH), motion.bell(SPEED)
    assert isinstance(bell, Bell)
    np.testing.assert_array_equal(bell[:], np.exp(-((motion.qd / SPEED) ** 2)))
    parts = [
        np.maximum(s, 0),
        np.minimum(s, 0),
        s * np.sqrt(np.abs(motion.qd)),
        s * np.exp(-((motion.qd / SPEED) ** 2)),
    ]
    got = motion.columns(s, [bell])
    assert got.shape == (450, 3, 4)
    inside = np.arange(2, 398, 2)
    for k, part in enumerate(parts):
        expected = sum(tap * part[inside + j - 2] for j, tap in enumerate(motion.thinning.taps))
        np.testing.assert_allclose(got[inside // 2, :, k], expected, atol=1e-14)


def test_a_bell_alone_and_as_an_array_gives_the_same_column(motion: FrictionColumns) -> None:
    s, bell = motion.sign(DELTA, SMOOTH), motion.bell(SPEED)
    whole = motion.columns(s, [bell])
    np.testing.assert_array_equal(motion.columns(s, [bell[:]]), whole)
    np.testing.assert_allclose(motion.columns(s, [bell], signs=False), whole[:, :, 3:], atol=1e-15)


@pytest.mark.parametrize("i", range(3))
def test_of_one_joint_they_are_those_among_all(motion: FrictionColumns, i: int) -> None:
    one = motion.of(i)
    here = slice(i, i + 1)
    s = one.sign(DELTA[here], SMOOTH[here])
    np.testing.assert_array_equal(s, motion.sign(DELTA, SMOOTH)[:, here])
    whole = motion.columns(motion.sign(DELTA, SMOOTH), [motion.bell(SPEED)])
    np.testing.assert_allclose(one.columns(s, [one.bell(SPEED[here])]), whole[:, here], atol=1e-15)
