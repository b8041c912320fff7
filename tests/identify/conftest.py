"""A fit of the short arm used by many tests."""

from __future__ import annotations

import pytest

from armlab.estimation import Fit
from armlab.identify import fit_dynamics
from armlab.models import TorqueModel


@pytest.fixture(scope="session")
def short_fit(short_arm) -> Fit[TorqueModel]:
    """The fit to `short_arm.log(0, 3000)`, 30 s of free motion."""
    return fit_dynamics(short_arm.log(0, 3000), short_arm.robot)
