"""Chains, link parameters, an arm with drives and its log for the tests of the kernels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab.kernels import Chain
from armlab.log import Table


def screw_z(theta: float, d: float) -> np.ndarray:
    """Rz(theta) Tz(d)."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, d], [0, 0, 0, 1.0]])


def screw_x(alpha: float, a: float) -> np.ndarray:
    """Tx(a) Rx(alpha)."""
    c, s = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


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


class Sines:
    """A second in which every joint moves by two sines."""

    seconds = 1.0

    def __init__(self, q: np.ndarray) -> None:
        self.q = q

    def sample(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w = 2 * np.pi * np.array([[0.7], [1.9]]) * np.linspace(0.8, 1.2, len(self.q))
        wave = w * t[:, None, None]
        parts = 0.1 * np.sin(wave), 0.1 * w * np.cos(wave), -0.1 * w**2 * np.sin(wave)
        q, qd, qdd = (part.sum(axis=1) for part in parts)
        return self.q + q, qd, qdd


@pytest.fixture(scope="session")
def excited(truth: Any) -> Table:
    """A noisy log of a second; what the kernels make of it does not depend on how well it identifies an arm."""
    return truth.log(Sines(truth.robot.q_home), seed=1)


@pytest.fixture(scope="session")
def model(truth: Any) -> SimpleNamespace:
    """The terms of a `TorqueModel` of that arm, nearly true."""
    tau, robot = truth.noise / 0.005, truth.robot
    return SimpleNamespace(
        frames=robot.frames,
        prismatic=robot.prismatic,
        gravity=robot.gravity,
        link_parameters=1.02 * truth.links,
        rotor=truth.rotor,
        friction=truth.friction,
        ripple=SimpleNamespace(rows=np.stack([np.full(7, 20.0), 0.002 * tau, 0.001 * tau])),
        covariance=SimpleNamespace(C0=(0.02 * tau) ** 2, Cinf=(0.01 * tau) ** 2, shape=np.full(7, 3.0)),
        bound=SimpleNamespace(torque=0.06 * tau, speed=np.full(7, 0.05), floor=0.005 * tau),
    )
