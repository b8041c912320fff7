"""The torque model, its quality figures and training data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import contact, identify, robots
from armlab.errors import ShapeError
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel


def test_torque_is_rigid_plus_friction_plus_ripple(model: TorqueModel) -> None:
    t = np.arange(0, 2, 0.004)
    q, qd, qdd = identify.dither(np.zeros(7), 2.0).sample(t)
    z = presliding(q, model.friction.delta, model.friction.resolution)
    expected = model.rigid_torque(q, qd, qdd) + model.friction.torque(qd, z) + model.ripple.torque(q)
    np.testing.assert_allclose(model.torque(q, qd, qdd), model.gains * expected, rtol=0, atol=1e-12)
    slow = model.rigid_torque(q, qd, 0 * q) + model.friction.torque(qd, z) + model.ripple.torque(q)
    np.testing.assert_allclose(model.torque(q, qd), model.gains * slow, rtol=0, atol=1e-12)
    assert model.n == 7
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


GAINS = np.array([1.04, 0.97, 1.02, 0.95, 1.0, 1.03, 0.98])
FORCE = np.array([5.0, -3.0, 8.0])


@pytest.fixture
def calibrated(model: TorqueModel) -> TorqueModel:
    return replace(model, gains=GAINS, gain_cov=0.03**2 * np.eye(7))


def pushed(model: TorqueModel, robot) -> Table:
    """A log of the model's own torque with a force on the tool."""
    t = np.arange(0, 3, 0.004)
    q, qd, qdd = identify.dither(robot.q_home, 3.0).sample(t)
    J = robot.chain.forward_jacobian(q)[1]
    tau = model.torque(q, qd, qdd, np.diff(t, prepend=0.0)) - model.gains * (J[:, :3].transpose(0, 2, 1) @ FORCE)
    return Table(t, {"q": q, "qd": qd, "tau": tau})


@pytest.mark.parametrize("method", ["map", "bounded", "observer", "kf"])
def test_gains_change_the_reading_and_not_the_force(model, calibrated, method: str) -> None:
    yumi = robots.load("yumi_left")
    plain = replace(model, gains=np.ones(7), gain_cov=np.zeros((7, 7)))
    log = pushed(plain, yumi)
    one = contact.Estimator(plain, yumi, method).run(log)
    log = log.with_column("tau", GAINS * log["tau"])
    two = contact.Estimator(calibrated, yumi, method).run(log)
    np.testing.assert_allclose(two["wrench_hat"], one["wrench_hat"], rtol=1e-9, atol=1e-9)
    F = one["wrench_hat"]
    more = two["wrench_hat_cov"] - one["wrench_hat_cov"]
    np.testing.assert_allclose(more, 0.03**2 * F[:, :, None] * F[:, None, :], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("point", [None, [0.0, 0.0, 0.1]], ids=["wrench", "point"])
def test_an_interval_holds_for_all_that_the_gains_may_be(model, point: list[float] | None) -> None:
    """Gains known to 3 %: three deviations further at both ends, of an axis that is held by its box not at all."""
    yumi = robots.load("yumi_left")
    known = replace(model, gains=np.ones(7), gain_cov=np.zeros((7, 7)))
    log = pushed(known, yumi).between(0.0, 0.1)
    sure, wide = (
        contact.Estimator(one, yumi, "interval", point=point).run(log)["wrench_interval"]
        for one in (known, replace(known, gain_cov=0.03**2 * np.eye(7)))
    )
    forces = 3 if point else 6
    box = 10.0 * np.array([20.0, 20, 20, 2, 2, 2])[:forces, None]
    expected = np.clip(sure[:, :forces] + 0.09 * np.array([-1, 1]) * np.abs(sure[:, :forces]), -box, box)
    np.testing.assert_allclose(wide[:, :forces], expected, rtol=1e-9, atol=1e-9)
    assert np.all((wide[:, :, 0] <= sure[:, :, 0]) & (wide[:, :, 1] >= sure[:, :, 1]))
    assert np.mean(wide[:, :, 1] - wide[:, :, 0]) > 1.005 * np.mean(sure[:, :, 1] - sure[:, :, 0])


def test_joints_without_torque_do_not_make_the_gains_of_the_others_surer(model) -> None:
    measured = np.array([1, 1, 1, 1, 0, 0, 0])
    some = replace(model, gains=np.ones(7), gain_cov=np.diag(0.03**2 * measured))
    every = replace(some, gain_cov=0.03**2 * np.eye(7))
    log = pushed(every, robots.load("yumi_left")).between(0.0, 0.4)
    one, two = (contact.Estimator(m, robots.load("yumi_left")).run(log)["wrench_hat_cov"] for m in (some, every))
    np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12)


# Quality figures: one per joint, read-only.


# The ranges of the training data are checked and frozen.
