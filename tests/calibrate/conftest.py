"""Generators of experiments of known truth that several test files share."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from armlab.sim import _cell_force, _cell_hand_eye, _cell_laser


@pytest.fixture(scope="session")
def hand_eye() -> SimpleNamespace:
    """H1 to H4."""
    made = _cell_hand_eye
    return SimpleNamespace(
        draw=made.seen_poses, rotations=made.rotations, tilted=made.tilted, noisy=made.noisy, spoilt=made.spoilt,
        camera=made.CAMERA,
    )  # fmt: skip


@pytest.fixture(scope="session")
def leds() -> SimpleNamespace:
    """H5: three LEDs."""
    return SimpleNamespace(draw=_cell_hand_eye.seen_points, marker=_cell_hand_eye.MARKER, sigma=0.5e-3)


@pytest.fixture(scope="session")
def weights() -> SimpleNamespace:
    """F1 to F4: 1 kg."""
    made = _cell_force
    return SimpleNamespace(
        draw=made.weighed, touched=made.touched, gravity=made.GRAVITY,
        rotations=_cell_hand_eye.rotations, tilted=_cell_hand_eye.tilted,
    )  # fmt: skip


@pytest.fixture(scope="session")
def laser() -> SimpleNamespace:
    """L1."""
    made = _cell_laser
    return SimpleNamespace(draw=made.scanned, hits=made.hits, turns=made.turns, sigma=made.SIGMA, angle=made.ANGLE)
