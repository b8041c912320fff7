"""Gravity, friction and offsets from slow motion."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import models
from armlab.contact import Estimator
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import check_estimator
from armlab.estimation.contract import PROPERTIES
from armlab.identify import fit_gravity
from armlab.log import Table


def test_gravity_of_other_poses_is_predicted(truth, gravity) -> None:
    """As it is read, to 3.5 % of its deviation over random poses in the range of the log, 3 % were every gain known;
    offsets but for the asymmetry of friction."""
    model, robot = gravity.value, truth.robot
    rng = np.random.default_rng(0)
    q = rng.uniform(model.training.q_min, model.training.q_max, (500, 7))
    still = np.zeros_like(q)
    expected = robot.chain.rnea(q, still, still, robot.gravity, truth.links)
    found = model.gains * model.rigid_torque(q, still, still)
    heavy = np.std(expected, axis=0) > 0.1
    assert heavy.sum() >= 4
    assert np.all((np.std(found - expected, axis=0) / np.std(expected, axis=0))[heavy] < 0.035)
    offset = np.mean(found - expected, axis=0) + model.friction.offset - truth.friction.offset
    assert np.all(np.abs(offset) < 0.08 * truth.friction.coulomb_pos)


def test_the_model_has_no_torque_of_motion(truth, gravity) -> None:
    model = gravity.value
    assert model.quasi_static
    assert len(model.base_names) == 14
    assert not model.rotor.any()
    rng = np.random.default_rng(1)
    q, qd, qdd = rng.uniform(-1, 1, (3, 50, 7))
    still = np.zeros_like(q)
    moving = model.rigid_torque(q, 3 * qd, 10 * qdd)
    np.testing.assert_allclose(moving, model.rigid_torque(q, still, still), atol=1e-6)
    with_gravity = truth.robot.chain.rnea(q, still, still, model.gravity, model.link_parameters)
    np.testing.assert_allclose(model.rigid_torque(q, still, still), with_gravity, atol=1e-12)


def test_it_is_saved_and_estimates(truth, gravity, slow, tmp_path) -> None:
    again = models.load(models.save(gravity.value, tmp_path / "gravity.toml"))
    assert again.quasi_static
    estimate = Estimator(again, truth.robot).run(slow)
    force = estimate["wrench_hat"][500:, :3]
    assert np.all(np.sqrt(np.mean(force**2, axis=0)) < 2.0), "free motion: no force"


def test_fast_motion_is_refused_by_joint(truth, excited) -> None:
    with pytest.raises(ShapeError, match="Expected slow motion") as caught:
        fit_gravity(excited, truth.robot)
    assert truth.robot.joint_names[6] in str(caught.value)


def test_a_log_at_one_pose_is_refused(truth) -> None:
    t = np.arange(0, 10, 0.004)
    q = np.tile(truth.robot.q_home, (len(t), 1))
    tau = np.random.default_rng(0).standard_normal(q.shape)
    with pytest.raises(NotExcited):
        fit_gravity(Table(t, {"q": q, "qd": np.zeros_like(q), "tau": tau}), truth.robot)


@pytest.mark.slow  # 18 s
def test_errors_halve_with_four_times_the_data_and_match_the_covariance(short_arm) -> None:
    """The statistical contract on a short arm."""
    for law, gain_sd in (("consistent", 0.0), ("honest", 0.05)):  # as for fit_dynamics
        found = check_estimator(
            lambda table, robot: short_arm.of_base(fit_gravity(table, robot)),
            short_arm.experiment(slow=True, gain_sd=gain_sd),
            runs=16,
            n=3000,
            noise_given=False,
            skip=dict.fromkeys(set(PROPERTIES) - {law}, "as fit_dynamics, whose machinery it shares"),
        )
        assert found.passed, found.text()
