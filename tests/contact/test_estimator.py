"""The wrench estimator: static and momentum methods, contact points, units, and the estimate itself."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import identify
from armlab.contact import INFEASIBLE, INVALID, SINGULAR, STUCK, TARED, WEAK, Estimator, Wrench
from armlab.errors import ConcurrentUse, NotExcited, ShapeError
from armlab.kernels import presliding
from armlab.lie import se3
from armlab.log import Table
from armlab.models import TorqueModel, velocity_covariance
from armlab.models.uncertainty import FORCE_RATES, PRIOR
from armlab.state import State

PRIOR_SD = np.array([20.0, 20, 20, 2, 2, 2])
ON_ONE_LINE = np.tile(se3.from_rp(np.eye(3), [0.0, 0.0, 0.1]), (8, 1, 1))  # seven collinear axes: one visible direction
WAYS: dict[str, dict[str, Any]] = {
    **{
        name: {"method": name} for name in ("map", "bounded", "clip", "interval", "ls", "lund", "ols", "observer", "kf")
    },
    "kf with bias": {"method": "kf", "bias": True},
}


def press(direction: np.ndarray):
    return lambda t: np.outer(np.clip(t / 0.5, 0, 1), direction)


@pytest.mark.parametrize("way", ["map", "interval", "observer", "kf with bias"])
def test_run_equals_step_bit_for_bit(truth, model, excited, way: str) -> None:
    log = excited.between(0.0, 0.3 if way == "interval" else 1.0)
    estimator = Estimator(model, truth.robot, **WAYS[way])
    table = estimator.run(log)
    estimator.reset()
    for k, state in enumerate(log.states()):
        wrench = estimator.step(state)
        assert np.array_equal(wrench.wrench, table["wrench_hat"][k])
        assert np.array_equal(wrench.cov, table["wrench_hat_cov"][k])
        assert np.array_equal(wrench.observability, table["observability"][k])


@pytest.mark.parametrize("way", ["map", "observer", "kf", "kf with bias"])
def test_a_broken_sample_gives_nan_and_leaves_the_state_alone(truth, model, excited, way: str) -> None:
    good, disturbed = (Estimator(model, truth.robot, **WAYS[way]) for _ in range(2))
    for k, state in enumerate(excited.between(0.0, 1.0).states()):
        if k == 100:
            huge = np.full(7, 1e200)  # its torque overflows
            for bad in (replace(state, tau=np.full(7, np.nan)), replace(state, dt=0.0), replace(state, qd=huge)):
                wrench = disturbed.step(bad)
                assert wrench.flags == INVALID
                assert np.isnan(wrench.wrench).all()
                assert np.isnan(wrench.cov).all()
        assert np.array_equal(good.step(state).wrench, disturbed.step(state).wrench)


@pytest.fixture(scope="module")
def moving(truth) -> Table:
    return truth.log(identify.design_excitation(truth.robot, seconds=12, seed=3), seed=8)


@pytest.mark.parametrize("method", ["map", "bounded", "interval"])
def test_over_a_gap_nothing_is_made_up(truth, model, moving, method: str) -> None:
    """Friction during the gap is unknown, and the filter state from before it is not valid afterwards."""
    log, held = moving, []
    for start in np.arange(2.0, 9.0, 1.0):
        torn = log.rows(((log.t > start - 1.0) & (log.t <= start)) | ((log.t >= start + 0.6) & (log.t < start + 1.0)))
        table = Estimator(model, truth.robot, method).run(torn)
        after = np.flatnonzero(table.t >= start + 0.6)[method == "map" :]  # the first row has no acceleration
        F, cov = table["wrench_hat"][after], table["wrench_hat_cov"][after]
        held.append(np.abs(F) <= 3 * np.sqrt(np.einsum("kii->ki", cov)))
        assert np.max(np.abs(F[:, :3])) < 12.0
    assert np.mean(held) > 0.95


@pytest.mark.parametrize("method", ["bounded", "clip", "interval"])
def test_a_row_without_an_acceleration_proves_no_contact(truth, model, excited, method: str) -> None:
    """The inertial torque is unknown at the first row of a log in motion and would count as contact."""
    for start in (5.0, 8.3, 12.1):
        table = Estimator(model, truth.robot, method).run(excited.between(start, start + 0.01))
        assert np.all(table["wrench_hat"][0] == 0.0)
        assert table["observability"][0] == pytest.approx(0.0, abs=1e-9)
        assert table["wrench_flags"][0] & STUCK
        if method == "interval":
            assert np.all(table["wrench_interval"][0] == [[-200.0, 200.0]] * 3 + [[-20.0, 20.0]] * 3)


@pytest.mark.parametrize("method", ["map", "interval", "kf"])
def test_progress_is_told_and_changes_nothing(truth, model, excited, method: str) -> None:
    log = excited.between(0.0, 0.42)
    tau = log["tau"].copy()
    tau[60:63, 2] = np.nan
    log = log.with_column("tau", tau)
    heard: list[tuple[int, int, str]] = []
    estimator = Estimator(model, truth.robot, method)
    told = estimator.run(log, progress=lambda *words: heard.append(words))
    quiet = estimator.run(log)
    for name in quiet.names:
        assert np.array_equal(told[name], quiet[name], equal_nan=True)
    assert heard[0] == (0, len(log), f"{method} estimate of {len(log)} rows")
    assert heard[-1] == (len(log), len(log), "done")
    assert len(heard) > 50


@pytest.mark.parametrize("way", ["map", "observer", "kf", "kf with bias"])
def test_a_press_appears_along_its_axes_with_its_signs(truth, model, perfect, way: str) -> None:
    """A force of +5 N from the environment along base x gives +5 N."""
    force = np.array([5.0, -4.0, 3.0, 0, 0, 0])
    motion, exact = identify.dither(truth.robot.q_home, seconds=4.0), way == "map"
    log = truth.log(motion, noise=0.0 if exact else 0.1, wrench=press(force))
    for sign in (1.0, -1.0):
        turned = log if sign > 0 else truth.log(motion, noise=0.0 if exact else 0.1, wrench=press(-force))
        table = Estimator(perfect if exact else model, truth.robot, **WAYS[way]).run(turned)
        np.testing.assert_allclose(
            table["wrench_hat"][500:, :3].mean(axis=0), sign * force[:3], atol=0.3 if exact else 1.0
        )


def test_a_singular_pose_gives_a_finite_estimate_and_a_hidden_direction(truth, perfect) -> None:
    """Seven collinear axes: five directions of the wrench keep their prior."""
    q, zero = np.zeros(7), np.zeros(7)
    planar = replace(perfect, frames=ON_ONE_LINE)
    wrench = Estimator(planar, truth.robot).step(State(t=0.0, dt=0.004, q=q, qd=zero, tau=np.ones(7)))
    J = planar.chain.jacobian(q)
    assert np.linalg.matrix_rank(J) == 1
    assert np.all(np.isfinite(wrench.wrench))
    assert np.linalg.norm(J.T @ (wrench.hidden * PRIOR_SD)) < 1e-9
    np.testing.assert_allclose(wrench.observability[:5], 0.0, atol=1e-6)
    assert wrench.observability[5] > 0.5
    np.testing.assert_allclose(wrench.wrench[:5], 0.0, atol=1e-9)
    assert wrench.cond > 1e6
    assert wrench.flags == WEAK


def test_coverage_and_force_error_on_another_motion(truth, model) -> None:
    """Free motion with another seed: false force at most 1 N RMS where observable; 2 sigma covers 85 to 99 %."""
    motion = identify.design_excitation(truth.robot, seconds=20, f0=0.07, harmonics=6, speed=0.4, seed=77)
    table = Estimator(model, truth.robot).run(truth.log(motion, seed=8)).between(2.0, 18.0)
    F, sigma = table["wrench_hat"], np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
    for axis in range(3):
        seen = table["observability"][:, axis] > 0.9
        assert np.sqrt(np.mean(F[seen, axis] ** 2)) < 1.0
        assert 0.85 < np.mean(np.abs(F[seen, axis]) < 2 * sigma[seen, axis]) < 0.99


def elsewhere(call: Callable[..., Any], *args: Any) -> Any:
    """Call in a separate thread."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(call, *args).result()


