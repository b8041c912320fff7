"""Two-degree-of-freedom control: shape of the path, order, freeze, disturbances and plants, sample by sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.motion.disturbances import FULL_SPEED, Displace, Hold, Plant, Push, TwoDofRun
from armlab.motion.primitive.run import RunParameters
from armlab.motion.two_dof import Reference, TwoDofDmp, TwoDofStepper, starting

from .conftest import plain, primitive, smooth

H = 0.004


@settings(max_examples=15)
@given(
    seed=st.integers(0, 50),
    n=st.integers(2, 4),
    t0=st.floats(0.1, 1.0),
    length=st.floats(0.1, 1.5),
    dof=st.integers(0, 1),
    blow=st.floats(-0.5, 0.5),
)
def test_the_path_keeps_its_shape(seed: int, n: int, t0: float, length: float, dof: int, blow: float) -> None:
    events = [Hold(t0, t0 + length, [dof]), Displace(0.5 * t0, np.linspace(0, blow, n))]
    run = TwoDofDmp(smooth(n, seed), kc=1e3).simulate(0.01, events)
    np.testing.assert_allclose(run.yc, run.yc[:, :1] * 0.5 ** np.arange(n), rtol=0, atol=1e-9)


@settings(max_examples=10)
@given(c=st.floats(-2, 2), s=st.sampled_from([-1.5, 0.3, 2.0]), k=st.floats(0.5, 3.0))
def test_undisturbed_it_is_the_primitive(c: float, s: float, k: float) -> None:
    dmp = smooth()
    run = TwoDofDmp(dmp).simulate(0.01, y0=dmp.y0 + c, g=dmp.y0 + c + s * (dmp.g - dmp.y0), duration=2 * k, dt=0.002)
    np.testing.assert_allclose(run.yc, run.free.y, rtol=0, atol=1e-6 * max(1, abs(s)))
    np.testing.assert_allclose(run.ya, run.yc, rtol=0, atol=1e-12 * (1 + abs(c)))
    np.testing.assert_allclose(run.tau_a, k * 2 / 3)


@pytest.mark.parametrize("schedule", ["canonical", "time", "position"])
def test_it_is_of_fourth_order(schedule: str) -> None:
    """With a hold and a push between grid points, on kernels that are wide compared with the steps."""
    centres = np.linspace(0, 1, 6)
    weights = 30 * np.random.default_rng(1).normal(size=(6, 2))
    dmp = plain(weights, centres, np.full(6, 0.2), 2.0, np.zeros(2), np.ones(2), schedule=schedule)
    events = [Hold(0.31, 0.62, [0]), Push(0.7, 0.83, 0.4), Displace(1.0, 0.1)]
    two_dof, t = TwoDofDmp(dmp, kc=100), np.array([0.0, 1.9])
    exact = two_dof.simulate(t, events, dt=0.02 / 64)
    errors = []
    for h in (0.02, 0.01, 0.005):
        run = two_dof.simulate(t, events, dt=h)
        errors.append(np.abs(np.r_[run.yc[-1] - exact.yc[-1], run.ya[-1] - exact.ya[-1]]).max())
    assert np.diff(-np.log2(errors)).min() >= 3.8, errors


def test_a_hold_creeps_and_a_freeze_does_not() -> None:
    """During a hold, an unfrozen path creeps away ever more slowly; a frozen path stops, and resumes on release."""
    dmp, t = smooth(force=0.0), np.array([0.0, 0.5, 1.0, 5.0, 30.0])
    creeping = TwoDofDmp(dmp).simulate(t, [Hold(0.5, 30)])
    still = TwoDofDmp(dmp, e_max=0.02).simulate(t, [Hold(0.5, 30)])
    away = np.abs(creeping.yc - creeping.ya).max(axis=1)
    assert (np.diff(away[1:]) > 0).all()
    assert not creeping.frozen.any()
    assert still.frozen[2:].all()
    np.testing.assert_array_equal(still.ycd[2:], 0)
    assert np.abs(still.yc - still.ya).max() < 0.02 + H * np.abs(creeping.ycd).max()
    after = TwoDofDmp(dmp, e_max=0.02).simulate(np.array([0.0, 5.0, 9.0]), [Hold(0.5, 5)])
    assert after.frozen.tolist() == [False, True, False]
    np.testing.assert_allclose(after.yc[-1], dmp.g, atol=2e-2)


def test_inside_the_dead_zone_nothing_slows() -> None:
    dmp = smooth()
    run = TwoDofDmp(dmp, e0=[0.02, 0.02]).simulate(0.01, [Displace(0.5, 0.015)])
    np.testing.assert_array_equal(run.tau_a, dmp.tau_d)
    slowed = TwoDofDmp(dmp, e_scale=1.0).simulate(0.01, [Displace(0.5, 0.015)])
    finer = TwoDofDmp(dmp, e_scale=0.1).simulate(0.01, [Displace(0.5, 0.015)])
    assert dmp.tau_d * 1.05 < slowed.tau_a.max() < finer.tau_a.max()


def test_acceleration_of_the_path_is_its_derivative_while_tau_changes() -> None:
    """Outside the dead zone of one coordinate and inside that of the other, with scales other than one."""
    two_dof = TwoDofDmp(smooth(), kc=1e3, e0=[0.01, 0.2], e_scale=[0.3, 2.0])
    run = two_dof.simulate(np.arange(0.0, 1.6, 5e-4), [Displace(0.5, [0.1, 0.1])], dt=5e-4)
    assert run.tau_a.max() > 5 * run.tau_a.min()
    active = np.abs(run.e) > two_dof.e0
    smoothly = (active[:-4] == active[4:]).all(axis=1)  # the slope jumps where the dead zone is left or entered
    rows = np.flatnonzero(smoothly & (run.t[:-4] > 0.5)) + 2
    assert active[rows, 0].sum() > 100
    by_differences = np.gradient(run.ycd, run.t, axis=0)
    np.testing.assert_allclose(run.ycdd[rows], by_differences[rows], rtol=0, atol=2e-3 * np.abs(run.ycdd).max())


def test_events_happen_between_the_samples() -> None:
    """A hold that begins and ends between samples stops the arm for exactly its time."""
    two_dof = TwoDofDmp(primitive(), kc=0.0)
    t = np.array([0.0, 0.401, 0.4017, 0.4995, 0.6, 1.0])
    run = two_dof.simulate(t, [Hold(0.4013, 0.5005, [1]), Push(0.4013, 0.5005, 0.2, [0])])
    np.testing.assert_allclose(run.ya[3, 0] - run.ya[2, 0], 0.2 * (0.4995 - 0.4017), atol=1e-12)
    assert run.ya[3, 1] == run.ya[2, 1]
    np.testing.assert_array_equal(run.yad[3, :2], [0.2, 0.0])
    assert run.ya[3, 2] != run.ya[2, 2]
    assert run.disturbed == ((0.4013, 0.5005), (0.4013, 0.5005))


def test_at_the_time_of_an_event_is_what_was_before_it() -> None:
    two_dof, t = TwoDofDmp(primitive()), np.array([0.0, 0.5, 0.5 + 1e-9])
    run = two_dof.simulate(t, [Displace(0.5, [0.1, 0.0, -0.2])])
    np.testing.assert_allclose(run.ya[2] - run.ya[1], [0.1, 0.0, -0.2], atol=1e-7)
    np.testing.assert_allclose(run.ya[1], run.yc[1], atol=1e-12)
    assert run.disturbed == ((0.5, 0.5),)


def test_a_clock_that_starts_later_changes_nothing() -> None:
    two_dof, t = TwoDofDmp(primitive()), 0.01 * np.arange(150)
    run = two_dof.simulate(t, [Hold(0.3, 0.7), Displace(1.0, 0.1)])
    later = two_dof.simulate(t + 5.0, [Hold(5.3, 5.7), Displace(6.0, 0.1)])
    np.testing.assert_allclose(later.ya, run.ya, atol=1e-9)


def test_the_perfect_plant_is_no_plant() -> None:
    def perfect(t: float, ya: np.ndarray, yad: np.ndarray, ydd_ref: np.ndarray) -> np.ndarray:
        return ydd_ref

    plant: Plant = perfect
    two_dof, t = TwoDofDmp(primitive()), 0.02 * np.arange(60)
    events: list[Any] = [Hold(0.3, 0.5, [0]), Displace(0.71, 0.1)]
    run, plain = two_dof.simulate(t, [*events, plant]), two_dof.simulate(t, events)
    for name in ("yc", "ya", "yad", "e", "x"):
        np.testing.assert_allclose(getattr(run, name), getattr(plain, name), rtol=0, atol=1e-11, err_msg=name)


def test_results_are_frozen_and_complete() -> None:
    run = TwoDofDmp(primitive()).simulate(0.01)
    assert isinstance(run, TwoDofRun)
    N = len(run.t)
    assert {a.shape for a in (run.yc, run.ycd, run.ycdd, run.ya, run.yad, run.ydd_ref, run.e)} == {(N, 3)}
    assert (run.x.shape, run.tau_a.shape, run.frozen.dtype) == ((N,), (N,), bool)
    with pytest.raises(ValueError, match="read-only"):
        run.ya[0, 0] = 1.0
    assert TwoDofDmp(primitive("position")).simulate(0.01).x.shape == (N, 3)


def test_stepper_is_the_simulation() -> None:
    """With the simulated arm measured at every step, the path is the same to sampling accuracy."""
    dmp = smooth()
    two_dof = TwoDofDmp(dmp)
    run = two_dof.simulate(two_dof.dmp.times(0.002, 4.0), [Hold(0.5, 0.9)], dt=0.002)
    stepper = two_dof.stepper()
    assert isinstance(stepper, TwoDofStepper)
    found = [
        stepper.step(0.002 if k else 0.0, ya, yad) for k, (ya, yad) in enumerate(zip(run.ya, run.yad, strict=True))
    ]
    assert isinstance(found[0], Reference)
    assert np.abs([r.yc for r in found] - run.yc).max() < 2e-3
    assert stepper.has_ended
    assert (stepper.x, stepper.tau_a) == (pytest.approx(run.x[-1], abs=1e-3), pytest.approx(run.tau_a[-1], rel=1e-3))
    stepper.reset()
    assert (stepper.x, stepper.frozen, stepper.e.tolist()) == (1.0, False, [0.0, 0.0])


def test_uneven_steps_and_lost_samples_do_not_matter_much() -> None:
    two_dof = TwoDofDmp(smooth(force=4.0), e0=0.01)
    run = two_dof.simulate(0.001, dt=0.001)
    stepper, k, draw = two_dof.stepper(), 0, np.random.default_rng(0)
    stepper.step(0.0, run.ya[0], run.yad[0])
    while k < len(run.t) - 45:
        skip = int(draw.integers(1, 45))
        k += skip
        lost = draw.random() < 0.1
        found = stepper.step(1e-3 * skip, run.ya[k] * (np.nan if lost else 1), run.yad[k])
        assert np.abs(found.yc - run.yc[k]).max() < 0.02
        assert np.isfinite(found.ydd_ref).all()


@pytest.mark.parametrize("schedule", ["canonical", "time"])
def test_it_has_ended_when_the_phase_has_gone_as_far_as_in_the_demonstration(schedule: str) -> None:
    dmp = smooth(schedule=schedule)
    stepper, ended = TwoDofDmp(dmp, kc=0.0).stepper(), []
    for k in range(511):
        stepper.step(H if k else 0.0, dmp.y0, np.zeros(2))
        ended.append(stepper.has_ended)
    first = H * ended.index(True)
    assert dmp.duration - 1e-9 <= first <= dmp.duration + 2 * H


def test_a_late_packet_is_solved_in_steps_of_4_ms() -> None:
    law, stepper = TwoDofDmp(smooth())._law(RunParameters.of(smooth())), TwoDofDmp(smooth()).stepper()
    found = stepper.step(0.044, np.zeros(2), np.zeros(2)).yc
    start = starting(RunParameters.of(smooth()))
    fine, coarse = (law.follow(start, 0.044, steps, FULL_SPEED, np.zeros(2), np.zeros(2))[0][:2] for steps in (200, 1))
    np.testing.assert_allclose(found, fine, rtol=0, atol=1e-6)
    assert np.abs(coarse - fine).max() > 1e-5
