"""Lines of torque ripple: found where they are, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.identify import ripple_lines, ripple_regressor
from armlab.identify.drives.regularised import refit, ridge_solution
from armlab.identify.drives.ripple import (
    highest_seen,
    refine_lines,
    ripple_amplitudes,
    select_lines,
    warn_of_fast_lines,
)
from armlab.models import RippleLines, speed_basis

RATE = 250.0


def motion(seconds: float = 30.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slow motion over 0.6 turns; time, position, velocity."""
    t = np.arange(0, seconds, 1 / RATE)
    return t, 1.9 * np.sin(0.3 * t) + 0.1 * np.sin(1.7 * t), 0.57 * np.cos(0.3 * t) + 0.17 * np.cos(1.7 * t)


def test_lines_are_found_to_a_twentieth_of_their_width() -> None:
    _, q, qd = motion()
    rng = np.random.default_rng(0)
    y = 0.2 * np.cos(100.0 * q + 0.4) + 0.1 * np.cos(202.0 * q) * (0.5 + np.abs(qd)) + 0.1 * rng.standard_normal(len(q))
    found = ripple_lines(q, qd, y, RATE, 250.0)
    width = 2 * np.pi / np.ptp(q)
    assert len(found) == 2
    np.testing.assert_allclose(found, [100.0, 202.0], rtol=0, atol=0.05 * width)


@pytest.mark.slow  # 5 s
def test_noise_has_no_lines() -> None:
    _, q, qd = motion(12.0)
    rng = np.random.default_rng(1)
    false = sum(len(ripple_lines(q, qd, rng.standard_normal(len(q)), RATE, 100.0)) > 0 for _ in range(100))
    assert false <= 5


def test_lines_that_pass_too_fast_are_refused() -> None:
    """At a quarter of the sampling rate the line is at 62.5 Hz; four times the speed hides it from half the samples."""
    q = motion()[1]
    y = 0.2 * np.cos(100.0 * q)
    fast = np.full(len(q), 5.0)
    assert highest_seen(fast, RATE) == pytest.approx(2 * np.pi * 62.5 / 5.0)
    with pytest.warns(UserWarning, match=r"below 62\.5 Hz.*this joint \(above 79 cycles/rev\)"):
        found = ripple_lines(q, fast, y, RATE, 250.0)
    assert not np.any(np.abs(found - 100.0) < 5.0)
    with pytest.warns(UserWarning, match=r"joint 2 \(above 30 cycles/rev\).*slower motion"):
        warn_of_fast_lines({"joint 2": 30.0}, RATE)


def test_a_short_range_or_no_gear_has_no_lines() -> None:
    _, q, qd = motion()
    assert len(ripple_lines(1e-3 * q, 1e-3 * qd, np.cos(100 * q), RATE, 250.0)) == 0
    assert len(ripple_lines(q, qd, np.cos(100 * q), RATE, 1.0)) == 0


def test_the_regressor_is_linear_in_the_coefficients_of_the_model() -> None:
    _, q, qd = motion(4.0)
    z, rng = np.sin(3 * q), np.random.default_rng(0)
    speeds, widths = speed_basis(0.0, np.abs(qd).max())
    k = rng.standard_normal((2, 2, 8, 2))
    torque = RippleLines([0, 0], [100.0, 202.0], speeds[None], widths[None], k).torque(
        q[:, None], qd[:, None], z[:, None]
    )
    A = ripple_regressor(q, qd, z, np.array([100.0, 202.0]), speeds, widths)
    np.testing.assert_allclose(A @ k.ravel(), torque[:, 0], rtol=0, atol=1e-12)


def test_only_lines_that_pay_on_held_out_blocks_stay() -> None:
    t, q, qd = motion()
    rng = np.random.default_rng(2)
    speeds, widths = speed_basis(0.0, np.abs(qd).max())
    A = ripple_regressor(q, qd, np.sign(qd), np.array([60.0, 100.0, 140.0]), speeds, widths)
    y = 0.2 * np.cos(100.0 * q) + 0.2 * rng.standard_normal(len(q))
    block = (t / 0.5).astype(int)
    assert select_lines(A, y, 32, block).tolist() == [False, True, False]
    assert not select_lines(A, rng.standard_normal(len(q)), 32, block).any()


def test_wrong_shapes_are_refused() -> None:
    _, q, qd = motion(1.0)
    with pytest.raises(ShapeError, match="one shape"):
        ripple_lines(q, qd, q[:-1], RATE, 250.0)
    for rate, highest in ((0.0, 250.0), (np.nan, 250.0), (RATE, np.inf)):
        with pytest.raises(ShapeError, match="rate above 0 Hz and finite ends"):
            ripple_lines(q, qd, q, rate, highest)
    assert len(ripple_lines(q[:0], q[:0], q[:0], RATE, 250.0)) == 0
    with pytest.raises(ShapeError, match="finite"):
        ripple_lines(q, qd, np.full(len(q), np.nan), RATE, 250.0)


def test_a_line_is_refined_with_all_its_amplitudes_and_its_error_is_told() -> None:
    """Amplitudes over speed and direction, a search 0.1 off, 20 logs: errors are as large as stated."""
    t, q, qd = motion(20.0)
    speeds, widths = speed_basis(0.0, np.abs(qd).max(), 3)
    amplitudes, block = ripple_amplitudes(qd, np.sign(qd), speeds, widths), (t / 0.5).astype(int)
    A = ripple_regressor(q, qd, np.sign(qd), np.array([100.0]), speeds, widths)
    truth = np.array([0.3, 0.0, 0.3, 0.1, 0.2, 0.0, 0.0, 0.3, 0.1, 0.3, 0.0, 0.2])
    rng, nees = np.random.default_rng(5), []
    for _ in range(20):
        y = A @ truth + 0.1 * rng.standard_normal(len(q))
        cycles, columns, slopes = refine_lines(q, amplitudes, y, np.array([100.1]))
        x, cov = refit(columns, y, block, beside=slopes)
        assert cycles[0] == pytest.approx(100.0, abs=5.0 * np.sqrt(cov[-1, -1]))
        e = np.append(x - truth, cycles - 100.0)
        nees.append(e @ np.linalg.solve(cov, e) / 13)
    assert 0.7 < np.mean(nees) < 1.3
    np.testing.assert_allclose(ridge_solution(A, A @ truth)[0], truth, atol=1e-4)
