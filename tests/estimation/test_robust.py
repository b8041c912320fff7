"""Robust least squares: its parts; the methods themselves are in test_linear.py."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited
from armlab.estimation import Rows, huber, least_squares, least_trimmed_squares, mad


def test_mad_is_the_deviation_of_gaussians_and_ignores_outliers() -> None:
    x = np.random.default_rng(0).standard_normal(100_000) * 3.0
    assert mad(x) == pytest.approx(3.0, rel=0.01)
    x[:20_000] = 1e9
    assert mad(x) < 5.0


def test_huber_is_a_stationary_point_of_its_loss(problems) -> None:
    A, y = problems.draw(1, 500)
    y[::20] += 30.0
    rows = list(Rows.of(A, y, np.arange(500) // 50))
    found = huber(rows, least_squares(rows, problems.names))
    scaled = (y - A @ found.x)[:, 0] / mad(y - A @ found.x)
    gradient = A[:, 0].T @ np.clip(scaled, -1.345, 1.345)
    assert np.max(np.abs(gradient) / np.linalg.norm(A[:, 0], axis=0)) < 1e-6
    assert found.rounds < 30


def test_trimmed_drops_a_third_of_a_contact_but_no_clean_blocks(problems) -> None:
    A, y = problems.draw(2, 3000)
    rows = list(Rows.of(A, y, np.arange(3000) // 100))
    clean = least_trimmed_squares(least_squares(rows, problems.names))
    assert clean.kept.sum() >= 28
    y[1000:1600] += 20.0  # a fifth of the record
    rows = list(Rows.of(A, y, np.arange(3000) // 100))
    found = least_trimmed_squares(least_squares(rows, problems.names))
    assert not found.kept[10:16].any()
    assert found.kept.sum() >= 22
    np.testing.assert_allclose(found.x, clean.x, atol=4 * clean.sd.max(), rtol=0.2)


def test_trimming_needs_blocks_that_determine_the_model_together(problems) -> None:
    A, y = problems.draw(3, 600)
    A[60:, 0, 2] *= 1e-5  # one block of ten tells the third parameter
    rows = list(Rows.of(A, y, np.arange(600) // 60))
    with pytest.raises(NotExcited, match="Let every joint move for the whole record"):
        least_trimmed_squares(least_squares(rows, problems.names))
