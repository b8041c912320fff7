"""Torque ripple over position and speed."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.models import RippleLines, load, save, speed_basis


def lines(**change: object) -> RippleLines:
    """Two joints, the second with two lines of one direction."""
    speeds, widths = speed_basis(-1.0, 1.0)
    fields = {
        "joint": [1, 1], "cycles": [100.0, 200.0], "speeds": np.stack([speeds, speeds]),
        "widths": np.stack([widths, widths]), "coefficients": np.ones((2, 1, 8, 2)),
    }  # fmt: skip
    return RippleLines(**{**fields, **change})  # type: ignore[arg-type]


def test_equal_amplitudes_are_a_plain_line() -> None:
    q, qd = np.random.default_rng(0).uniform(-2, 2, (2, 50, 2))
    torque = lines().torque(q, qd, np.sign(qd))
    expected = sum(np.cos(c * q[:, 1]) + np.sin(c * q[:, 1]) for c in (100.0, 200.0))
    np.testing.assert_allclose(torque[:, 1], expected, rtol=0, atol=1e-12)
    assert not torque[:, 0].any()
    assert lines().n == 2


def test_each_direction_may_have_its_own_amplitude() -> None:
    speeds, widths = speed_basis(0.0, 1.0)
    both = np.zeros((1, 2, 8, 2))
    both[0, 0, :, 0], both[0, 1, :, 1] = 2.0, 3.0
    part = RippleLines([0], [50.0], speeds[None], widths[None], both)
    q = np.linspace(0, 1, 30)[:, None]
    np.testing.assert_allclose(part.torque(q, 0 * q + 0.3, 0 * q + 1), 2 * np.cos(50 * q), rtol=0, atol=1e-12)
    np.testing.assert_allclose(part.torque(q, 0 * q - 0.3, 0 * q - 1), 3 * np.sin(50 * q), rtol=0, atol=1e-12)


def test_a_model_keeps_its_lines(tmp_path, model) -> None:
    from dataclasses import replace

    speeds, widths = speed_basis(0.0, 2.0)
    part = RippleLines([0, 6], [100.0, 202.0], np.tile(speeds, (7, 1)), np.tile(widths, (7, 1)),
                       np.random.default_rng(0).standard_normal((2, 2, 8, 2)))  # fmt: skip
    more = replace(model, lines=part)
    again = load(save(more, tmp_path / "model.toml"))
    q, qd = np.random.default_rng(1).standard_normal((2, 40, 7))
    assert np.array_equal(again.torque(q, qd), more.torque(q, qd))
    assert not np.allclose(more.torque(q, qd), model.torque(q, qd))
    with pytest.raises(ShapeError, match="line speeds"):
        replace(model, lines=lines())


def test_wrong_lines_are_refused() -> None:
    with pytest.raises(ShapeError, match="joint by joint"):
        lines(joint=[1, 0])
    with pytest.raises(ShapeError, match="ascending speeds"):
        lines(widths=np.zeros((2, 8)))
    with pytest.raises(ShapeError, match="finite cycles"):
        lines(cycles=[1.0, np.nan])
    with pytest.raises(ShapeError, match="coefficients"):
        lines(coefficients=np.ones((2, 3, 8, 2)))
    with pytest.raises(ShapeError, match="2 Gaussians"):
        speed_basis(1.0, 1.0)
