"""The estimator at rest and in motion with bounded errors, with a known point, and without a prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab import identify
from armlab.contact import INFEASIBLE, SINGULAR, STUCK, Estimator
from armlab.log import Table
from armlab.state import State


def at_rest(truth, force: np.ndarray, seed: int, seconds: float = 2.0) -> Table:
    """The arm rests at home under `force`, with friction anywhere inside its limits."""
    robot, rng = truth.robot, np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.004)
    q, zero = np.tile(robot.q_home, (len(t), 1)), np.zeros((len(t), 7))
    z = np.tile(rng.uniform(-1, 1, 7), (len(t), 1))
    tau = truth.torque(q, zero, zero, z) - np.einsum("kij,i->kj", robot.chain.jacobian(q), force)
    return Table(t, {"q": q, "qd": zero, "tau": tau + truth.noise * rng.standard_normal(q.shape)})


def test_at_rest_the_interval_holds_the_truth_and_no_contact_is_claimed_without_one(truth, model) -> None:
    """500 g along -z and x: inside the interval in 100 %, half width 2 to 60 N; without a force STUCK and exactly 0."""
    for axis, size in ((2, -4.905), (0, 4.905)):
        force = np.zeros(6)
        force[axis] = size
        for seed in range(10):
            table = Estimator(model, truth.robot, "interval").run(at_rest(truth, force, seed))
            ends = table["wrench_interval"][100:]
            assert not np.any(table["wrench_flags"] & INFEASIBLE)
            assert np.all((ends[:, :, 0] <= force) & (force <= ends[:, :, 1]))
            assert np.all(np.ptp(ends[:, :3], axis=2) > 4.0)
            assert np.all(np.ptp(ends[:, axis], axis=1) < 120.0)
    free = Estimator(model, truth.robot, "bounded").run(at_rest(truth, np.zeros(6), 3))
    assert np.all(free["wrench_flags"][100:] & STUCK)
    assert np.array_equal(free["wrench_hat"][100:], np.zeros_like(free["wrench_hat"][100:]))
    assert not free["wrench_active"][100:].any()


def test_in_motion_the_bounded_estimate_is_as_good_as_the_random_one(truth, model) -> None:
    """A push of 8 N in motion: force RMS within 1 N of the truth by both methods."""
    motion = identify.excitation(truth.robot, seconds=12, f0=0.1, harmonics=4, speed=0.4, seed=31)
    force = np.array([4.0, -4.0, 5.6, 0, 0, 0])
    log = truth.log(motion, seed=9, wrench=lambda t: np.outer(((t > 3) & (t < 9)).astype(float), force))
    inside = (log.t > 3.5) & (log.t < 8.5)
    for method in ("map", "bounded"):
        table = Estimator(model, truth.robot, method).run(log)
        seen = inside & (table["observability"][:, :3].min(axis=1) > 0.9)
        assert seen.sum() > 300
        assert np.sqrt(np.mean((table["wrench_hat"][seen, :3] - force[:3]) ** 2)) < 1.0


def test_a_known_point_about_halves_the_error_and_a_wrong_one_spoils_it(truth, perfect) -> None:
    """Forces at a point 0.15 m from the tool point, at random poses with noise."""
    rng = np.random.default_rng(12)
    robot, point, wrong = truth.robot, np.array([0.0, 0.05, 0.14]), np.array([0.15, 0.0, -0.1])
    errors = {"full": [], "known": [], "wrong": []}
    ways = {"full": None, "known": point, "wrong": wrong}
    estimators = {name: Estimator(perfect, robot, point=where) for name, where in ways.items()}
    zero = np.zeros(7)
    sd = np.sqrt(perfect.covariance.variance(zero) + perfect.friction.static**2)
    for q in rng.uniform(robot.q_min, robot.q_max, (400, 7)):
        T_base_tool = robot.chain.forward(q)
        f = 10 * rng.standard_normal(3)
        F = np.r_[f, np.cross(T_base_tool[:3, :3] @ point, f)]
        tau = perfect.torque(q[None], zero[None])[0] - robot.chain.jacobian(q).T @ F + sd * rng.standard_normal(7)
        for name, estimator in estimators.items():
            estimator.reset()
            wrench = estimator.step(State(t=0.0, dt=0.004, q=q, qd=zero, tau=tau))
            errors[name].append(np.linalg.norm(wrench.F[:3] - f))
            if name == "known":
                np.testing.assert_allclose(wrench.F[3:], np.cross(T_base_tool[:3, :3] @ point, wrench.F[:3]), atol=1e-9)
                assert np.linalg.matrix_rank(wrench.cov, tol=1e-9) == 3
    median = {name: np.median(found) for name, found in errors.items()}
    assert median["known"] < 0.8 * median["full"]
    assert median["wrong"] > 1.3 * median["known"]


def test_without_a_prior_a_singular_pose_is_said_and_not_guessed(truth, perfect) -> None:
    axes = np.tile(np.eye(4), (8, 1, 1))
    axes[:, 2, 3] = 0.1
    planar = replace(perfect, frames=axes)
    state = State(t=0.0, dt=0.004, q=np.zeros(7), qd=np.zeros(7), tau=np.ones(7))
    wrench = Estimator(planar, truth.robot, "ls").step(state)
    assert wrench.flags & SINGULAR
    assert np.isnan(wrench.F).all()
    assert np.isnan(wrench.cond)