def test_two_threads_by_turns_are_refused_until_a_reset(truth, model, excited) -> None:
    states = list(excited.between(0.0, 0.1).states())
    estimator = Estimator(model, truth.robot)
    with ThreadPoolExecutor(1) as other:
        estimator.step(states[0])
        other.submit(estimator.step, states[1]).result()  # a thread may take over
        for _ in range(2):
            with pytest.raises(ConcurrentUse, match="got samples from two alternating threads"):
                estimator.step(states[2])
        with pytest.raises(ConcurrentUse, match="alternating"):  # also from the other thread: the state is mixed
            other.submit(estimator.step, states[2]).result()
        estimator.reset()
        estimator.step(states[0])


def test_a_run_is_the_only_user(truth, model, excited) -> None:
    log = excited.between(0.0, 1.0)
    estimator = Estimator(model, truth.robot, "kf", bias=True)
    wanted = estimator.run(log)["wrench_hat"]
    calls = [(estimator.step, next(iter(log.states()))), (estimator.reset,), (estimator.tare,), (estimator.run, log)]
    refused = []

    def meanwhile(done: int, total: int, what: str) -> None:
        if calls:
            with pytest.raises(ConcurrentUse, match=r"but another thread is in run\(\)"):
                elsewhere(*calls.pop())
            refused.append(done)

    assert np.array_equal(estimator.run(log, progress=meanwhile)["wrench_hat"], wanted)
    assert len(refused) == 4
    elsewhere(estimator.run, log)


