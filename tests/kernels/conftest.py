"""An arm with drives, and its log, for the tests of the kernels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab.log import Table


class Sines:
    """One-second motion in which each joint position is the sum of two sine waves."""

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
    """A noisy one-second log; the kernels' results do not depend on how well it identifies an arm."""
    return truth.log(Sines(truth.robot.q_home), seed=1)


@pytest.fixture(scope="session")
def model(truth: Any) -> SimpleNamespace:
    """The terms of a `TorqueModel` of that arm, nearly exact."""
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
