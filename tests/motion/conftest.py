"""Movement primitives for the tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab.motion import Dmp
from armlab.motion._basis import placed, time_constants


def build(schedule: str = "canonical", scaling: str = "goal", n: int = 3, **changes: Any) -> Dmp:
    rng = np.random.default_rng(0)
    alpha_x, tau_d = time_constants("lund", 2.0, 25.0)
    centres, widths = placed(schedule, "time", 20, alpha_x * 2.0 / tau_d, 0.8)
    parts: dict[str, Any] = {
        "weights": rng.normal(size=(20, n)) * 20,
        "centres": centres,
        "widths": widths,
        "tau_d": tau_d,
        "duration": 2.0,
        "y0": rng.normal(size=n),
        "v0": rng.normal(size=n),
        "g": rng.normal(size=n),
        "extent": np.ones(n),
        "peak_acceleration": np.full(n, 10.0),
        "monotone": np.ones(n, dtype=bool),
        "schedule": schedule,
        "scaling": scaling,
    }
    return Dmp(**parts | changes)


@pytest.fixture(scope="session")
def primitive() -> Callable[..., Dmp]:
    """Builds a Dmp with random weights and whatever the test changes."""
    return build