# Bounded errors, known points, no prior.


def test_at_rest_the_interval_holds_the_truth_and_no_contact_is_claimed_without_one(truth, model, resting) -> None:
    """500 g along -z and x: always inside the interval, half width 2 to 60 N; without a force, STUCK and exactly 0."""
    for axis, size in ((2, -4.905), (0, 4.905)):
        force = np.zeros(6)
        force[axis] = size
        for seed in range(6):
            table = Estimator(model, truth.robot, "interval").run(resting(force, 0.6, seed, begins=-1.0))
            ends = table["wrench_interval"][100:]
            assert not np.any(table["wrench_flags"] & INFEASIBLE)
            assert np.all((ends[:, :, 0] <= force) & (force <= ends[:, :, 1]))
            assert np.all(np.ptp(ends[:, :3], axis=2) > 4.0)
            assert np.all(np.ptp(ends[:, axis], axis=1) < 120.0)
    free = Estimator(model, truth.robot, "bounded").run(resting(np.zeros(6), 2.0, 3))
    assert np.all(free["wrench_flags"][100:] & STUCK)
    assert np.array_equal(free["wrench_hat"][100:], np.zeros_like(free["wrench_hat"][100:]))
    assert not free["wrench_active"][100:].any()


def test_in_motion_the_bounded_estimate_is_as_good_as_the_random_one(truth, model) -> None:
    """An 8 N push in motion: both methods estimate the force within 1 N RMS of the truth."""
    motion = identify.design_excitation(truth.robot, seconds=12, f0=0.1, harmonics=4, speed=0.4, seed=31)
    force = np.array([4.0, -4.0, 5.6, 0, 0, 0])
    log = truth.log(motion, seed=9, wrench=lambda t: np.outer(((t > 3) & (t < 9)).astype(float), force))
    inside = (log.t > 3.5) & (log.t < 8.5)
    for method in ("map", "bounded"):
        table = Estimator(model, truth.robot, method).run(log)
        seen = inside & (table["observability"][:, :3].min(axis=1) > 0.9)
        assert seen.sum() > 300
        assert np.sqrt(np.mean((table["wrench_hat"][seen, :3] - force[:3]) ** 2)) < 1.0


def test_without_a_prior_a_singular_pose_is_said_and_not_guessed(truth, perfect) -> None:
    planar = replace(perfect, frames=ON_ONE_LINE)
    state = State(t=0.0, dt=0.004, q=np.zeros(7), qd=np.zeros(7), tau=np.ones(7))
    wrench = Estimator(planar, truth.robot, "ls").step(state)
    assert wrench.flags & SINGULAR
    assert np.isnan(wrench.wrench).all()
    assert np.isnan(wrench.cond)


# Wrench: sigma, condition, observability per direction, hidden direction.


VARIANCES = np.array([400.0, 400, 400, 4, 4, 4])


def wrench(cov: np.ndarray, flags: int = 0, at_point: bool = False) -> Wrench:
    observability = 1 - np.diag(cov) / VARIANCES
    return Wrench(
        np.ones(6),
        cov,
        observability,
        np.zeros(7),
        np.ones(7),
        VARIANCES,
        flags,
        np.ones(7, dtype=bool),
        None,
        at_point,
    )


