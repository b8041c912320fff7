"""Quality figures: one per joint, read-only."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.models import Quality


def test_figures_are_one_per_joint_and_read_only() -> None:
    found = Quality([1.0, 2.0], [0.1, np.nan], [0.2, np.nan], [0.95, np.nan], 60.0)
    assert not any(getattr(found, name).flags.writeable for name in ("torque_sd", "rms", "rms_cv", "coverage"))
    assert np.isnan(found.rms[1]), "a joint that could not be judged"
    with pytest.raises(ShapeError, match=r"coverage of one number per joint, got shape \(1,\)"):
        Quality(np.ones(2), np.ones(2), np.ones(2), np.ones(1), 60.0)
