"""Two-degree-of-freedom control sample by sample: the simulation, uneven steps, goals that change."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import Dmp
from armlab.motion.disturbances import FULL_SPEED, Hold
from armlab.motion.dmp.run import RunParameters
from armlab.motion.two_dof import Reference, TwoDofDmp, TwoDofStepper, starting

H = 0.004


def test_it_starts_with_the_arm_on_the_path(smooth: Callable[..., Dmp]) -> None:
    dmp = smooth(schedule="time")
    run = RunParameters.of(dmp, y0=np.array([0.1, 0.2]), v0=np.array([0.3, 0.4]))
    z = run.tau * run.v0
    np.testing.assert_array_equal(starting(run), [0.1, 0.2, *z, 0, 0, 0.1, 0.2, 0.3, 0.4, 0, 0])
    assert starting(RunParameters.of(smooth()))[-2] == 1.0


def test_stepper_is_the_simulation(smooth: Callable[..., Dmp]) -> None:
    """With the arm of the simulation measured at every step the path is the same to the accuracy of sampling."""
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


def test_uneven_steps_and_lost_samples_do_not_matter_much(smooth: Callable[..., Dmp]) -> None:
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


def test_goal_changes_on_the_way(smooth: Callable[..., Dmp]) -> None:
    dmp = smooth()
    stepper, ya, yad = TwoDofDmp(dmp).stepper(), np.zeros(2), np.zeros(2)
    goal = np.array([1.3, -0.2])
    for k in range(2500):
        if k == 200:
            before = stepper.step(0.0, ya, yad).yc
            stepper.change_goal(goal)
            np.testing.assert_array_equal(stepper.step(0.0, ya, yad).yc, before)
        found = stepper.step(H if k else 0.0, ya, yad)
        ya, yad = ya + H * yad + 0.5 * H**2 * found.ydd_ref, yad + H * found.ydd_ref
    np.testing.assert_allclose(ya, goal, atol=1e-3)
    np.testing.assert_array_equal(stepper.goal, goal)


def test_a_goal_outside_the_limits_is_refused(smooth: Callable[..., Dmp]) -> None:
    stepper = TwoDofDmp(smooth(limits=np.array([[-1.0, -1.0], [2.0, 2.0]]))).stepper()
    with pytest.raises(ShapeError, match=r"coordinates \[1\]"):
        stepper.change_goal([0.0, 3.0])
    assert stepper.goal.tolist() == [1.0, 0.5]


def test_acceleration_is_the_derivative_while_the_speed_changes(smooth: Callable[..., Dmp]) -> None:
    """Of a primitive that is slowed down to a half and back, with an arm that is on the path."""
    stepper, rows, speeds = TwoDofDmp(smooth(force=4.0)).stepper(), [], 1.0 - np.r_[0:0.5:251j, 0.5:0.0:251j]
    ya, yad = np.zeros(2), np.zeros(2)
    for before, now, after in zip(np.r_[1.0, speeds], speeds, np.r_[speeds[1:], 1.0]):
        found = stepper.step(1e-3 if rows else 0.0, ya, yad, np.array([before, now, (after - now) / 1e-3]))
        ya, yad = found.yc, found.ycd
        rows.append((found.ycd.copy(), found.ycdd.copy()))
    ycd, ycdd = np.array(rows).swapaxes(0, 1)
    inner = np.r_[2:249, 254:499]
    np.testing.assert_allclose(ycdd[inner], np.gradient(ycd, 1e-3, axis=0)[inner], rtol=0, atol=0.02)


@pytest.mark.parametrize("schedule", ["canonical", "time"])
def test_it_has_ended_when_the_phase_has_gone_as_far_as_in_the_demonstration(
    smooth: Callable[..., Dmp], schedule: str
) -> None:
    dmp = smooth(schedule=schedule)
    stepper, ended = TwoDofDmp(dmp, kc=0.0).stepper(), []
    for k in range(511):
        stepper.step(H if k else 0.0, dmp.y0, np.zeros(2))
        ended.append(stepper.has_ended)
    first = H * ended.index(True)
    assert dmp.duration - 1e-9 <= first <= dmp.duration + 2 * H


def test_a_late_packet_is_solved_in_steps_of_4_ms(smooth: Callable[..., Dmp]) -> None:
    law, stepper = TwoDofDmp(smooth()).law(RunParameters.of(smooth())), TwoDofDmp(smooth()).stepper()
    found = stepper.step(0.044, np.zeros(2), np.zeros(2)).yc
    start = starting(RunParameters.of(smooth()))
    fine, coarse = (law.follow(start, 0.044, steps, FULL_SPEED, np.zeros(2), np.zeros(2))[0][:2] for steps in (200, 1))
    np.testing.assert_allclose(found, fine, rtol=0, atol=1e-6)
    assert np.abs(coarse - fine).max() > 1e-5
