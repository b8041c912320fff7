"""What makes no sense gets a sentence from every kind of motion: what was expected, what came."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ArmlabError
from armlab.lie import so3
from armlab.motion import (
    Dmp,
    Hold,
    ProMP,
    TwoDofDmp,
    blend,
    fit_dmp,
    fit_periodic_dmp,
    fit_pose_dmp,
    fit_promp,
    profiles,
)

U = np.linspace(0.0, 1.0, 30)
S = U**3 * (10 - 15 * U + 6 * U**2)
Y = np.stack([S, 0.5 * S], axis=1)
MANY = np.stack([(1 + 0.1 * k) * Y for k in range(4)])
POSES = np.tile(np.eye(4), (30, 1, 1))
POSES[:, :3, 3], POSES[:, :3, :3] = np.outer(S, [0.1, 0.2, 0.3]), so3.exp(np.outer(S, [0.1, 0.3, 0.2]))
DMP = fit_dmp(U, Y, n_basis=6, limits=([-1.0, -1.0], [2.0, 2.0])).value
POSE = fit_pose_dmp(U, POSES, n_basis=6).value
WAVE = fit_periodic_dmp(U, np.sin(2 * np.pi * U), period=1.0, n_basis=6).value
PROMP: ProMP = fit_promp(U, MANY, n_basis=6).value

FITS: dict[str, Callable[..., Any]] = {
    "dmp": lambda t=U, y=Y, **more: fit_dmp(t, y, **{"n_basis": 6, **more}),
    "acceleration": lambda t=U, y=Y, **more: fit_dmp(t, y, **{"n_basis": 6, "method": "acceleration", **more}),
    "position": lambda t=U, y=Y, **more: fit_dmp(t, y, **{"n_basis": 6, "schedule": "position", **more}),
    "pose": lambda t=U, y=POSES, **more: fit_pose_dmp(t, y, **{"n_basis": 6, **more}),
    "periodic": lambda t=U, y=Y, **more: fit_periodic_dmp(t, y, **{"n_basis": 6, "period": 1.0, **more}),
    "promp": lambda t=U, y=MANY, **more: fit_promp(t, y, **{"n_basis": 6, **more}),
}
TIMES: dict[str, Any] = {
    "one sample": [0.0],
    "repeated": np.repeat(U[::2], 2),
    "backwards": U[::-1],
    "a gap": np.where(np.arange(30) == 4, np.nan, U),
    "without end": np.where(np.arange(30) == 29, np.inf, U),
    "too few": U[:-1],
    "none": [],
    "text": "now",
    "complex": U + 1j,
    "ragged": [[0.0, 1.0], [2.0]],
    "table": np.zeros((30, 2, 2)),
    "nothing": None,
}
VALUES: dict[str, Any] = {
    "a number": 3.0,
    "none": [],
    "no columns": np.zeros((30, 0)),
    "text": "home",
    "complex": Y + 1j,
    "ragged": [[0.0, 1.0], [2.0]],
    "missing": np.full((30, 2), np.nan),
    "without end": np.full((30, 2), np.inf),
    "four axes": np.zeros((30, 2, 2, 2)),
    "nothing": None,
}


def refused(call: Callable[[], Any]) -> None:
    with pytest.raises(ArmlabError, match=r"^Expected .*\.$") as caught:
        call()
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("fit", FITS.values(), ids=FITS)
@pytest.mark.parametrize("t", TIMES.values(), ids=TIMES)
def test_times(fit: Callable[..., Any], t: Any) -> None:
    refused(lambda: fit(t=t))


@pytest.mark.parametrize("fit", FITS.values(), ids=FITS)
@pytest.mark.parametrize("y", VALUES.values(), ids=VALUES)
def test_values(fit: Callable[..., Any], y: Any) -> None:
    refused(lambda: fit(y=y))


@pytest.mark.parametrize("fit", FITS.values(), ids=FITS)
@pytest.mark.parametrize("n_basis", [2, 1001, 6.0, True, None, "six", [6], np.nan])
def test_numbers_of_kernels(fit: Callable[..., Any], n_basis: Any) -> None:
    refused(lambda: fit(n_basis=n_basis))


OPTIONS = {
    "pin": (None, 3.0, "g", ("goal",)),
    "hold": (-1.0, 1e9, np.inf, "long", 1j),
    "limits": (3.0, ([1.0, 1.0], [0.0, 0.0]), ([0.0], [1.0]), (np.zeros((0, 2)), [1.0, 1.0]), "no"),
    "g": (np.zeros((0, 2)), np.zeros((2, 2)), [1.0], [1.0, np.inf], "home", 1j),
    "v0": (np.zeros((0, 2)), [1.0, 2.0, 3.0], [[1.0], []]),
    "alpha_z": (0.0, -1.0, np.inf, "stiff"),
    "ridge": (-1.0, np.inf, [1.0]),
    "sample_weights": (1.0, -np.ones(30), np.zeros(30), np.full(30, np.nan), "even"),
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in OPTIONS.items() for value in values])
def test_options_of_a_fit(name: str, value: Any) -> None:
    refused(lambda: fit_dmp(U, Y, n_basis=6, **{name: value}))


TEXTS = {
    **{
        name: lambda v, name=name: fit_dmp(U, Y, n_basis=6, **{name: v})
        for name in ("method", "schedule", "spacing", "scaling", "convention")
    },
    "pin": lambda v: fit_dmp(U, Y, n_basis=6, pin=(v,)),
    "smoothed": lambda v: fit_dmp(U, Y, n_basis=6, schedule=v, bandwidth=5.0),
    "pose frame": lambda v: fit_pose_dmp(U, POSES, n_basis=6, frame=v),
    "goal_forcing": lambda v: DMP.stepper(goal_forcing=v),
    "pose schedule": lambda v: fit_pose_dmp(U, POSES, n_basis=6, schedule=v),
    "pose scaling": lambda v: fit_pose_dmp(U, POSES, n_basis=6, scaling=v),
    "field": lambda v: replace(DMP, scaling=v),
    "pose field": lambda v: replace(POSE, frame=v),
}


@pytest.mark.parametrize("call", TEXTS.values(), ids=TEXTS)
def test_names_of_options(call: Callable[[Any], Any]) -> None:
    for value in (np.array(["goal", "time"]), np.array([1.0, 2.0]), np.array("goal"), ["goal"], {}, 3.0, b"goal", ""):
        refused(lambda value=value: call(value))


def test_lists_of_demonstrations_that_do_not_fit_each_other() -> None:
    for weights in (1.0, "even", [np.ones(30)]):
        refused(lambda weights=weights: fit_dmp([U, U], [Y, Y], n_basis=6, sample_weights=weights))
    for y in ([Y], [Y, Y[:5]], [Y, "home"], Y):
        refused(lambda y=y: fit_dmp([U, U], y, n_basis=6))


POSITIVE = (0.0, -1.0, np.nan, np.inf, "slow", 1j, [1.0, 2.0])
RUNS: dict[str, tuple[Callable[..., Any], dict[str, tuple[Any, ...]]]] = {
    "dmp": (
        lambda t=0.01, **more: DMP.rollout(t, **more),
        {
            "t": (0.0, 1e-9, [], [0.0, 0.0], [np.nan], "now", 1j, np.zeros((2, 2))),
            "duration": POSITIVE,
            "tau_d": POSITIVE,
            "y0": ([1.0], [1.0, np.nan], [1.0, np.inf], "home", np.zeros((2, 2))),
            "g": ([3.0, 0.0], [0.0, -2.0], [1.0], [1.0, np.nan], "home"),
            "amplitude": ([1.0, 1.0],),
        },
    ),
    "batch": (
        lambda t=0.01, **more: DMP.rollout_batch(t, **more),
        {"weights": (np.zeros((2, 5, 2)), np.full((2, 6, 2), np.nan), "heavy"), "g": ([[3.0, 0.0]], np.zeros((2, 3)))},
    ),
    "solve": (
        lambda t=0.5, **more: DMP.solve([0.0, t], **more),
        {"t": (0.0, np.nan, 1e9), "rtol": POSITIVE, "duration": (1e-9, *POSITIVE)},
    ),
    "stepper": (
        lambda dt=0.004, **more: DMP.stepper(**more).step(dt),
        {"dt": POSITIVE, "goal_rate": (-1.0, np.nan, "slow"), "duration": POSITIVE, "g": ([3.0, 0.0],)},
    ),
    "pose": (
        lambda t=0.01, **more: POSE.rollout(t, **more),
        {
            "t": (0.0, 1e-9, [], [0.0, 0.0], "now"),
            "duration": POSITIVE,
            "start": (np.eye(3), np.full((4, 4), np.nan), np.zeros(7), "home", 1j),
            "goal": (np.zeros((4, 4)), np.full(7, np.inf), [[1.0], []]),
            "twist0": (np.zeros(3), np.full(6, np.nan), "fast"),
        },
    ),
    "pose stepper": (lambda dt=0.004: POSE.stepper().step(dt), {"dt": POSITIVE}),
    "periodic": (
        lambda t=0.01, **more: WAVE.rollout(t, **more),
        {"t": (0.0, 1e-9, [], "now"), "period": POSITIVE, "r": (np.nan, np.inf, "big"), "g": ([1.0, 2.0], "low")},
    ),
    "periodic stepper": (lambda dt=0.004: WAVE.stepper().step(dt), {"dt": POSITIVE}),
    "promp": (
        lambda t=0.1, **more: PROMP.marginal(t, **more),
        {"t": (0.0, 1e-9, [], [np.nan], "now"), "duration": POSITIVE},
    ),
    "condition": (
        lambda t=0.5, y=(0.5, 0.25), **more: PROMP.condition(t, y, **more),
        {
            "t": ("now", [0.5, 0.6]),
            "y": ([0.5], [np.nan, 0.0], "there"),
            "cov": (-1.0, np.eye(3), np.nan),
            "coordinates": ([0, 0], [2, 0], 1, "x", [[0], []]),
        },
    ),
    "blend": (
        lambda primitives=(PROMP, PROMP), a=(1.0, 1.0): blend(primitives, a, 0.1),
        {"primitives": (None, 3.0, [], [DMP, DMP]), "a": ([1.0], [0.0, 0.0], [-1.0, 2.0], "both")},
    ),
    "two dof": (
        lambda t=(0.0, 0.1), **more: TwoDofDmp(DMP).simulate(t, **more),
        {"t": ([], [0.0, 0.0], "now"), "dt": (1e-9, *POSITIVE), "events": ([3.0], ["hold"], [Hold(0.0, 1.0, [5])])},
    ),
    "minimum jerk": (
        lambda q0=(0.0, 1.0), q1=(1.0, 2.0), duration=1.0, dt=0.004: profiles.minimum_jerk(q0, q1, duration, dt),
        {
            "q0": ([], [np.nan, 1.0], [np.inf, 1.0], "home", [1j, 2.0], [[1.0], []], [0.0]),
            "duration": POSITIVE,
            "dt": (1e-9, *POSITIVE),
        },
    ),
    "connect": (
        lambda points=((0.0,), (1.0,)), duration=1.0, cruise=1.5: profiles.connect(points, duration, cruise),
        {"points": ([], [[0.0]], [[0.0], [np.nan]], "path"), "duration": POSITIVE, "cruise": (1.0, 2.1, np.nan, "x")},
    ),
    "trapezoidal": (
        lambda v=1.0, a=1.0, q1=(1.0,): profiles.trapezoidal([0.0], q1, v, a),
        {"v": POSITIVE[:3], "a": POSITIVE, "q1": ([0.0], [1.0, 2.0], [np.inf])},
    ),
    "controller": (
        lambda robot=None, **more: SEVEN.controller(robots.load("yumi_right") if robot is None else robot, **more),
        {"robot": (3.0, "yumi", [3.0]), "limits": (3.0, "slow"), "g": (np.full(7, 9.0), [0.0], "home")},
    ),
}
SEVEN: Dmp = fit_dmp(U, robots.load("yumi_right").q_home + 0.1 * S[:, None] * np.ones(7), n_basis=6).value
CASES = [(kind, name, value) for kind, (_, table) in RUNS.items() for name, values in table.items() for value in values]


@pytest.mark.parametrize(("kind", "name", "value"), CASES)
def test_runs(kind: str, name: str, value: Any) -> None:
    refused(lambda: RUNS[kind][0](**{name: value}))


def test_an_immeasurably_short_step_changes_nothing() -> None:
    for stepper in (DMP.stepper(), WAVE.stepper(), POSE.stepper()):
        before = stepper.state[0]
        np.testing.assert_allclose(stepper.step(1e-320)[0], before, rtol=0, atol=1e-90)
