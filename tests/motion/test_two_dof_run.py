"""Simulated runs: events at their very times, plants, what is recorded, contradictions refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import Dmp
from armlab.motion.disturbances import FULL_SPEED, Displace, Hold, Plant, Push, TwoDofRun, simulated
from armlab.motion.two_dof import TwoDofDmp

Build = Callable[..., Dmp]


def test_events_happen_between_the_samples(primitive: Build) -> None:
    """A hold that begins and ends between samples stops the arm for exactly its time."""
    two_dof = TwoDofDmp(primitive(), kc=0.0)
    t = np.array([0.0, 0.401, 0.4017, 0.4995, 0.6, 1.0])
    run = two_dof.simulate(t, [Hold(0.4013, 0.5005, [1]), Push(0.4013, 0.5005, 0.2, [0])])
    np.testing.assert_allclose(run.ya[3, 0] - run.ya[2, 0], 0.2 * (0.4995 - 0.4017), atol=1e-12)
    assert run.ya[3, 1] == run.ya[2, 1]
    np.testing.assert_array_equal(run.yad[3, :2], [0.2, 0.0])
    assert run.ya[3, 2] != run.ya[2, 2]
    assert run.disturbed == ((0.4013, 0.5005), (0.4013, 0.5005))


def test_a_run_is_that_on_a_grid_with_the_times_of_its_events(primitive: Build) -> None:
    two_dof, t = TwoDofDmp(primitive(), kc=100.0), 0.01 * np.arange(101)
    events = [Hold(0.3033, 0.4521, [1]), Push(0.6077, 0.7049, 0.2, [0]), Displace(0.8012, 0.1)]
    finer = np.union1d(t, [0.3033, 0.4521, 0.6077, 0.7049, 0.8012])
    run, wanted = two_dof.simulate(t, events, dt=0.01), two_dof.simulate(finer, events, dt=0.01)
    rows = np.searchsorted(finer, t)
    for name in ("yc", "ycd", "ya", "yad", "e", "x", "tau_a"):
        np.testing.assert_allclose(getattr(run, name), getattr(wanted, name)[rows], rtol=0, atol=1e-9, err_msg=name)
    alone = two_dof.simulate(t, [], dt=0.01)
    assert np.abs(run.ya - alone.ya).max() > 0.01


def test_at_the_time_of_an_event_is_what_was_before_it(primitive: Build) -> None:
    two_dof, t = TwoDofDmp(primitive()), np.array([0.0, 0.5, 0.5 + 1e-9])
    run = two_dof.simulate(t, [Displace(0.5, [0.1, 0.0, -0.2])])
    np.testing.assert_allclose(run.ya[2] - run.ya[1], [0.1, 0.0, -0.2], atol=1e-7)
    np.testing.assert_allclose(run.ya[1], run.yc[1], atol=1e-12)
    assert run.disturbed == ((0.5, 0.5),)


def test_a_clock_that_starts_later_changes_nothing(primitive: Build) -> None:
    two_dof, t = TwoDofDmp(primitive()), 0.01 * np.arange(150)
    run = two_dof.simulate(t, [Hold(0.3, 0.7), Displace(1.0, 0.1)])
    later = two_dof.simulate(t + 5.0, [Hold(5.3, 5.7), Displace(6.0, 0.1)])
    np.testing.assert_allclose(later.ya, run.ya, atol=1e-9)


def test_the_perfect_plant_is_no_plant(primitive: Build) -> None:
    def perfect(t: float, ya: np.ndarray, yad: np.ndarray, ydd_ref: np.ndarray) -> np.ndarray:
        return ydd_ref

    plant: Plant = perfect
    two_dof, t = TwoDofDmp(primitive()), 0.02 * np.arange(60)
    events: list[Any] = [Hold(0.3, 0.5, [0]), Displace(0.71, 0.1)]
    run, plain = two_dof.simulate(t, [*events, plant]), two_dof.simulate(t, events)
    for name in ("yc", "ya", "yad", "e", "x"):
        np.testing.assert_allclose(getattr(run, name), getattr(plain, name), rtol=0, atol=1e-11, err_msg=name)


def test_a_weak_plant_is_waited_for(primitive: Build) -> None:
    """An arm with half the acceleration it is asked for falls behind and the path waits; both reach the goal."""
    dmp = primitive()
    run = TwoDofDmp(dmp).simulate(dmp.times(0.004, 12.0), [lambda t, ya, yad, ydd: 0.5 * ydd])
    assert run.tau_a.max() > 1.5 * dmp.tau_d
    np.testing.assert_allclose(run.ya[-1], dmp.g, atol=1e-3)


def test_results_are_frozen_and_complete(primitive: Build) -> None:
    run = TwoDofDmp(primitive()).simulate(0.01)
    assert isinstance(run, TwoDofRun)
    N = len(run.t)
    assert {a.shape for a in (run.yc, run.ycd, run.ycdd, run.ya, run.yad, run.ydd_ref, run.e)} == {(N, 3)}
    assert (run.x.shape, run.tau_a.shape, run.frozen.dtype) == ((N,), (N,), bool)
    with pytest.raises(ValueError, match="read-only"):
        run.ya[0, 0] = 1.0
    assert TwoDofDmp(primitive("position")).simulate(0.01).x.shape == (N, 3)


@pytest.mark.parametrize(
    "events",
    [
        [Hold(0.1, 0.5), Push(0.4, 0.6, 0.1, [2])],
        [Hold(0.1, 0.5, [7])],
        [Displace(0.1, [0.1, 0.2])],
        ["hold"],
        Hold(0.1, 0.5),
        [lambda *_: np.zeros(3), lambda *_: np.zeros(3)],
        [lambda *_: np.zeros(2)],
        [lambda *_: np.full(3, np.nan)],
    ],
)
def test_events_that_make_no_sense_get_a_sentence(primitive: Build, events: Any) -> None:
    with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
        TwoDofDmp(primitive()).simulate(0.01, events)


def test_states_are_those_of_the_kernel(primitive: Build) -> None:
    from armlab.motion.dmp.run import RunParameters

    dmp = primitive()
    law, start = TwoDofDmp(dmp).law(RunParameters.of(dmp)), np.concatenate([np.zeros(15), [1.0, 0.0]])
    states, disturbed = simulated(law, start, np.array([0.0, 0.01]), [], 0.005)
    np.testing.assert_array_equal(states[1], law.advance(start, 0.01, 2, np.full(3, np.nan), FULL_SPEED))
    assert disturbed == ()