def test_wrench_tells_what_cannot_be_seen() -> None:
    cov = np.diag(VARIANCES * [0.1, 0.1, 0.1, 0.1, 0.1, 1.0])
    blind = wrench(cov, WEAK)
    assert abs(blind.hidden[5]) == 1.0
    assert blind.cond == float("inf")
    np.testing.assert_allclose(blind.sigma, np.sqrt(np.diag(cov)))
    seen, axes = blind.directions
    np.testing.assert_allclose(seen, [0.0, 0.9, 0.9, 0.9, 0.9, 0.9], atol=1e-12)
    assert np.array_equal(axes[:, 0], blind.hidden)
    even = wrench(np.diag(VARIANCES * 0.2))
    assert abs(even.cond - 1.0) < 1e-9
    uneven = wrench(np.diag(VARIANCES * [0.5, 0.5, 0.5, 0.5, 0.5, 1 / 26]))
    assert abs(uneven.cond - 5.0) < 1e-9


def test_at_a_known_point_three_directions_count() -> None:
    known = wrench(np.diag(VARIANCES * [0.5, 0.5, 1 / 26, 0, 0, 0]), at_point=True)
    assert abs(known.cond - 5.0) < 1e-9
    assert known.hidden.shape == (3,)
    np.testing.assert_allclose(known.directions[0], [0.5, 0.5, 25 / 26])


def test_an_estimate_that_is_missing_has_no_direction() -> None:
    for flags in (INVALID, SINGULAR, INVALID | STUCK | INFEASIBLE | TARED):
        missing = wrench(np.full((6, 6), np.nan), flags)
        assert np.isnan(missing.cond)
        assert np.isnan(missing.hidden).all()
        assert np.isnan(missing.directions[0]).all()


# Units and weights.


CHECKED = [name for name in WAYS if name != "lund"]


@pytest.fixture(scope="module")
def log(truth) -> Table:
    """A hard push in motion that no joint's friction bound hides."""
    wrench = np.array([12.0, -9.0, 10.0, 0.4, 0.5, -0.3])
    motion = identify.dither(truth.robot.q_home + np.array([0.2, 0.1, -0.3, 0.2, 0.1, 0.3, 0.0]), seconds=1.0)
    return truth.log(motion, seed=3, wrench=lambda t: np.tile(wrench, (len(t), 1))).between(0.3, 0.6)


def in_units(model: TorqueModel, force: float, length: float) -> TorqueModel:
    """The model in units where one newton is `force` force units and one metre is `length` length units."""
    torque, f, r, c, b = force * length, model.friction, model.ripple, model.covariance, model.bound
    frames = np.array(model.frames)
    frames[:, :3, 3] *= length
    known, n = model.parameters, model.n
    of_link, at = np.r_[force / length, np.full(3, force), np.full(6, torque)], known.columns.astype(int)
    unit = np.where(at < 10 * n, of_link[at % 10], np.where((at >= 11 * n) & ((at - 11 * n) % 7 == 6), 1.0, torque))
    lower = (known.cov * np.outer(unit, unit))[np.tril_indices(len(unit))]
    torques = ("viscous", "coulomb_pos", "coulomb_neg", "offset", "stribeck", "root")
    return replace(
        model,
        frames=frames,
        gravity=model.gravity * length,
        link_parameters=model.link_parameters * of_link,
        rotor=model.rotor * torque,
        friction=replace(f, **{name: getattr(f, name) * torque for name in torques}),
        ripple=replace(r, cosine=r.cosine * torque, sine=r.sine * torque),
        covariance=velocity_covariance(c.kind, c.C0 * torque**2, c.Cinf * torque**2, c.shape, c.alpha2),
        bound=replace(b, torque=b.torque * torque, floor=b.floor * torque),
        parameters=replace(known, lower=lower, mean=known.mean * torque**2),
    )


