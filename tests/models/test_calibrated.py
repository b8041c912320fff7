"""Torques as they are read: the kernel divides by the gains and is as unsure of a force as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import contact, identify, robots
from armlab.errors import ShapeError
from armlab.log import Table
from armlab.models import TorqueModel, load, save
from armlab.models.calibrated import CalibratedKernel

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


def test_steps_are_the_run_to_the_last_bit(calibrated) -> None:
    log = pushed(calibrated, robots.load("yumi_left"))
    kernel = calibrated.estimator_kernel(np.ones(6))
    assert isinstance(kernel, CalibratedKernel)
    F, cov = kernel.run(log["q"], log["qd"], log["tau"], log.dt)[:2]
    kernel.reset()
    for k in range(50):
        found = kernel.step(log["q"][k], log["qd"][k], log["tau"][k], float(log.dt[k]))
        assert np.array_equal(found[0], F[k])
        assert np.array_equal(found[1], cov[k])


def test_a_file_keeps_the_gains(calibrated, tmp_path) -> None:
    again = load(save(calibrated, tmp_path / "model.toml"))
    assert np.array_equal(again.gains, GAINS)
    assert np.array_equal(again.gain_cov, calibrated.gain_cov)
    q = np.zeros((1, 7))
    np.testing.assert_array_equal(again.torque(q, q), calibrated.torque(q, q))


def test_gains_that_are_none_are_refused(model) -> None:
    with pytest.raises(ShapeError, match="gains above 0"):
        replace(model, gains=-GAINS)
    with pytest.raises(ShapeError, match=r"gains of shape \(7,\)"):
        replace(model, gains=GAINS[:3])


def test_torque_of_another_number_of_joints_gets_the_sentence_of_the_kernel(calibrated) -> None:
    kernel, zero = calibrated.estimator_kernel(np.ones(6)), np.zeros(7)
    for count in (1, 6):
        with pytest.raises(ShapeError, match="tau"):
            kernel.step(zero, zero, np.zeros(count), 0.004)
