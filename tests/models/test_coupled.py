"""Motors that move several joints: power is kept, and estimators see past them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab import models
from armlab.models import CoupledMotors
from armlab.models.torque import CoupledKernel

WRIST = CoupledMotors(np.array([[0, 0, 0, 0, 0, 0.5, 1.0]]), [0.02], [0.3], [0.4], [0.02])


def test_one_motor_of_two_joints() -> None:
    """Row and column: what it takes of one joint for the other's motion it takes of the other for the one's."""
    qd, qdd = np.zeros(7), np.zeros(7)
    qdd[5] = 2.0
    np.testing.assert_allclose(WRIST.torque(qd, qdd)[5:], 0.02 * 2.0 * 0.5 * np.array([0.5, 1.0]))
    np.testing.assert_allclose(WRIST.inertial(qdd), WRIST.torque(qd, qdd))
    qd[6] = 3.0
    speed = 3.0
    own = 0.3 * speed + 0.4 * np.tanh(speed / 0.02)
    np.testing.assert_allclose(WRIST.torque(qd, 0 * qdd)[5:], own * np.array([0.5, 1.0]))
    assert not WRIST.torque(qd, qdd)[:5].any()


def test_a_model_with_them_predicts_and_estimates_past_them(model, excited, tmp_path) -> None:
    """The log of an arm with a coupled wrist: the model without the wrist sees forces, the one with it none."""
    wrist = replace(model, coupled=WRIST)
    q, qd, dt = (np.ascontiguousarray(x[:500]) for x in (excited["q"], excited["qd"], excited.dt))
    qdd = np.diff(qd, axis=0, prepend=qd[:1]) / dt[:, None]
    tau = model.torque(q, qd, qdd) + model.gains * WRIST.torque(qd, qdd)
    np.testing.assert_allclose(wrist.torque(q, qd, qdd), tau, atol=1e-12)
    zero = np.zeros_like(q)
    np.testing.assert_allclose(wrist.rigid_torque(q, zero, qdd) - model.rigid_torque(q, zero, qdd), WRIST.inertial(qdd))
    plain, relieved = model.estimator_kernel(np.ones(6)), wrist.estimator_kernel(np.ones(6))
    without, found = plain.run(q, qd, tau, dt)[0], relieved.run(q, qd, tau, dt)[0]
    true = replace(model, gains=np.ones(7), gain_cov=np.zeros((7, 7)))
    by_hand = CoupledKernel(true.estimator_kernel(np.ones(6)), WRIST, np.ones(7))
    np.testing.assert_allclose(by_hand.run(q, qd, tau / model.gains, dt)[0], found, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found, 0.0, atol=1e-9)
    assert np.abs(without).max() > 1e-3
    again = models.load(models.save(wrist, tmp_path / "wrist.toml"))
    np.testing.assert_array_equal(again.coupled.ratios, WRIST.ratios)
    np.testing.assert_array_equal(again.torque(q, qd, qdd), wrist.torque(q, qd, qdd))


def test_step_and_run_are_equal_bit_for_bit_also_past_holes(model, excited) -> None:
    wrist = replace(model, coupled=WRIST)
    q, qd, tau = (np.array(excited[name][:300]) for name in ("q", "qd", "tau"))
    dt = np.array(excited.dt[:300])
    qd[40:43, 2], tau[100, 0], dt[150] = np.nan, np.inf, 0.0
    stepped, run = wrist.estimator_kernel(np.ones(6)), wrist.estimator_kernel(np.ones(6))
    one_by_one = [stepped.step(q[k], qd[k], tau[k], float(dt[k])) for k in range(300)]
    halves = [run.run(q[a:b], qd[a:b], tau[a:b], dt[a:b]) for a, b in ((0, 170), (170, 300))]
    np.testing.assert_array_equal([s[0] for s in one_by_one], np.concatenate([h[0] for h in halves]))
    run.reset()
    np.testing.assert_array_equal(run.run(q[:170], qd[:170], tau[:170], dt[:170])[0], halves[0][0])
