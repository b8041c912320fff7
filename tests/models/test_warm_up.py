"""Friction that changes with its own heat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.models import WarmUp, load, save


def warm_up(n: int = 1, **change: object) -> WarmUp:
    fields = {"of_coulomb": -0.1, "of_viscous": -0.4, "time": 100.0, "power": 2.0, "start": 0.0}
    return WarmUp(**{name: np.full(n, change.get(name, value)) for name, value in fields.items()})  # type: ignore[arg-type]


def test_warmth_settles_at_one_under_the_reference_power() -> None:
    x = warm_up().warmth(np.full((1001, 1), 2.0), np.ones(1001))
    assert x[0, 0] == 0.0
    assert x[100, 0] == pytest.approx(1 - np.exp(-1.0))
    assert x[-1, 0] == pytest.approx(1.0, abs=1e-4)
    assert np.all(warm_up(time=0.0, start=0.3).warmth(np.ones((5, 1)), np.ones(5)) == 0.3)


def test_a_model_warms_up_along_a_record(tmp_path, model) -> None:
    """At constant velocity the viscous and Coulomb torque go with the warmth, which goes with their power."""
    part = warm_up(7, time=5.0)
    warm = load(save(replace(model, warm_up=part), tmp_path / "model.toml"))
    t = np.arange(0, 40, 0.01)
    qd = np.full((len(t), 7), 0.3)
    q, dt = np.cumsum(qd, axis=0) * 0.01, np.full(len(t), 0.01)
    change = (warm.torque(q, qd, dt=dt) - model.torque(q, qd)) / model.gains
    f = model.friction
    x = (change / -(0.4 * f.viscous * 0.3 + 0.1 * f.coulomb_pos))[200:]
    settled = x[-1]
    rubbing = f.viscous * (1 - 0.4 * settled) * 0.3 + f.coulomb_pos * (1 - 0.1 * settled)
    rubbing = rubbing + f.stribeck * np.exp(-((0.3 / f.stribeck_speed) ** 2))
    np.testing.assert_allclose(settled, np.abs(rubbing * 0.3) / 2.0, rtol=1e-2)
    assert np.array_equal(warm.torque(q, qd), model.torque(q, qd))  # without steps it stays cold


def test_wrong_warm_up_is_refused() -> None:
    with pytest.raises(ShapeError, match="power > 0"):
        warm_up(power=0.0)
    with pytest.raises(ShapeError, match="finite time"):
        warm_up(time=np.nan)
    with pytest.raises(ShapeError, match="one number per joint"):
        replace(warm_up(), start=np.zeros(2))
