"""Forces on a heavy arm with unmodelled errors: one seed of `benchmarks/heavy_arm.py`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import heavy_arm as protocol

pytestmark = pytest.mark.slow  # a minute: four logs of a minute, an identification


@pytest.fixture(scope="module")
def logs() -> protocol.Logs:
    return protocol.record(seed=0)


def test_load_friction_is_learned_without_a_load(logs) -> None:
    """For the joints that gravity loads most, within 20 %."""
    np.testing.assert_allclose(logs.fit.value.friction.load[1:3], logs.of_load[1:3], rtol=0.2)


@pytest.mark.parametrize("mass", [1.0, 3.0])
@pytest.mark.parametrize("method", protocol.METHODS)
def test_the_force_of_a_load_is_inside_its_band(logs, method: str, mass: float) -> None:
    rms, inside = protocol.judge(logs, method, mass)
    assert (inside >= 0.90).all()
    assert (rms <= 5.0).all()


@pytest.mark.parametrize("method", protocol.METHODS)
def test_free_motion_is_inside_its_band(logs, method: str) -> None:
    assert (protocol.judge(logs, method, 0.0)[1] >= 0.90).all()


@pytest.mark.parametrize("part", ["load friction", "doubt of a contact"])
def test_each_part_of_the_model_is_needed(logs, part: str) -> None:
    """Without this part, fewer forces of 3 kg are within 2 sigma, by more than 1 % on some axis."""
    model = protocol.without_load_friction(logs) if part == "load friction" else protocol.without_doubt(logs)
    less = protocol.judge(logs, "map", 3.0)[1] - protocol.judge(logs, "map", 3.0, model)[1]
    assert less.max() > 0.01
    assert (less > 0).all()
