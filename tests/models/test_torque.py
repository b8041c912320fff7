"""The torque model evaluates what was identified and belongs to one robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify, robots
from armlab.errors import ModelMismatchError, ShapeError
from armlab.kernels import presliding
from armlab.models import Quality, TorqueModel


def test_torque_is_rigid_plus_friction_plus_ripple(model: TorqueModel) -> None:
    t = np.arange(0, 2, 0.004)
    q, qd, qdd = identify.dither(np.zeros(7), 2.0).sample(t)
    z = presliding(q, model.friction.delta, model.friction.resolution)
    expected = model.rigid_torque(q, qd, qdd) + model.friction.torque(qd, z) + model.ripple.torque(q)
    np.testing.assert_allclose(model.torque(q, qd, qdd), model.gains * expected, rtol=0, atol=1e-12)
    slow = model.rigid_torque(q, qd, 0 * q) + model.friction.torque(qd, z) + model.ripple.torque(q)
    np.testing.assert_allclose(model.torque(q, qd), model.gains * slow, rtol=0, atol=1e-12)
    assert model.n == 7
    assert isinstance(model.quality, Quality)
    assert not any(getattr(model.quality, name).flags.writeable for name in ("torque_sd", "rms", "rms_cv", "coverage"))
    with pytest.raises(ShapeError, match=r"rms_cv of one number per joint, got shape \(3,\)"):
        replace(model.quality, rms_cv=np.zeros(3))


def test_a_row_with_nan_gives_nan_and_leaves_the_state(model: TorqueModel) -> None:
    q, qd, qdd = identify.dither(np.zeros(7), 2.0).sample(np.arange(0, 2, 0.004))
    broken = qd.copy()
    broken[100, 3] = np.nan
    kept = np.arange(len(q)) != 100
    torque = model.torque(q, broken, qdd)
    assert np.isnan(torque[100]).all()
    np.testing.assert_array_equal(torque[kept], model.torque(q[kept], qd[kept], qdd[kept]))


def test_the_drive_of_a_model_is_friction_and_ripple(model: TorqueModel) -> None:
    rng = np.random.default_rng(0)
    q, qd, z = rng.standard_normal((3, 20, 7))
    np.testing.assert_allclose(
        model.drive.torque(q, qd, z), model.friction.torque(qd, z) + model.ripple.torque(q), rtol=0, atol=1e-12
    )


def test_gravity_alone_is_the_torque_at_rest(model: TorqueModel, truth) -> None:
    """Gravity is what the base parameters say: the same as the truth's to 5 % of the largest torque."""
    q = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 7)) + truth.robot.q_home * [0, 0.5, 0, 0, 0, 0, 0]
    zero = np.zeros_like(q)
    mine = model.rigid_torque(q, zero, zero)
    true = truth.robot.chain.rnea(q, zero, zero, truth.robot.gravity, truth.links)
    assert np.abs(mine - true).max() < 0.05 * np.abs(true).max()


def test_another_robot_is_refused(model: TorqueModel) -> None:
    with pytest.raises(ModelMismatchError, match="yumi_right"):
        model.check_robot(robots.load("yumi_right"))
    model.check_robot(robots.load("yumi_left"))


def test_the_kernel_of_a_model_is_fresh(model: TorqueModel) -> None:
    prior = np.ones(6)
    one, two = model.estimator_kernel(prior), model.estimator_kernel(prior)
    zero = np.zeros(7)
    one.step(zero, zero, zero, 0.004)
    a, b = one.step(zero + 1e-3, zero, zero, 0.004)[0], two.step(zero + 1e-3, zero, zero, 0.004)[0]
    assert not np.array_equal(a, b)
