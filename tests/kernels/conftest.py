"""Chains and link parameters for the tests of the kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from armlab.kernels import Chain


def screw_z(theta: float, d: float) -> np.ndarray:
    """Rz(theta) Tz(d)."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, d], [0, 0, 0, 1.0]])


def screw_x(alpha: float, a: float) -> np.ndarray:
    """Tx(a) Rx(alpha)."""
    c, s = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


@pytest.fixture(scope="session")
def from_dh() -> Callable[..., Chain]:
    """Build a chain of revolute joints from standard DH rows, ``A = Rz(q + offset) Tz(d) Tx(a) Rx(alpha)``."""

    def build(
        alpha: Sequence[float], a: Sequence[float], d: Sequence[float], offset: Sequence[float], mount: np.ndarray
    ) -> Chain:
        offsets = [*offset, 0.0]
        frames = [mount @ screw_z(offsets[0], 0.0)]
        for i in range(len(alpha)):
            frames.append(screw_z(0.0, d[i]) @ screw_x(alpha[i], a[i]) @ screw_z(offsets[i + 1], 0.0))
        return Chain(np.stack(frames), np.zeros(len(alpha), dtype=bool))

    return build


@pytest.fixture(params=range(6), ids="seed{}".format)
def chain(request: pytest.FixtureRequest) -> Chain:
    """A random chain of 1 to 9 revolute and prismatic joints."""
    rng = np.random.default_rng(request.param)
    n = int(rng.integers(1, 10)) if request.param else 7
    frames = np.tile(np.eye(4), (n + 1, 1, 1))
    for frame in frames:
        alpha, beta, gamma = rng.uniform(-np.pi, np.pi, 3)
        frame[:] = screw_z(alpha, rng.normal()) @ screw_x(beta, rng.normal()) @ screw_z(gamma, 0.0)
    return Chain(frames, rng.random(n) < 0.3)


@pytest.fixture
def solids(chain: Chain) -> np.ndarray:
    """(n, 10) link parameters of bodies that can exist: positive mass, inertia of points in space."""
    rng = np.random.default_rng(99)
    pi = np.zeros((chain.n, 10))
    for row in pi:
        masses, points = rng.uniform(0.1, 1.0, 6), rng.normal(scale=0.2, size=(6, 3))
        inertia = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points))
        row[0], row[1:4] = masses.sum(), masses @ points
        row[4:] = inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    return pi
