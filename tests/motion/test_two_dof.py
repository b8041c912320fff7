"""Two-degree-of-freedom control: shape of the path, order, freeze. Numbers are in test_two_dof_reference.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ConfigError, ShapeError
from armlab.motion import Dmp
from armlab.motion.disturbances import FULL_SPEED, Displace, Hold, Push
from armlab.motion.two_dof import TwoDofDmp

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
def test_the_path_keeps_its_shape(
    smooth: Callable[..., Dmp], seed: int, n: int, t0: float, length: float, dof: int, blow: float
) -> None:
    events = [Hold(t0, t0 + length, [dof]), Displace(0.5 * t0, np.linspace(0, blow, n))]
    run = TwoDofDmp(smooth(n, seed), kc=1e3).simulate(0.01, events)
    np.testing.assert_allclose(run.yc, run.yc[:, :1] * 0.5 ** np.arange(n), rtol=0, atol=1e-9)


@settings(max_examples=10)
@given(c=st.floats(-2, 2), s=st.sampled_from([-1.5, 0.3, 2.0]), k=st.floats(0.5, 3.0))
def test_undisturbed_it_is_the_primitive(smooth: Callable[..., Dmp], c: float, s: float, k: float) -> None:
    dmp = smooth()
    run = TwoDofDmp(dmp).simulate(0.01, y0=dmp.y0 + c, g=dmp.y0 + c + s * (dmp.g - dmp.y0), duration=2 * k, dt=0.002)
    np.testing.assert_allclose(run.yc, run.free.y, rtol=0, atol=1e-6 * max(1, abs(s)))
    np.testing.assert_allclose(run.ya, run.yc, rtol=0, atol=1e-12 * (1 + abs(c)))
    np.testing.assert_allclose(run.tau_a, k * 2 / 3)


@pytest.mark.parametrize("schedule", ["canonical", "time", "position"])
def test_it_is_of_fourth_order(plain: Callable[..., Dmp], schedule: str) -> None:
    """With a hold and a push between grid points, on kernels that are wide for the steps."""
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


def test_a_hold_creeps_and_a_freeze_does_not(smooth: Callable[..., Dmp]) -> None:
    """Behind a hold the free path creeps away, less and less; frozen it stands, and thaws when let go."""
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


def test_inside_the_dead_zone_nothing_slows(smooth: Callable[..., Dmp]) -> None:
    dmp = smooth()
    run = TwoDofDmp(dmp, e0=[0.02, 0.02]).simulate(0.01, [Displace(0.5, 0.015)])
    np.testing.assert_array_equal(run.tau_a, dmp.tau_d)
    slowed = TwoDofDmp(dmp, e_scale=1.0).simulate(0.01, [Displace(0.5, 0.015)])
    finer = TwoDofDmp(dmp, e_scale=0.1).simulate(0.01, [Displace(0.5, 0.015)])
    assert dmp.tau_d * 1.05 < slowed.tau_a.max() < finer.tau_a.max()


def test_a_standing_error_slows_as_the_table_says(smooth: Callable[..., Dmp]) -> None:
    """tau_a = tau_d (1 + kc e^2) for 1, 2, 5, 10 and 20 mrad; the error is made by a plant that lags behind."""
    law = TwoDofDmp(smooth(1)).law
    dmp = smooth(1)
    kernel = law(_setting(dmp))
    for e, slower in ((1e-3, 1.01), (2e-3, 1.04), (5e-3, 1.25), (1e-2, 2.0), (2e-2, 5.0)):
        assert kernel.time_constant(np.array([0, 0, e, 0, 0, 1.0, 0])) == pytest.approx(slower * dmp.tau_d)


def test_every_coordinate_slows_by_its_own_zone_and_scale(smooth: Callable[..., Dmp]) -> None:
    """``tau_a = tau_d (1 + kc sum (d / s)^2)``; the phase of either kind slows by as much."""
    e, zone, scale = np.array([0.03, -0.05]), np.array([0.01, 0.02]), np.array([1.0, 0.5])
    slower = 1 + 1e4 * (0.02**2 + 0.06**2)
    for schedule, x, rate in (("canonical", 0.6, -0.6), ("time", 0.4, 1 / 3)):
        dmp = smooth(schedule=schedule)
        law = TwoDofDmp(dmp, e0=zone, e_scale=scale).law(_setting(dmp))
        state = np.concatenate([[0.1, 0.2], np.zeros(2), e, np.zeros(4), [x, 0.0]])
        assert law.time_constant(state) == pytest.approx(slower * dmp.tau_d, rel=1e-12)
        assert law.slopes(state, FULL_SPEED)[-2] == pytest.approx(rate / (slower * dmp.tau_d), rel=1e-12)


def test_acceleration_of_the_path_is_its_derivative_while_tau_changes(smooth: Callable[..., Dmp]) -> None:
    """Beyond the dead zone of one coordinate and inside that of the other, with scales that are not one."""
    two_dof = TwoDofDmp(smooth(), kc=1e3, e0=[0.01, 0.2], e_scale=[0.3, 2.0])
    run = two_dof.simulate(np.arange(0.0, 1.6, 5e-4), [Displace(0.5, [0.1, 0.1])], dt=5e-4)
    assert run.tau_a.max() > 5 * run.tau_a.min()
    active = np.abs(run.e) > two_dof.e0
    smoothly = (active[:-4] == active[4:]).all(axis=1)  # where the zone is left or entered the slope jumps
    rows = np.flatnonzero(smoothly & (run.t[:-4] > 0.5)) + 2
    assert active[rows, 0].sum() > 100
    by_differences = np.gradient(run.ycd, run.t, axis=0)
    np.testing.assert_allclose(run.ycdd[rows], by_differences[rows], rtol=0, atol=2e-3 * np.abs(run.ycdd).max())


def test_a_freeze_begins_at_the_limit_and_ends_at_0_8_of_it(smooth: Callable[..., Dmp]) -> None:
    """In units of the scale, in any coordinate; yc, z and x stand still, and e follows."""
    dmp = smooth()
    law = TwoDofDmp(dmp, e_max=0.1, e_scale=[1.0, 0.5]).law(_setting(dmp))
    state, flags = np.concatenate([np.zeros(2), [0.3, 0.1], np.zeros(6), [0.5, 0.0]]), []
    for error in (0.045, 0.051, 0.045, 0.041, 0.039, 0.045):
        state = state.copy()
        state[7] = -error
        state = law.advance(state, 0.0, 1, np.full(2, np.nan), FULL_SPEED)
        flags.append(bool(state[-1]))
    assert flags == [False, True, True, True, False, False]
    state[7] = 0.2
    after = law.advance(state, 0.004, 1, np.zeros(2), FULL_SPEED)
    np.testing.assert_array_equal(after[[0, 1, 2, 3, 10]], state[[0, 1, 2, 3, 10]])
    assert after[5] > 0.0
    np.testing.assert_array_equal(law.reference(after, FULL_SPEED)[:2], 0.0)


def test_a_run_at_other_times_is_the_same_run(smooth: Callable[..., Dmp]) -> None:
    """Events between the samples that are asked for happen all the same, at their times."""
    two_dof, events = TwoDofDmp(smooth()), [Hold(0.3, 0.62), Displace(0.9, 0.05)]
    fine = two_dof.simulate(0.01 * np.arange(151), events, dt=0.001)
    coarse = two_dof.simulate(np.array([0.0, 0.5, 1.5]), events, dt=0.001)
    np.testing.assert_allclose(coarse.ya, fine.ya[[0, 50, 150]], rtol=0, atol=1e-7)


def _setting(dmp: Any) -> Any:
    from armlab.motion.dmp.run import RunParameters

    return RunParameters.of(dmp)


@pytest.mark.parametrize(
    ("error", "misuse"),
    [
        (ShapeError, lambda d: TwoDofDmp("dmp")),
        (ShapeError, lambda d: TwoDofDmp(d, kp=-1)),
        (ShapeError, lambda d: TwoDofDmp(d, kc=np.nan)),
        (ShapeError, lambda d: TwoDofDmp(d, e0=-0.1)),
        (ShapeError, lambda d: TwoDofDmp(d, e0=[0.1, 0.1, 0.1])),
        (ShapeError, lambda d: TwoDofDmp(d, e_scale=[0.0, 1.0])),
        (ShapeError, lambda d: TwoDofDmp(d, e_max=0)),
        (ShapeError, lambda d: TwoDofDmp(d, e_max=np.nan)),
        (ShapeError, lambda d: TwoDofDmp(d).simulate(dt=0)),
        (ShapeError, lambda d: TwoDofDmp(d).simulate([0.0, 0.0])),
        (ShapeError, lambda d: TwoDofDmp(d).simulate(g=[1.0])),
        (ConfigError, lambda d: TwoDofDmp(d).simulate(duration=1.0, tau_d=1.0)),
        (ShapeError, lambda d: TwoDofDmp(d).stepper(g=np.ones((3, 2)))),
        (ShapeError, lambda d: TwoDofDmp(d).stepper().step(-0.1, np.zeros(2), np.zeros(2))),
        (ShapeError, lambda d: TwoDofDmp(d).stepper().step(np.inf, np.zeros(2), np.zeros(2))),
        (ShapeError, lambda d: TwoDofDmp(d).stepper().step(0.1, np.zeros(3), np.zeros(2))),
        (ShapeError, lambda d: TwoDofDmp(d).stepper().change_goal([np.nan, 0])),
    ],
)
def test_bad_input_gets_a_sentence(smooth: Callable[..., Dmp], error: type[Exception], misuse: Any) -> None:
    with pytest.raises(error, match=r"^Expected .*\.$"):
        misuse(smooth())
