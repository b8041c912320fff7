"""From log to force on the simulated YuMi, as in `benchmarks/accuracy.py` over twenty seeds; here with one of them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import force_protocol as protocol

pytestmark = pytest.mark.slow  # 30 s each: two logs of a minute, an identification


@pytest.fixture(scope="module")
def logs() -> protocol.Logs:
    return protocol.record("yumi_left", seed=0)


def test_one_seed_meets_the_bars(logs) -> None:
    for method in ("map", "kf"):
        score = protocol.judge(logs, method)
        assert (score.rms <= 1.0).all()
        assert (score.free <= 1.0).all()
        assert (score.inside >= 0.90).all()
        assert (score.with_edges >= 0.88).all()
        assert np.abs(list(score.press.values())).max() <= 0.10
        assert score.rest_inside == 1.0
    assert protocol.judge(logs, "interval").rest_inside == 1.0


@pytest.mark.parametrize(
    "method",
    [
        pytest.param("map", marks=pytest.mark.xfail(reason="97.2 % on two axes: doubt about friction", strict=True)),
        "kf",
    ],
)
def test_one_seed_is_not_too_cautious(logs, method: str) -> None:
    """At most 97 % within 2 sigma. A third of the variance for unknown friction would suffice, but would not always
    hold at rest."""
    assert (protocol.judge(logs, method).inside <= 0.97).all()


def test_unknown_gains_of_the_torque_sensors() -> None:
    """Proximal joints whose gains differ by 9 %: the worst of twenty seeds if the gains are not separated."""
    score = protocol.judge(protocol.record("yumi_left", seed=15, gains=0.05), "map")
    assert (score.rms <= 1.5).all()
    assert (score.inside >= 0.85).all()
    assert np.abs(list(score.press.values())).max() <= 0.10
