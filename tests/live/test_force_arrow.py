"""Where a force points and how sure it is: directions, ellipsoids, what may be zero."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.lie import quaternion
from armlab.live.scene import ForceArrow, _towards, ellipsoid_axes, is_significant

TOOL = np.array([0.3, 0.1, 0.2])
C = np.diag([1.0, 4.0, 9.0])


def test_an_arrow_turns_towards_every_force() -> None:
    """Straight down and nearly so are the hard ones: the turn has no axis of its own there."""
    rng = np.random.default_rng(4)
    forces = [*rng.normal(size=(50, 3)), *np.eye(3), *-np.eye(3), [1e-5, 0.0, -1.0], [0.0, 1e-6, -1.0], [1e-9, 0, -1.0]]
    for force in forces:
        unit = np.array(force) / np.linalg.norm(force)
        wxyz = _towards(*unit.tolist())
        assert np.linalg.norm(wxyz) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(quaternion.to_matrix(wxyz)[:, 2], unit, atol=1e-8)


def test_ellipsoids_are_those_of_two_sigma() -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        root = rng.normal(size=(3, 3))
        axes, half = ellipsoid_axes(root @ root.T)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes @ np.diag(half**2) @ axes.T, 4.0 * root @ root.T, atol=1e-12, rtol=1e-9)


def test_a_force_is_significant_beyond_the_ellipsoid_of_95_percent() -> None:
    for force, significant in (([2.7, 0, 0], False), ([2.9, 0, 0], True), ([0, 0, 8.3], False), ([0, 0, 8.5], True)):
        assert is_significant(np.array(force), *ellipsoid_axes(C)) is significant  # sqrt(7.81) = 2.795 sigma
    assert is_significant(np.array([0.1, 0.0, 0.0]), np.eye(3), np.zeros(3))


def test_small_forces_are_thin_and_tiny_ones_hidden(server: Any) -> None:
    one = ForceArrow(server.scene, "/x")
    arrow, ball = (server.scene.get_handle_by_name(f"/x/{name}") for name in ("force", "uncertainty"))
    unknown = np.full((3, 3), np.nan)
    for newton, thick, shown in ((0.05, 0.0, False), (1.0, 0.3, True), (7.5, 0.5, True), (40.0, 1.0, True)):
        one.show(TOOL, np.array([0.0, newton, 0.0]), C, 0.01)
        assert (arrow.visible, ball.visible) == (shown, True)
        if shown:
            np.testing.assert_allclose(arrow.scale, [thick, thick, 0.01 * newton])
        np.testing.assert_allclose(ball.position, TOOL + 0.01 * newton * np.eye(3)[1])
    for force, covariance in ((np.ones(3), unknown), (np.ones(3), None), (None, C), (np.full(3, np.nan), C)):
        one.show(TOOL, force, covariance, 0.01)
        assert not ball.visible
        assert arrow.visible is (force is not None and bool(np.isfinite(force).all()))
    one.show(TOOL, np.ones(3), C, 0.01)
    one.hide()
    assert not arrow.visible
    assert not ball.visible
