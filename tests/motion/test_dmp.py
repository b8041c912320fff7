"""Movement primitives: their equations, what is free at run time, and what they refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.motion import Dmp
from armlab.motion.dmp.equation import SCALINGS, placed

Primitive = Callable[..., Dmp]
SCHEDULES = ("canonical", "time", "position")


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_rollout_tends_to_the_solution_with_fourth_order(primitive: Primitive, schedule: str) -> None:
    dmp = primitive(schedule, v0=np.zeros(3))
    slow = (
        -20 * (dmp.g - dmp.y0) * np.random.default_rng(0).uniform(size=(20, 3))
    )  # no turn, where the phase would be clipped
    dmp = replace(dmp, weights=slow) if schedule == "position" else dmp
    fine = np.linspace(0, 2, 321)
    wanted = dmp.solve(fine, rtol=1e-12, atol=1e-13).y
    errors = [abs(dmp.rollout(fine[::k]).y - wanted[::k]).max() for k in (4, 2, 1)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders.min() > 3.6
    assert errors[-1] < 1e-5


def test_what_is_returned_obeys_the_equation(primitive: Primitive) -> None:
    dmp = primitive()
    run = dmp.rollout(np.linspace(0, 2, 2001), g=dmp.g + 1, duration=3.0)
    tau = 3.0 * dmp.tau_d / dmp.duration
    spring = dmp.alpha_z * (dmp.beta_z * (dmp.g + 1 - run.y) - tau * run.yd)
    np.testing.assert_allclose(tau**2 * run.ydd, spring + run.forcing, atol=1e-9)
    np.testing.assert_allclose(np.gradient(run.y, run.t, axis=0)[5:-5], run.yd[5:-5], atol=5e-3)
    np.testing.assert_allclose(run.x, dmp.phase(run.t, tau_d=tau), rtol=1e-12)
    still = dmp.rollout(run.t)
    np.testing.assert_allclose(dmp.acceleration(still.y, still.yd, still.x), still.ydd, rtol=1e-9)
    np.testing.assert_allclose(dmp.forcing(still.x), dmp.kernels(still.x) @ dmp.weights * still.x[:, None], atol=1e-12)


def test_linearised_motion_is_the_slope_of_the_motion(primitive: Primitive) -> None:
    dmp = primitive()
    x, y, yd = 0.4, dmp.y0 + 0.1, dmp.v0
    A, B = dmp.linearise(x)
    assert (A.shape, B.shape) == ((7, 7), (7, 3))
    change, h = np.random.default_rng(3).normal(size=7), 1e-5
    ahead, back = (dmp.acceleration(y + s * change[:3], yd + s * change[3:6], x + s * change[6]) for s in (h, -h))
    np.testing.assert_allclose((A @ change)[3:6], (ahead - back) / (2 * h), rtol=1e-5)
    with pytest.raises(ConfigError, match="position"):
        primitive("position").linearise(0.5)


@given(st.floats(-5, 5).filter(lambda s: abs(s) > 1e-3), st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_space_scales_with_the_goal(primitive: Primitive, s: float, c: list[float]) -> None:
    dmp, t = primitive(), np.linspace(0, 2.5, 60)
    y0 = dmp.y0 + c
    path = dmp.rollout(t, y0=y0, g=y0 + s * (dmp.g - dmp.y0)).y
    wanted = y0 + s * (dmp.rollout(t).y - dmp.y0)
    np.testing.assert_allclose(path, wanted, rtol=0, atol=1e-12 * (np.abs(wanted).max() + 1))


@given(st.floats(0.05, 50.0), st.sampled_from(SCHEDULES))
def test_time_stretches_with_tau(primitive: Primitive, k: float, schedule: str) -> None:
    dmp, t = primitive(schedule), np.linspace(0, 2.5, 60)
    slow, usual = dmp.rollout(k * t, tau_d=k * dmp.tau_d), dmp.rollout(t)
    np.testing.assert_allclose(slow.y, usual.y, atol=1e-10)
    np.testing.assert_allclose(k * slow.yd, usual.yd, atol=1e-9)
    np.testing.assert_allclose(dmp.rollout(k * t, duration=k * dmp.duration).y, slow.y, atol=1e-10)


@given(st.sampled_from(SCALINGS), st.sampled_from(SCHEDULES), st.floats(-10, 10))
def test_every_mode_moves_with_start_and_goal(primitive: Primitive, scaling: str, schedule: str, c: float) -> None:
    if scaling == "rotate" and schedule == "position":
        return
    dmp, t = primitive(schedule, scaling), np.linspace(0, 2.5, 60)
    moved = dmp.rollout(t, y0=dmp.y0 + c, g=dmp.g + c).y
    np.testing.assert_allclose(moved, dmp.rollout(t).y + c, atol=1e-10)


@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.floats(0.1, 4.0))
def test_paths_turn_with_the_displacement(primitive: Primitive, turn: list[float], length: float) -> None:
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
    with pytest.raises(ShapeError, match="apart"):
        dmp.rollout(t, g=dmp.y0)


def test_durations_are_those_of_either_convention(primitive: Primitive) -> None:
    dmp, t = primitive(convention="ijspeert", tau_d=2.0), np.linspace(0, 2, 40)
    np.testing.assert_allclose(dmp.rollout(3 * t, duration=6.0).y, dmp.rollout(t).y, rtol=0, atol=1e-10)


def test_amplitude_multiplies_the_forcing(primitive: Primitive) -> None:
    dmp, t = primitive(scaling="amplitude", v0=np.zeros(3)), np.linspace(0, 2, 50)
    rest, once, twice = (dmp.rollout(t, amplitude=np.full(3, a)).y for a in (0.0, 1.0, 2.0))
    np.testing.assert_allclose(twice - rest, 2 * (once - rest), atol=1e-10)
    np.testing.assert_array_equal(once, dmp.rollout(t).y)
    with pytest.raises(ConfigError, match="amplitude"):
        primitive().rollout(t, amplitude=np.ones(3))


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_batch_is_many_rollouts(primitive: Primitive, schedule: str) -> None:
    dmp, t = primitive(schedule), np.linspace(1, 4, 40)
    rng = np.random.default_rng(1)
    y0, g = rng.normal(size=(2, 5, 3))
    weights = rng.normal(size=(5, 20, 3))
    many, own = dmp.rollout_batch(t, y0=y0, g=g, duration=3.0), dmp.rollout_batch(t, weights=weights)
    assert many.y.shape == own.y.shape == (40, 5, 3)
    for k in range(5):
        one = dmp.rollout(t, y0=y0[k], g=g[k], duration=3.0)
        np.testing.assert_allclose(many.y[:, k], one.y, atol=1e-12)
        np.testing.assert_allclose(many.ydd[:, k], one.ydd, atol=1e-9)
        np.testing.assert_allclose(own.y[:, k], replace(dmp, weights=weights[k]).rollout(t).y, atol=1e-12)
    assert dmp.rollout_batch(t, g=g[:1]).y.shape == (40, 1, 3)


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("K", [31, 32, 33, 65])  # runs go side by side in blocks of 32
def test_every_run_of_a_batch_has_its_own_start_goal_and_weights(primitive: Primitive, schedule: str, K: int) -> None:
    dmp, t = primitive(schedule), np.array([0.0, 0.02, 0.05, 0.06])
    rng = np.random.default_rng(K)
    y0, g, weights = rng.normal(size=(K, 3)), rng.normal(size=(K, 3)), rng.normal(size=(K, 20, 3)) * 20
    for own in (weights, None):
        many = dmp.rollout_batch(t, y0=y0, g=g, weights=own)
        for k in (0, 29, 30, *range(31, K)):
            each = dmp if own is None else replace(dmp, weights=own[k])
            one = each.rollout(t, y0=y0[k], g=g[k])
            for name in ("y", "yd", "ydd", "forcing"):
                wanted = getattr(one, name)
                np.testing.assert_allclose(
                    getattr(many, name)[:, k], wanted, rtol=0, atol=1e-12 * np.abs(wanted).max(), err_msg=f"{name} {k}"
                )


def test_progress_is_from_1_to_0_and_0_where_nothing_is_to_be_gone(primitive: Primitive) -> None:
    """Coordinate 0 backs off from its start, 1 shoots past its goal, 2 has none: its spring is alone."""
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


def test_the_clock_and_the_number_of_samples_are_the_callers(primitive: Primitive) -> None:
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
def test_nothing_ever_becomes_nan(primitive: Primitive, schedule: str, n_basis: int) -> None:
    centres, widths = placed(schedule, "time", n_basis, 3.0, 0.8)
    dmp = primitive(schedule, weights=np.ones((n_basis, 3)), centres=centres, widths=widths)
    run = dmp.rollout(np.concatenate([np.linspace(0, 3, 50), [20, 200.0]]))
    assert all(np.isfinite(getattr(run, name)).all() for name in ("y", "yd", "ydd", "x", "forcing"))
    np.testing.assert_allclose(run.y[-1], dmp.g, atol=1e-9)
    assert np.isfinite(dmp.kernels(np.array([0.0, -5.0, 1e6, 1e-300]))).all()


def test_equal_is_equal_to_the_last_bit(primitive: Primitive) -> None:
    dmp = primitive()
    assert dmp == replace(dmp)
    assert dmp != replace(dmp, tau_d=dmp.tau_d * (1 + 1e-15))
    assert dmp != 1


def test_nothing_given_is_changed(primitive: Primitive) -> None:
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


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda d, t: d.rollout(t, tau_d=0.0), ShapeError, "above zero"),
        (lambda d, t: d.rollout(t, duration=-1.0), ShapeError, "above zero"),
        (lambda d, t: d.rollout(t, duration=1.0, tau_d=1.0), ConfigError, "got both"),
        (lambda d, t: d.rollout(t, g=np.zeros(2)), ShapeError, "3 coordinates"),
        (lambda d, t: d.rollout(t, y0=[0, np.nan, 0]), ShapeError, "finite y0"),
        (lambda d, t: d.rollout(t, v0="fast"), ShapeError, "real numbers"),
        (lambda d, t: d.rollout(t, g=np.zeros((2, 3))), ShapeError, "rollout_batch"),
        (lambda d, t: d.rollout(t[::-1]), ShapeError, "increase"),
        (lambda d, t: d.rollout(np.append(t, t[-1])), ShapeError, "increase"),
        (lambda d, t: d.rollout(t * np.nan), ShapeError, "finite t"),
        (lambda d, t: d.rollout(0.0), ShapeError, "dt above zero"),
        (lambda d, t: d.rollout(4.0), ShapeError, r"dt \[s\] from 2e-07 to 2,"),  # milliseconds
        (lambda d, t: d.rollout(1e-9), ShapeError, "got 1e-09"),
        (lambda d, t: d.solve(t, rtol=0.0), ConfigError, "tolerances"),
        (lambda d, t: d.solve(t[::-1]), ShapeError, "increasing"),
        (lambda d, t: d.rollout_batch(t, weights=np.zeros((2, 5, 3))), ShapeError, "K, 20, 3"),
        (lambda d, t: d.rollout_batch(t, y0=np.zeros((2, 3)), g=np.zeros((4, 3))), ShapeError, "one number K"),
    ],
)
def test_bad_runs_are_refused(primitive: Primitive, call: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call(primitive(), np.linspace(0, 2, 20))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"weights": np.zeros(3)}, ShapeError, "n_basis, n"),
        ({"weights": np.full((20, 3), np.nan)}, ShapeError, "finite weights"),
        ({"weights": np.zeros((19, 3))}, ShapeError, "centres"),
        ({"g": np.zeros(2)}, ShapeError, "g of shape"),
        ({"widths": np.zeros(20)}, ShapeError, "widths above zero"),
        ({"tau_d": 0.0}, ShapeError, "tau_d above zero"),
        ({"schedule": "clock"}, UnknownName, "canonical"),
        ({"scaling": "size"}, UnknownName, "amplitude"),
        ({"convention": "mine"}, UnknownName, "ijspeert"),
        ({"scaling": "rotate", "schedule": "position"}, ConfigError, "rotate"),
        ({"demo_weights": np.zeros((3, 2, 2))}, ShapeError, "demo_weights"),
    ],
)
def test_bad_fields_are_refused(
    primitive: Primitive, change: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        primitive(**change)


def test_small_displacements_are_not_scaled(primitive: Primitive) -> None:
    dmp = primitive(g=primitive().y0 + np.array([0.04, 0.06, 0.0]))
    assert dmp.unscaled == (0, 2)
    assert primitive(scaling="none").unscaled == ()
    still = primitive(
        y0=np.array([0.3, 0.0, 0.0]), g=np.array([0.3 + 1e-16, 3e-17, -0.4]), extent=np.array([0, 3e-17, 0.4])
    )
    assert still.unscaled == (0, 1), "what stood still but for rounding has no size to scale by"
    assert abs(dmp.rollout(np.linspace(0, 2, 20), g=dmp.y0 + 1).forcing[0, 0]) < 1e3
