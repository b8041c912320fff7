"""The momentum methods: sign, gaps, tare, known point, options, coverage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import identify
from armlab.contact import TARED, WEAK, Estimator
from armlab.errors import ConfigError, NotExcited
from armlab.log import Table
from armlab.state import State

WAYS: dict[str, dict[str, Any]] = {
    "observer": {"method": "observer"},
    "kf": {"method": "kf"},
    "kf with bias": {"method": "kf", "bias": True},
}


@pytest.fixture(params=sorted(WAYS))
def way(request: pytest.FixtureRequest) -> dict[str, Any]:
    return WAYS[request.param]


def pushed(truth, seconds: float, seed: int) -> tuple[Table, np.ndarray]:
    """Motion with a push of 5 N for 1 s every 3 s, ramps of 0.1 s; the log and the force (N, 3)."""
    motion = identify.design_excitation(truth.robot, seconds=seconds, f0=0.07, harmonics=6, speed=0.4, seed=77)
    rng = np.random.default_rng(seed)

    starts = np.arange(2.0, seconds - 2.0, 3.0)
    directions = rng.standard_normal((len(starts), 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]

    def wrench(t: np.ndarray) -> np.ndarray:
        shares = np.clip(np.minimum(t - starts[:, None], starts[:, None] + 1.0 - t) / 0.1, 0, 1)
        return np.hstack([5.0 * shares.T @ directions, np.zeros((len(t), 3))])

    log = truth.log(motion, seed=seed, wrench=wrench)
    return log, wrench(log.t)[:, :3]


def test_pushes_in_motion_are_found_and_two_sigma_holds(truth, model, way) -> None:
    """The bars of the simulated arm: 1 N RMS, in pushes and without; 90 to 97 % away from edges, 88 % with them."""
    log, force = pushed(truth, 30.0, 8)
    table = Estimator(model, truth.robot, **way).run(log)
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))[:, :3]
    error = table["wrench_hat"][:, :3] - force
    seen = (table["observability"][:, :3] > 0.9) & ((log.t > 1.0) & (log.t < 29.0))[:, None]
    touched = np.any(force != 0.0, axis=1)
    window = np.ones(50)
    ramp = np.convolve(np.any(np.abs(np.diff(force, axis=0, prepend=0)) > 1e-9, axis=1), window)[: len(log)] > 0.5
    assert np.sqrt(np.mean(error[seen & touched[:, None]] ** 2)) < 1.0
    assert np.sqrt(np.mean(error[seen & ~touched[:, None]] ** 2)) < 1.0
    inside = np.abs(error) < 2.0 * sigma
    assert 0.90 < np.mean(inside[seen & ~ramp[:, None]]) < 0.97
    assert np.mean(inside[seen]) > 0.88


def test_rows_that_are_missing_take_their_time_with_them(truth, model, excited, way) -> None:
    """Five rows without torque, and the log without these rows, give one estimate; so do `step` and `run`."""
    log = excited.between(0.0, 2.0)
    missing = (np.arange(len(log)) % 100 >= 60) & (np.arange(len(log)) % 100 < 64)
    holed = log.with_column("tau", np.where(missing[:, None], np.nan, log["tau"]))
    estimator = Estimator(model, truth.robot, **way)
    table = estimator.run(holed)
    short = estimator.run(log.rows(~missing))
    assert np.array_equal(table["wrench_hat"][~missing], short["wrench_hat"])
    estimator.reset()
    for k, state in enumerate(holed.states()):
        assert np.array_equal(estimator.step(state).wrench, table["wrench_hat"][k], equal_nan=True)


def test_over_a_gap_nothing_is_made_up(truth, model, way) -> None:
    """Half a second is missing in fast motion: the error after it is that of everywhere else."""
    motion = identify.design_excitation(truth.robot, seconds=12, speed=0.6, seed=5)
    log = truth.log(motion, seed=5)
    kept = np.ones(len(log), dtype=bool)
    for start in range(500, 2600, 300):
        kept[start : start + 125] = False
    table = Estimator(model, truth.robot, **way).run(log.rows(kept))
    F, sigma = table["wrench_hat"], np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
    after = np.flatnonzero(np.diff(table.t, prepend=0) > 0.1)[:, None] + np.arange(40)
    assert np.mean(np.abs(F[after]) < 2.0 * sigma[after]) > 0.9
    assert np.abs(F[after][:, :, :3]).max() < 6.0


def test_a_tare_at_rest_tells_friction_from_contact(truth, model, resting) -> None:
    """Before it a press is lost in friction and the band says so; after it the press is there, with a narrow band."""
    force = np.array([3.0, -2.0, 4.0, 0.0, 0.0, 0.0])
    estimator = Estimator(model, truth.robot, "kf", bias=True)
    states = list(resting(force, seconds=4.0).states())
    half = len(states) // 2
    before = [estimator.step(state) for state in states[:half]][-1]
    assert before.tared_at is None
    assert before.sigma[:3].min() > 3.0
    estimator.tare()
    wrench = estimator.step(states[half])
    assert wrench.flags & TARED
    assert wrench.tared_at == states[half - 1].t
    np.testing.assert_allclose(wrench.wrench[:3], 0.0, atol=0.2)
    last = [estimator.step(state) for state in states[half + 1 :]][-1]
    assert np.all(last.sigma[:3] < 1.0)
    np.testing.assert_allclose(last.wrench[:3], force[:3], atol=1.5)
    assert np.all(np.abs(last.wrench - force) < 3.0 * last.sigma)


def test_a_tare_ends_when_a_joint_has_moved_its_presliding_distance(truth, model, resting) -> None:
    estimator = Estimator(model, truth.robot, "kf", bias=True)
    states = list(resting(np.zeros(6)).states())
    for state in states:
        estimator.step(state)
    estimator.tare()
    delta, resolution = model.friction.delta[3], model.friction.resolution[3]
    state = states[-1]
    for share, flagged in ((0.5, True), (0.9, True), (1.2, False), (0.0, False)):
        q = np.array(state.q)
        q[3] += share * delta + (resolution if share else 0.0)
        wrench = estimator.step(replace(state, t=state.t + 0.004, q=q))
        assert bool(wrench.flags & TARED) == flagged
        assert (wrench.tared_at is None) == (not flagged)
    estimator.reset()
    assert estimator.step(state).flags & TARED == 0


def test_a_tare_is_refused_in_motion_and_where_there_is_nothing_to_set(truth, model, excited) -> None:
    for estimator in (Estimator(model, truth.robot), Estimator(model, truth.robot, "kf")):
        with pytest.raises(ConfigError, match="bias=True"):
            estimator.tare()
    estimator = Estimator(model, truth.robot, "kf", bias=True)
    with pytest.raises(NotExcited, match="rest"):
        estimator.tare()
    for state in excited.between(5.0, 5.2).states():
        estimator.step(state)
    with pytest.raises(NotExcited, match="rest"):
        estimator.tare()


@pytest.mark.parametrize("options", [{"method": "map"}, {"method": "kf"}, {"method": "kf", "bias": True}])
def test_at_rest_the_band_holds_whatever_friction_does(truth, model, resting, options: dict[str, Any]) -> None:
    inside = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        force = np.r_[4.9 * rng.standard_normal(3) / np.sqrt(3), 0, 0, 0]
        table = Estimator(model, truth.robot, **options).run(resting(force, 2.0, seed))
        sigma = np.sqrt(np.diag(table["wrench_hat_cov"][-1]))
        inside.append(np.abs(table["wrench_hat"][-1] - force) < 2.0 * sigma)
    assert np.mean(inside) > 0.95


def test_what_a_pose_hides_stays_as_the_prior_has_it(truth, model, way) -> None:
    """Seven axes on one line for a minute: five directions keep their prior, and no force is made up."""
    axes = np.tile(np.eye(4), (8, 1, 1))
    axes[:, 2, 3] = 0.1
    estimator = Estimator(replace(model, frames=axes, gravity=np.zeros(3)), truth.robot, **way)
    state = State(t=0.0, dt=0.02, q=np.zeros(7), qd=np.zeros(7), tau=0.3 * np.ones(7))
    for _ in range(3000):
        wrench = estimator.step(state)
    np.testing.assert_allclose(wrench.wrench[:5], 0.0, atol=1e-6)
    np.testing.assert_allclose(wrench.observability[:5], 0.0, atol=1e-6)
    assert wrench.flags == WEAK
    assert np.all(wrench.sigma[:5] < 1.0001 * np.sqrt(estimator.prior[:5]))


def test_a_contact_at_a_known_point_has_the_moment_of_its_force(truth, model, excited, way) -> None:
    point = np.array([0.02, 0.05, 0.1])
    wide = Estimator(model, truth.robot, **way)
    estimator = Estimator(model, truth.robot, point=point, **way)
    for state in excited.between(3.0, 3.5).states():
        known, free = estimator.step(state), wide.step(state)
        r = truth.robot.chain.forward(state.q)[:3, :3] @ point
        np.testing.assert_allclose(known.wrench[3:], np.cross(r, known.wrench[:3]), atol=1e-12)
    assert known.at_point
    assert np.all(known.sigma[:3] < free.sigma[:3])
