"""How warm drives are along a record: as the kernels have it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.identify import prepare
from armlab.identify.residuals import BIN, begun, dry_torques, friction_signs, mean_power, relaxed, seconds, settled
from armlab.models import WarmUp


def test_seconds_count_from_the_first_row() -> None:
    assert seconds(np.array([7.5, 8.0, 8.6, 10.4])).tolist() == [0, 0, 1, 2]


def test_constant_power_warms_as_the_law_says() -> None:
    """x(t) = h + (x0 - h) exp(-t / T) in the middle of each second."""
    x = relaxed(np.full(600, 0.7), 150.0, 2.0)
    np.testing.assert_allclose(x, 0.7 + 1.3 * np.exp(-BIN * (np.arange(600) + 0.5) / 150.0), atol=2e-5)


def test_warmth_settles_with_its_own_friction() -> None:
    """Viscous friction f qd^2 (1 - 0.4 x) of constant speed: x = h / (1 + 0.4 h) in the end."""
    k = np.array([2.0, 0.0, 0.0, 0.0, -0.8, 0.0])
    power = np.tile([0.5, 0.0, 0.0], (3000, 1))
    assert settled(power, k, 120.0, 0.0, 1.0)[-1] == pytest.approx(1.0 / 1.4, rel=1e-3)


def test_pieces_begin_as_warm_as_the_log_has_made_them(truth, excited, model) -> None:
    """Torque of a piece alone is that of the whole log; without its warmth it is not."""
    zero = np.zeros(7)
    warm = WarmUp(zero - 0.3, zero - 0.4, np.where(np.arange(7) < 5, 20.0, 0.0), zero + 1.0, zero + 0.2)
    hot, data = replace(model, warm_up=warm), prepare(excited, truth.robot)
    whole = hot.torque(data.q, data.qd, dt=data.dt)
    pieces = [(0, 1000), (4000, 6000)]
    for one, a, b in begun(hot, data, pieces):
        alone = one.torque(data.q[a:b], data.qd[a:b], dt=data.dt[a:b])
        np.testing.assert_allclose(alone[500:], whole[a + 500 : b], atol=0.02)
    cold = hot.torque(data.q[4000:6000], data.qd[4000:6000], dt=data.dt[4000:6000])
    assert np.abs(cold[500:] - whole[4500:6000]).max() > 0.2
    assert [(one is model, a, b) for one, a, b in begun(model, data, pieces)] == [(True, 0, 1000), (True, 4000, 6000)]


def test_the_power_of_friction_is_its_torque_times_speed(truth, excited, model) -> None:
    data = prepare(excited, truth.robot)
    qd, s, number = data.qd[:, 2], friction_signs(model, data), seconds(data.t)
    c, rest = dry_torques(model, 2, qd, s[:, 2])
    zero = np.zeros(7)
    smooth = replace(model, ripple=replace(model.ripple, cosine=zero, sine=zero))
    friction = smooth.drive.torque(data.q, data.qd, s)[:, 2]
    np.testing.assert_allclose(
        model.friction.viscous[2] * qd + c + rest + model.friction.offset[2], friction, atol=1e-9
    )
    means = mean_power(model, 2, qd, s[:, 2], number)
    np.testing.assert_allclose(means[1, 1], np.mean((c * qd)[number == 1]), rtol=1e-12)