def estimate(
    way: str, model: TorqueModel, truth: Any, log: Table, force: float = 1.0, length: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Wrench (N, 6) and covariance (N, 6, 6) in newtons and metres."""
    scale = np.r_[np.full(3, force), np.full(3, force * length)]
    options = dict(WAYS[way])
    if options["method"] == "kf":
        options["force_rate"] = np.array(FORCE_RATES["normal"]) * scale
    estimator = Estimator(in_units(model, force, length), truth.robot, prior=np.array(PRIOR) * scale, **options)
    table = estimator.run(log.with_column("tau", log["tau"] * force * length))
    return table["wrench_hat"] / scale, table["wrench_hat_cov"] / np.outer(scale, scale)


@pytest.mark.parametrize("way", CHECKED)
def test_the_wrench_is_the_same_in_kilonewtons_and_millimetres(truth, model, log, way: str) -> None:
    F, cov = estimate(way, model, truth, log)
    other, other_cov = estimate(way, model, truth, log, 1e-3, 1e3)
    accuracy = 1e-6 if way == "clip" else 1e-9  # clip stops at a tolerance
    np.testing.assert_allclose(other / PRIOR, F / PRIOR, rtol=0, atol=accuracy * np.abs(F / PRIOR).max())
    sizes = np.outer(PRIOR, PRIOR)
    np.testing.assert_allclose(other_cov / sizes, cov / sizes, rtol=0, atol=accuracy * np.abs(cov / sizes).max())


# Momentum methods.


@pytest.fixture(params=["observer", "kf", "kf with bias"])
def way(request: pytest.FixtureRequest) -> dict[str, Any]:
    return WAYS[request.param]


@pytest.fixture(scope="module")
def pushed(truth) -> tuple[Table, np.ndarray]:
    """Log and force (N, 3) of a motion with a 5 N push for 1 s every 3 s, with ramps of 0.1 s."""
    seconds, seed = 30.0, 8
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


def test_pushes_in_motion_are_found_and_two_sigma_holds(truth, model, pushed, way) -> None:
    """Targets: 1 N RMS during and between pushes; coverage 90 to 97 % away from edges, above 88 % overall."""
    log, force = pushed
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
    """Rows without torque and a log without these rows give the same estimate; so do `step` and `run`."""
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


def test_over_a_gap_nothing_is_made_up_by_momentum_methods(truth, model, moving, way) -> None:
    """Half a second is missing in fast motion: the error after the gap is as small as elsewhere."""
    log = moving
    kept = np.ones(len(log), dtype=bool)
    for start in range(500, 2600, 300):
        kept[start : start + 125] = False
    table = Estimator(model, truth.robot, **way).run(log.rows(kept))
    F, sigma = table["wrench_hat"], np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
    after = np.flatnonzero(np.diff(table.t, prepend=0) > 0.1)[:, None] + np.arange(40)
    assert np.mean(np.abs(F[after]) < 2.0 * sigma[after]) > 0.9
    assert np.abs(F[after][:, :, :3]).max() < 6.0


def test_a_tare_at_rest_tells_friction_from_contact(truth, model, resting) -> None:
    """Before the tare, friction hides the press and the band is wide; after it, the press shows with a narrow band."""
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


def test_a_tare_is_refused_in_motion(truth, model, excited) -> None:
    estimator = Estimator(model, truth.robot, "kf", bias=True)
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
    """Seven collinear axes for a minute: five directions keep their prior, and no false force appears."""
    estimator = Estimator(replace(model, frames=ON_ONE_LINE, gravity=np.zeros(3)), truth.robot, **way)
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


@pytest.mark.parametrize("way", ["map", "observer"])
def test_friction_of_the_load_takes_nothing_from_a_contact(perfect, way: str) -> None:
    """Gears lose a share of the torque they transmit, including the contact's; the contact torque stays exact."""
    model = replace(perfect, rotor=np.zeros(7))  # momentum methods count rotor torque as load
    share, force = np.linspace(0.02, 0.2, 7), np.array([20.0, -15.0, 30.0, 0.0, 0.0, 0.0])
    t = np.arange(0.0, 2.0, 0.004)
    q, qd, _ = identify.dither(np.linspace(0.2, -0.4, 7), 2.0).sample(t)
    qdd = np.diff(qd, axis=0, prepend=qd[:1]) / 0.004
    pushed = np.einsum("kij,i->kj", model.chain.jacobian(q), force)
    load = model.chain.rnea(q, qd, qdd, model.gravity, model.link_parameters) - pushed
    tau = model.torque(q, qd, qdd) - pushed
    rubbing = share * np.abs(load) * presliding(q, model.friction.delta, model.friction.resolution)
    rubs = replace(model, friction=replace(model.friction, load=share))

    def contact_torque(known: TorqueModel, tau: np.ndarray) -> np.ndarray:
        kernel = known.estimator_kernel if way == "map" else known.momentum_kernel
        own = {} if way == "map" else {"rate": np.ones(6), "filters": False}
        return kernel(np.square(PRIOR), **own).run(q, qd, tau, np.full(len(t), 0.004))[3]

    plain = contact_torque(model, tau)
    np.testing.assert_allclose(contact_torque(rubs, tau + rubbing), plain, rtol=0, atol=1e-9)
    assert np.abs(contact_torque(model, tau + rubbing) - plain).max() > 0.5


@pytest.mark.parametrize("way", ["map", "bounded", "observer", "kf"])
def test_doubt_grows_with_the_torque_of_a_contact(perfect, truth, log, way: str) -> None:
    """A common gain error scales the wrench; gain differences and load friction act on each joint."""
    alike, apart = np.full((7, 7), 0.1**2), 0.1**2 * np.eye(7)
    np.testing.assert_allclose(replace(perfect, gain_cov=alike).contact_doubt ** 2, 0.0, atol=1e-15)
    np.testing.assert_allclose(replace(perfect, gain_cov=apart).contact_doubt, 0.1 * np.sqrt(6 / 7))
    model = replace(perfect, load_sd=np.linspace(0.05, 0.2, 7))
    sure, unsure = (Estimator(one, truth.robot, **WAYS[way]).run(log) for one in (perfect, model))
    more = np.einsum("kii->ki", unsure["wrench_hat_cov"] - sure["wrench_hat_cov"])[20:]
    assert np.all(more >= -1e-9)
    assert more[:, :3].max() > 0.5**2


@pytest.mark.parametrize("way", ["map", "bounded", "observer"])
def test_the_band_widens_away_from_the_identified_motion(truth, model, excited, way: str) -> None:
    """At twice the speed, the parameters leave more uncertainty in the torque of every joint."""
    fast = Table(0.5 * excited.t, {"q": excited["q"], "qd": 2.0 * excited["qd"], "tau": excited["tau"]})
    exact = replace(model, parameters=None)

    def more(table: Table) -> np.ndarray:
        found, plain = (Estimator(one, truth.robot, **WAYS[way]).run(table) for one in (model, exact))
        return np.mean(found["tau_variance"] - plain["tau_variance"], axis=0)

    assert np.all(more(fast) > 1.5 * more(excited))


@pytest.mark.parametrize("method", ["map", "observer", "kf"])
def test_of_an_arm_at_rest_a_tare_takes_friction_away_until_it_moves(truth, model, method: str) -> None:
    rng, t = np.random.default_rng(2), np.arange(1500) * 0.004
    q = np.tile(truth.robot.q_home, (len(t), 1))
    q[1250:] += 0.05  # the arm moves away
    force = np.where((t > 2.0) & (t < 4.0), 6.0, 0.0)[:, None] * np.eye(6)[2]
    friction = 0.8 * model.friction.static * np.where(t < 5.0, 1.0, -1.0)[:, None]
    tau = model.torque(q, np.zeros_like(q)) + friction - np.einsum("kij,ki->kj", truth.robot.chain.jacobian(q), force)
    table = Table(t, {"q": q, "qd": np.zeros_like(q), "tau": tau + 0.01 * rng.standard_normal(q.shape)})
    estimator = Estimator(model, truth.robot, method)
    plain, tared = estimator.run(table), estimator.run(table, tare=1.0)
    rest, away = t < 4.9, t >= 5.0
    assert np.all(tared["wrench_flags"][rest] & TARED)
    assert not np.any(tared["wrench_flags"][away] & TARED)
    assert np.array_equal(tared["wrench_hat"][away], plain["wrench_hat"][away])
    z, sigma = tared["wrench_hat"][:, 2], np.sqrt(tared["wrench_hat_cov"][:, 2, 2])
    held = (t > 2.5) & (t < 3.9)
    assert np.all(np.abs(z[held] - 6.0) < 2.0 * sigma[held])
    assert sigma[held].mean() < 0.7 * np.sqrt(plain["wrench_hat_cov"][held, 2, 2]).mean()
    with pytest.raises(NotExcited, match=r"at rest for at least 0\.5 s"):
        estimator.run(table, tare=0.1)
    late = estimator.run(table, tare=slice(1300, 1500))
    assert not np.any(late["wrench_flags"][t < 5.0] & TARED)
    assert np.all(late["wrench_flags"][away] & TARED)
    with pytest.raises(ShapeError, match="tare duration"):
        estimator.run(table, tare="one")  # type: ignore[arg-type]
    with pytest.raises(NotExcited, match="move"):
        estimator.run(table, tare=slice(1000, 1400))
