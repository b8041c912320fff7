"""A model without errors, so that only the estimator is tested."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from armlab.log import Table
from armlab.models import TorqueModel, velocity_covariance


@pytest.fixture(scope="session")
def perfect(truth, model) -> TorqueModel:
    """The true parameters with a covariance of (5 % of the Coulomb torque)^2."""
    sd = 0.05 * truth.friction.coulomb_pos
    return replace(
        model,
        link_parameters=truth.links,
        rotor=truth.rotor,
        friction=truth.friction,
        ripple=replace(model.ripple, cosine=np.zeros(7), sine=np.zeros(7)),
        gains=np.ones(7),
        gain_cov=np.zeros((7, 7)),
        load_sd=np.zeros(7),
        covariance=velocity_covariance("const", sd**2, sd**2),
        parameters=None,
    )


@pytest.fixture(scope="session")
def resting(truth) -> Callable[..., Table]:
    """Logs of the arm at rest at home: friction within its limits, and a force after the share `begins` of the time."""

    def log(force: np.ndarray, seconds: float = 3.0, seed: int = 0, begins: float = 0.5) -> Table:
        robot, rng = truth.robot, np.random.default_rng(seed)
        t = np.arange(0, seconds, 0.004)
        q, zero = np.tile(robot.q_home, (len(t), 1)), np.zeros((len(t), 7))
        z = np.tile(rng.uniform(-1, 1, 7), (len(t), 1))
        pressed = np.outer(t > begins * seconds, force)
        tau = truth.torque(q, zero, zero, z) - pressed @ robot.chain.jacobian(robot.q_home)
        return Table(t, {"q": q, "qd": zero, "tau": tau + truth.noise * rng.standard_normal(q.shape)})

    return log
