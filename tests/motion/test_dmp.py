"""Movement primitives: their equation, runs, sample-by-sample runs, moving goals, and via-points."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ConfigError, ShapeError
from armlab.motion import AvoidingDmp, Capsule, Dmp, Rollout, Stepper, TwoDofDmp, fit_dmp, with_via_points
from armlab.motion.primitive.equation import SCALINGS, placed
from armlab.motion.primitive.run import RunOptions

from .conftest import primitive

SCHEDULES = ("canonical", "time", "position")


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_rollout_tends_to_the_solution_with_fourth_order(schedule: str) -> None:
    dmp = primitive(schedule, v0=np.zeros(3))
    slow = (
        -20 * (dmp.g - dmp.y0) * np.random.default_rng(0).uniform(size=(20, 3))
    )  # no reversal, where the phase would be clipped
    dmp = replace(dmp, weights=slow) if schedule == "position" else dmp
    fine = np.linspace(0, 2, 321)
    wanted = dmp.solve(fine, rtol=1e-12, atol=1e-13).y
    errors = [abs(dmp.rollout(fine[::k]).y - wanted[::k]).max() for k in (4, 2, 1)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders.min() > 3.6
    assert errors[-1] < 1e-5


def test_what_is_returned_obeys_the_equation() -> None:
    dmp = primitive()
    run: Rollout = dmp.rollout(np.linspace(0, 2, 2001), g=dmp.g + 1, duration=3.0)
    tau = 3.0 * dmp.tau_d / dmp.duration
    spring = dmp.alpha_z * (dmp.beta_z * (dmp.g + 1 - run.y) - tau * run.yd)
    np.testing.assert_allclose(tau**2 * run.ydd, spring + run.forcing, atol=1e-9)
    np.testing.assert_allclose(np.gradient(run.y, run.t, axis=0)[5:-5], run.yd[5:-5], atol=5e-3)
    np.testing.assert_allclose(run.x, dmp.phase(run.t, tau_d=tau), rtol=1e-12)
    still = dmp.rollout(run.t)
    np.testing.assert_allclose(dmp.acceleration(still.y, still.yd, still.x), still.ydd, rtol=1e-9)
    np.testing.assert_allclose(dmp.forcing(still.x), dmp.kernels(still.x) @ dmp.weights * still.x[:, None], atol=1e-12)


def test_linearised_motion_is_the_slope_of_the_motion() -> None:
    dmp = primitive()
    x, y, yd = 0.4, dmp.y0 + 0.1, dmp.v0
    A, B = dmp.linearise(x)
    assert (A.shape, B.shape) == ((7, 7), (7, 3))
    change, h = np.random.default_rng(3).normal(size=7), 1e-5
    ahead, back = (dmp.acceleration(y + s * change[:3], yd + s * change[3:6], x + s * change[6]) for s in (h, -h))
    np.testing.assert_allclose((A @ change)[3:6], (ahead - back) / (2 * h), rtol=1e-5)
    with pytest.raises(ConfigError, match="position"):
        primitive("position").linearise(0.5)


@settings(max_examples=20)
@given(st.floats(-5, 5).filter(lambda s: abs(s) > 1e-3), st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_space_scales_with_the_goal(s: float, c: list[float]) -> None:
    dmp, t = primitive(), np.linspace(0, 2.5, 60)
    y0 = dmp.y0 + c
    path = dmp.rollout(t, y0=y0, g=y0 + s * (dmp.g - dmp.y0)).y
    wanted = y0 + s * (dmp.rollout(t).y - dmp.y0)
    np.testing.assert_allclose(path, wanted, rtol=0, atol=1e-12 * (np.abs(wanted).max() + 1))


@given(st.floats(0.05, 50.0), st.sampled_from(SCHEDULES))
@settings(max_examples=20)
def test_time_stretches_with_tau(k: float, schedule: str) -> None:
    dmp, t = primitive(schedule), np.linspace(0, 2.5, 60)
    slow, usual = dmp.rollout(k * t, tau_d=k * dmp.tau_d), dmp.rollout(t)
    np.testing.assert_allclose(slow.y, usual.y, atol=1e-10)
    np.testing.assert_allclose(k * slow.yd, usual.yd, atol=1e-9)
    np.testing.assert_allclose(dmp.rollout(k * t, duration=k * dmp.duration).y, slow.y, atol=1e-10)


@settings(max_examples=20)
@given(st.sampled_from(SCALINGS), st.sampled_from(SCHEDULES), st.floats(-10, 10))
def test_every_mode_moves_with_start_and_goal(scaling: str, schedule: str, c: float) -> None:
    if scaling == "rotate" and schedule == "position":
        return
    dmp, t = primitive(schedule, scaling), np.linspace(0, 2.5, 60)
    moved = dmp.rollout(t, y0=dmp.y0 + c, g=dmp.g + c).y
    np.testing.assert_allclose(moved, dmp.rollout(t).y + c, atol=1e-10)


@settings(max_examples=20)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.floats(0.1, 4.0))
def test_paths_turn_with_the_displacement(turn: list[float], length: float) -> None:
    from armlab.lie import so3

    dmp, t = primitive(scaling="rotate"), np.linspace(0, 2.5, 60)
    way = dmp.g - dmp.y0
    across = np.array(turn) - way * (way @ turn) / (way @ way)  # the smallest rotation turns about an axis across
    R = so3.exp(across if np.linalg.norm(across) < 3 else across / np.linalg.norm(across))
    path = dmp.rollout(t, g=dmp.y0 + length * R @ way).y
    wanted = dmp.y0 + length * (dmp.rollout(t).y - dmp.y0) @ R.T
    np.testing.assert_allclose(path, wanted, atol=1e-12 * (1 + abs(wanted).max()) * 10)
    with pytest.raises(ShapeError, match="half a turn"):
        dmp.rollout(t, g=dmp.y0 - way)
    with pytest.raises(ShapeError, match="the same point"):
        dmp.rollout(t, g=dmp.y0)


def test_amplitude_multiplies_the_forcing() -> None:
    dmp, t = primitive(scaling="amplitude", v0=np.zeros(3)), np.linspace(0, 2, 50)
    rest, once, twice = (dmp.rollout(t, amplitude=np.full(3, a)).y for a in (0.0, 1.0, 2.0))
    np.testing.assert_allclose(twice - rest, 2 * (once - rest), atol=1e-10)
    np.testing.assert_array_equal(once, dmp.rollout(t).y)
    with pytest.raises(ConfigError, match="amplitude"):
        primitive().rollout(t, amplitude=np.ones(3))


def test_progress_is_from_1_to_0_and_0_where_nothing_is_to_be_gone() -> None:
    """Coordinate 0 backs away from its start, 1 overshoots its goal, 2 has no displacement: only its spring acts."""
    goal, speed = np.array([0.1, 0.01, 0.0]), np.array([-5.0, 5.0, 2.0])
    dmp = primitive("position", "none", y0=np.zeros(3), g=goal, v0=speed)
    run = dmp.rollout(np.linspace(0.0, 0.05, 101))
    assert (run.y[1:, 0] < 0.0).all()
    assert (run.y[5:, 1] > 0.01).all()
    np.testing.assert_array_equal(run.x[5:], np.tile([1.0, 0.0, 0.0], (96, 1)))
    np.testing.assert_allclose(run.forcing[5:, 0], dmp.forcing(np.ones(3))[0], rtol=1e-14)
    np.testing.assert_array_equal(run.forcing[5:, 1:], 0.0)
    alone = 2.0 * run.t * np.exp(-0.5 * dmp.alpha_z / dmp.tau_d * run.t)  # critically damped
    np.testing.assert_allclose(run.y[:, 2], alone, rtol=0, atol=1e-8)


def test_the_clock_and_the_number_of_samples_are_the_callers() -> None:
    dmp = primitive()
    t = np.linspace(0, 2, 1000)
    assert len(dmp.rollout(t).y) == 1000
    assert len(dmp.rollout(t[:1]).y) == len(dmp.solve(t[:1]).y) == 1
    np.testing.assert_allclose(dmp.rollout(t + 5).y, dmp.rollout(t).y, atol=1e-10)
    assert dmp.rollout(0.004).t[-1] == pytest.approx(2.0)
    assert len(dmp.times(0.004)) == 501
    assert dmp.rollout(0.004, tau_d=2 * dmp.tau_d).t[-1] == pytest.approx(4.0)
    np.testing.assert_array_equal(dmp.rollout(t).y[0], dmp.y0)
    np.testing.assert_allclose(dmp.rollout(t).yd[0], dmp.v0, rtol=1e-15)


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("n_basis", [3, 378, 1000])
def test_nothing_ever_becomes_nan(schedule: str, n_basis: int) -> None:
    centres, widths = placed(schedule, "time", n_basis, 3.0, 0.8)
    dmp = primitive(schedule, weights=np.ones((n_basis, 3)), centres=centres, widths=widths)
    run = dmp.rollout(np.concatenate([np.linspace(0, 3, 50), [20, 200.0]]))
    assert all(np.isfinite(getattr(run, name)).all() for name in ("y", "yd", "ydd", "x", "forcing"))
    np.testing.assert_allclose(run.y[-1], dmp.g, atol=1e-9)
    times = [] if schedule == "position" else dmp.phase(np.linspace(0, 100, 99))
    psi = dmp.kernels(np.array([0.0, -5.0, 1e6, 1e-300, *times]))
    np.testing.assert_allclose(psi.sum(axis=1), 1.0, rtol=1e-12)


def test_equal_is_equal_to_the_last_bit() -> None:
    dmp = primitive()
    assert dmp == replace(dmp)
    assert dmp != replace(dmp, tau_d=dmp.tau_d * (1 + 1e-15))
    assert dmp != 1


def test_nothing_given_is_changed() -> None:
    dmp, before = primitive(), primitive()
    t = np.linspace(0, 1, 20)
    g = dmp.g + 1
    kept = t.copy(), g.copy()
    dmp.rollout(t, g=g)
    dmp.solve(t, g=g)
    dmp.rollout_batch(t, g=g)
    dmp.stepper(g=g).step(0.01)
    assert dmp == before
    np.testing.assert_array_equal(np.concatenate(kept), np.concatenate([t, g]))
    with pytest.raises(ValueError, match="read-only"):
        dmp.weights[0] = 0
    with pytest.raises(ValueError, match="read-only"):
        dmp.rollout(t).y[0] = 0


def test_small_displacements_are_not_scaled() -> None:
    dmp = primitive(g=primitive().y0 + np.array([0.04, 0.06, 0.0]))
    assert dmp.unscaled == (0, 2)
    assert primitive(scaling="none").unscaled == ()
    still = primitive(
        y0=np.array([0.3, 0.0, 0.0]), g=np.array([0.3 + 1e-16, 3e-17, -0.4]), extent=np.array([0, 3e-17, 0.4])
    )
    assert still.unscaled == (0, 1), "what stood still but for rounding has no size to scale by"
    assert abs(dmp.rollout(np.linspace(0, 2, 20), g=dmp.y0 + 1).forcing[0, 0]) < 1e3


def test_options_mean_the_same_everywhere() -> None:
    dmp = primitive()
    given: RunOptions = {"duration": 3.0, "tau_d": None, "y0": dmp.y0 + 0.1, "g": dmp.g + 0.5, "v0": None}
    run, batch = dmp.rollout(0.01, **given), dmp.rollout_batch(0.01, **given)
    stepper = dmp.stepper(**given)
    steps = [stepper.step(0.01)[0] for _ in run.t[1:]]
    np.testing.assert_allclose(steps, run.y[1:], atol=1e-12)
    np.testing.assert_allclose(batch.y[:, 0], run.y, atol=1e-12)
    np.testing.assert_allclose(dmp.solve(0.1, **given).y, run.y[::10], atol=1e-5)
    assert run.t[-1] == pytest.approx(3.0)
    for call in (dmp.rollout, dmp.rollout_batch, dmp.solve):
        for name in ("speed", "runs", "dmp"):
            with pytest.raises(TypeError, match=name):
                call(0.01, **{name: 2})  # type: ignore[call-arg]
    for call in (dmp.rollout, dmp.solve):
        with pytest.raises(ShapeError, match=r"y0 of shape .* one run"):
            call(0.01, y0=np.zeros((2, 3)))


@settings(max_examples=15)
@given(st.sampled_from(["canonical", "time", "position"]), st.integers(0, 99))
def test_steps_are_the_rollout(schedule: str, seed: int) -> None:
    dmp = primitive(schedule)
    t = np.cumsum(np.random.default_rng(seed).uniform(1e-3, 0.1, 40))
    run = dmp.rollout(t, g=dmp.g + 1, duration=3.0)
    stepper = dmp.stepper(g=dmp.g + 1, duration=3.0)
    assert isinstance(stepper, Stepper)
    for _ in range(2):
        rows = [stepper.state, *(stepper.step(dt) for dt in np.diff(t))]
        for got, wanted in zip(np.array(rows).swapaxes(0, 1), (run.y, run.yd, run.ydd)):
            np.testing.assert_allclose(got, wanted, atol=1e-12 * (1 + abs(wanted).max()))
        np.testing.assert_allclose(stepper.x, run.x[-1], atol=1e-12)
        assert [stepper.t, stepper.duration] == pytest.approx([t[-1] - t[0], 3.0])
        stepper.reset()


def test_the_velocity_stays_when_the_pace_changes() -> None:
    stepper = primitive().stepper()
    for _ in range(100):
        _, before, _ = stepper.step(0.004)
    stepper.change_duration(5.0)
    np.testing.assert_allclose(stepper.state[1], before, rtol=1e-14)
    for _ in range(5000):
        y, _, _ = stepper.step(0.004)
    np.testing.assert_allclose(y, stepper.goal, atol=1e-3)


def reach(dmp: Dmp, when: float, goal: float, **options: Any) -> tuple[np.ndarray, float]:
    """Path after a goal change in a motion from 0 to 1, and the velocity at the change."""
    stepper = dmp.stepper(**options)
    path = [stepper.step(0.002)[0][0] for _ in range(round(when * 500))]
    velocity = float(stepper.state[1][0])
    stepper.change_goal([goal])
    return np.array([path[-1], *(stepper.step(0.002)[0][0] for _ in range(1250))]), velocity


MOVING = {  # largest overshoot in the conventions lund and ijspeert
    "shift": ({"goal_forcing": "shift"}, 0.0029, 0.031),
    "scale": ({}, 0.0042, 0.033),
    "filter": ({"goal_rate": 12.5}, 0.0235, 0.122),
}
CHANGES = list(product((0.2, 0.6, 0.8), (0.3, 0.8, 1.2, 1.5)))  # when, and to which goal


@pytest.mark.parametrize("kind", MOVING)
@pytest.mark.parametrize("convention", ["lund", "ijspeert"])
def test_goals_that_move_are_hardly_overshot(convention: str, kind: str) -> None:
    t = np.linspace(0, 1, 1001)
    y = 10 * t**3 - 15 * t**4 + 6 * t**5
    dmp = fit_dmp(t, y, convention=convention).value
    limit = 1.05 * float(dmp.peak_acceleration[0])
    options, *bars = MOVING[kind]
    worst = 0.0
    for when, goal in CHANGES:
        path, v = reach(dmp, when, goal, **options)
        worst = max(worst, path.max() - max(path[0], goal))
        assert abs(path[-1] - goal) < 1e-6
        braked, _ = reach(dmp, when, goal, brake=True, **options)
        if v**2 / (2 * limit) <= goal - path[0]:
            assert braked.max() - goal <= 1e-4
        assert abs(braked[-1] - goal) < 1e-6
    assert worst <= bars[convention == "ijspeert"]


def test_a_goal_that_stays_is_not_braked_for() -> None:
    t = np.linspace(0, 1, 1001)
    dmp = fit_dmp(t, 10 * t**3 - 15 * t**4 + 6 * t**5).value
    plain, braked = dmp.stepper(), dmp.stepper(brake=True, goal_rate=12.5)
    paths = np.array([[plain.step(0.004)[0], braked.step(0.004)[0]] for _ in range(500)])
    np.testing.assert_allclose(paths[:, 0], paths[:, 1], rtol=0, atol=1e-12)
    t = np.linspace(0, 1, 101)
    assert not fit_dmp(t, np.sin(5 * t)).value.monotone.any()


def test_brakes_are_for_coordinates_that_never_turned_and_forgotten_by_a_reset() -> None:
    """After a change of goal ``v^2 <= 2 a |goal - y|``, a 1.05 times the largest acceleration of the demonstration."""
    dmp = primitive(monotone=np.array([True, False, True]), peak_acceleration=np.full(3, 0.5), v0=np.zeros(3))
    free, braked = dmp.stepper(), dmp.stepper(brake=True)
    goal = dmp.g + 2.0
    for stepper in (free, braked):
        stepper.change_goal(goal)
    left, fast, apart = [], [], []
    for _ in range(400):
        (y, v, _), (y_free, _, _) = braked.step(0.004), free.step(0.004)
        left.append(np.abs(goal - y))
        fast.append(v)
        apart.append(np.abs(y[1] - y_free[1]))
    ahead = (np.array(fast) > 0)[:, [0, 2]]
    share = (np.array(fast) ** 2 / (2 * 1.05 * 0.5 * np.array(left)))[:, [0, 2]][ahead]
    assert 1.0 - 1e-9 <= share.max() <= 1.0 + 1e-9
    assert max(apart) == 0.0
    braked.reset()
    np.testing.assert_array_equal(braked.goal, dmp.g)


U = np.linspace(0.0, 1.0, 501)
S = U**3 * (10 - 15 * U + 6 * U**2)
TIMES, POINTS = [0.3, 0.64], np.array([[0.25, -0.1], [0.5, 0.1]])


@pytest.fixture(scope="module")
def arc() -> Dmp:
    return fit_dmp(U, np.stack([S, 0.3 * np.sin(np.pi * S)], axis=1), n_basis=20).value


def at(arc: Dmp, t: list[float]) -> tuple[np.ndarray, np.ndarray]:
    fine = np.unique(np.r_[np.linspace(0, arc.duration, 2001), t])
    run = arc.rollout(fine)
    rows = np.searchsorted(fine, t)
    return run.y[rows], run.yd[rows]


def test_points_are_passed_and_ends_stay(arc: Dmp) -> None:
    bent = with_via_points(arc, TIMES, POINTS)
    np.testing.assert_allclose(at(bent, TIMES)[0], POINTS, rtol=0, atol=1e-9)
    long = np.linspace(0, 20, 4001)
    np.testing.assert_allclose(bent.rollout(long).y[[0, -1]], arc.rollout(long).y[[0, -1]], rtol=0, atol=1e-9)
    velocity = with_via_points(arc, TIMES, POINTS, [[0.0, 0.0], [1.0, 0.5]])
    for own, wanted in zip(at(velocity, TIMES), (POINTS, [[0.0, 0.0], [1.0, 0.5]])):
        np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-8)


def test_a_point_on_the_path_changes_nothing(arc: Dmp) -> None:
    same = with_via_points(arc, TIMES, at(arc, TIMES)[0])
    np.testing.assert_allclose(same.rollout(U).y, arc.rollout(U).y, rtol=0, atol=1e-9)


def test_no_other_change_that_passes_the_point_is_smaller(arc: Dmp) -> None:
    bent = with_via_points(arc, [0.5], [[0.6, 0.2]])
    grid = np.linspace(0.0, 1.0, 401)
    least = bent.rollout(grid).y - arc.rollout(grid).y
    Y = arc._primitive.response(grid, arc.tau_d, 1e-3)[0][:, :-3]
    for other in np.random.default_rng(0).normal(size=(20, 20, 2)):
        free = other - np.outer(np.linalg.pinv(Y[[200]]), Y[200] @ other)  # does not move the point
        assert ((least + 1e-3 * Y @ free) ** 2).sum() > (least**2).sum() * (1 - 1e-6)


def test_it_ends_with_a_velocity(arc: Dmp) -> None:
    moving = with_via_points(arc, 1.0, arc.g, [0.7, -0.4])
    y, yd = at(moving, [1.0])
    np.testing.assert_allclose(y[0], arc.g, rtol=0, atol=1e-9)
    np.testing.assert_allclose(yd[0], [0.7, -0.4], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        moving.rollout(np.linspace(0, 20, 4001)).y[-1], arc.g, atol=1e-9
    )  # and settles when it runs on


def test_a_fit_stands_for_its_primitive() -> None:
    t = np.linspace(0.0, 1.0, 201)
    fit = fit_dmp(t, np.stack([t, t**2, t**3], axis=1))
    assert TwoDofDmp(fit).dmp is fit.value
    assert AvoidingDmp(fit, [Capsule.sphere([3.0, 3.0, 3.0], 0.1)], 0.01, 0.1).dmp is fit.value
