"""What a movement primitive returns cannot be changed."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.motion import Rollout


def test_a_rollout_is_frozen() -> None:
    parts = np.zeros((5, 4, 2))
    run = Rollout(np.arange(4.0), *parts[:3], np.ones(4), parts[3])
    for name in ("t", "y", "yd", "ydd", "x", "forcing"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(run, name)[0] = 1
    parts[0] = 1  # what was given stays the caller's
