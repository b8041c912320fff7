"""A model without an error of its own: only the estimator is under test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

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
        covariance=velocity_covariance("const", sd**2, sd**2),
    )
