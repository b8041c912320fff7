"""Invalid input: every kind of motion reports what it expected and what it got."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.errors import ArmlabError, ConfigError, NotExcited, ShapeError, UnknownName
from armlab.lie import so3
from armlab.motion import (
    AvoidingDmp,
    Capsule,
    Displace,
    Dmp,
    Hold,
    PeriodicDmp,
    PoseDmp,
    ProMP,
    Push,
    TwoDofDmp,
    blend,
    fit_dmp,
    fit_periodic_dmp,
    fit_pose_dmp,
    fit_promp,
    profiles,
    retimed,
    shortest_duration,
    with_via_points,
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
WRONG_DEMOS: dict[str, tuple[Any, ...]] = {
    "t": (
        [0.0], np.repeat(U[::2], 2), U[::-1], np.where(np.arange(30) == 4, np.nan, U),
        np.where(np.arange(30) == 29, np.inf, U), U[:-1], [], "now", U + 1j, [[0.0, 1.0], [2.0]],
        np.zeros((30, 2, 2)), None,
    ),
    "y": (
        3.0, [], np.zeros((30, 0)), "home", Y + 1j, [[0.0, 1.0], [2.0]], np.full((30, 2), np.nan),
        np.full((30, 2), np.inf), np.zeros((30, 2, 2, 2)), None,
    ),
    "n_basis": (2, 1001, 6.0, True, None, "six", [6], np.nan),
}  # fmt: skip


def refused(call: Callable[[], Any]) -> None:
    with pytest.raises(ArmlabError, match=r"^Expected .*\.$") as caught:
        call()
    assert len(str(caught.value)) < 500


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


NO_TEXTS = (np.array(["goal", "time"]), np.array([1.0, 2.0]), np.array("goal"), ["goal"], {}, 3.0, b"goal", "")
POSITIVE = (0.0, -1.0, np.nan, np.inf, "slow", 1j, [1.0, 2.0])
RUNS: dict[str, tuple[Callable[..., Any], dict[str, tuple[Any, ...]]]] = {
    **{f"fit of {name}": (call, WRONG_DEMOS) for name, call in FITS.items()},
    "options of a fit": (lambda **more: fit_dmp(U, Y, n_basis=6, **more), OPTIONS),
    "lists": (
        lambda y=(Y, Y), **more: fit_dmp([U, U], y, n_basis=6, **more),
        {"sample_weights": (1.0, "even", [np.ones(30)]), "y": ([Y], [Y, Y[:5]], [Y, "home"], Y)},
    ),
    **{name: (call, {"v": NO_TEXTS}) for name, call in TEXTS.items()},
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
CASES = [(kind, name) for kind, (_, table) in RUNS.items() for name in table]


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_runs(kind: str, name: str) -> None:
    call, table = RUNS[kind]
    for value in table[name]:
        refused(lambda value=value: call(**{name: value}))


def test_an_immeasurably_short_step_changes_nothing() -> None:
    for stepper in (DMP.stepper(), WAVE.stepper(), POSE.stepper()):
        before = stepper.state[0]
        np.testing.assert_allclose(stepper.step(1e-320)[0], before, rtol=0, atol=1e-90)


ROBOT, OTHER = robots.load("yumi_right"), robots.load("ur5e")
SPACE = fit_dmp(U, np.outer(S, [0.5, 0.1, 0.2]), n_basis=6).value
BALL, NEAR = Capsule.sphere([0.5, 0.2], 0.05), Capsule.sphere(SPACE.g + 0.01, 0.05)
Q0, Q1, CORNERS = np.zeros(3), np.array([1.2, 0.6, 0.0]), np.array([[0.5, -0.5], [0.5, 0.0], [1.5, 0.0], [1.5, -0.5]])
CIRCLE = np.stack([np.sin(2 * np.pi * U), 0.3 + 0.1 * np.cos(2 * np.pi * U)], axis=1)
PACED, TWO_DOF = retimed(DMP, 1.0), TwoDofDmp(DMP)
HALF_TURNED = POSES.copy()
HALF_TURNED[:, :3, :3] = so3.exp(np.outer(U, [0, 0, 3.5]))
Wrong = tuple[type[ArmlabError], str, Callable[[], Any]]


def fit(**options: Any) -> Any:
    return fit_dmp(**{"t": [0.0, 1.0, 2.0, 3.0], "y": [0.0, 1.0, 2.0, 2.0], **options})


def periodic(**options: Any) -> Any:
    return fit_periodic_dmp(**{"t": U, "y": CIRCLE, "period": 1.0, **options})


def promp(**options: Any) -> Any:
    return fit_promp(**{"t": U, "y": np.zeros((3, 30, 1)), "n_basis": 4, **options})


def pose(**options: Any) -> Any:
    return fit_pose_dmp(**{"t": U, "T": POSES, "n_basis": 6, **options})


def avoiding(dmp: Dmp, obstacles: Any = (), clearance: float = 0.02, reach: float = 0.1, **more: Any) -> AvoidingDmp:
    return AvoidingDmp(dmp, obstacles, clearance, reach, **more)


def moved(**changes: Any) -> PoseDmp:
    return replace(POSE, rotation=replace(POSE.rotation, **changes))


def far() -> np.ndarray:
    return POSE.T_goal + np.array([0, 0, 0, 3.0]) * np.eye(4)[2][:, None]


def set_to(value: Any, name: str, new: Any) -> None:
    setattr(value, name, new)


PRIMITIVES: list[Wrong] = [
    (ConfigError, "got both", lambda: DMP.rollout(U, duration=1.0, tau_d=1.0)),
    (ShapeError, "real numbers", lambda: DMP.rollout(U, v0="fast")),
    (ShapeError, "rollout_batch", lambda: DMP.rollout(U, g=np.zeros((2, 2)))),
    (ShapeError, r"dt \[s\] between 1e-07 and the duration 1,", lambda: DMP.rollout(4.0)),  # milliseconds
    (ShapeError, "n_basis, n", lambda: replace(DMP, weights=np.zeros(3))),
    (ShapeError, "finite weights", lambda: replace(DMP, weights=np.full((6, 2), np.nan))),
    (ShapeError, "centres", lambda: replace(DMP, weights=np.zeros((5, 2)))),
    (ShapeError, "g of shape", lambda: replace(DMP, g=np.zeros(3))),
    (ShapeError, "widths (> 0|.standard deviations. above 0)", lambda: replace(DMP, widths=np.zeros(6))),
    (UnknownName, "canonical", lambda: replace(DMP, schedule="clock")),
    (UnknownName, "amplitude", lambda: replace(DMP, scaling="size")),
    (UnknownName, "ijspeert", lambda: replace(DMP, convention="mine")),
    (ConfigError, "rotate", lambda: replace(SPACE, scaling="rotate", schedule="position")),
    (ShapeError, "demo_weights", lambda: replace(DMP, demo_weights=np.zeros((3, 2, 2)))),
    (UnknownName, "shift", lambda: DMP.stepper(goal_forcing="jump")),
    (ConfigError, "scaling", lambda: replace(DMP, scaling="none").stepper(goal_forcing="scale")),
    (ShapeError, "g with 2", lambda: DMP.stepper().change_goal(np.zeros(3))),
    (ShapeError, "above zero", lambda: DMP.stepper().change_duration(0.0)),
    (ShapeError, "neither", lambda: with_via_points(DMP, 0.5)),
    (ShapeError, "times", lambda: with_via_points(DMP, 1.5, DMP.g)),
    (ShapeError, "distinct times", lambda: with_via_points(DMP, [0.5, 0.5], np.zeros((2, 2)))),
    (ShapeError, "finite y of shape", lambda: with_via_points(DMP, 0.5, [0.0, np.nan])),
    (ShapeError, "yd of shape", lambda: with_via_points(DMP, 0.5, yd=[[0.0, 1.0, 2.0]])),
    (NotExcited, "6 weights", lambda: with_via_points(DMP, np.linspace(0.1, 0.9, 9), np.zeros((9, 2)))),
    (
        ConfigError,
        "time-dependent phase for via-points",
        lambda: with_via_points(replace(DMP, schedule="position"), 0.5, DMP.g),
    ),
    (ShapeError, "v_max above zero", lambda: shortest_duration(DMP, 0.0)),
    (ShapeError, "a_max to be one number", lambda: shortest_duration(DMP, 1.0, [1.0, 2.0, 3.0])),
    (ShapeError, "increasing times", lambda: PACED.rollout([0.0, 0.0])),
    (ShapeError, r"dt .* above zero", lambda: PACED.stepper().step(-1.0)),
    (ConfigError, "no duration for a retimed motion", lambda: PACED.stepper(duration=9.0)),
]
DEMONSTRATIONS: list[Wrong] = [
    (ShapeError, "repeated .* rows 2", lambda: fit(t=[0, 1, 1, 2])),
    (ShapeError, "rows 2", lambda: fit(y=[0, 1, np.nan, 2])),
    (ConfigError, "tuple", lambda: fit(pin="g")),
    (ConfigError, "bandwidth only for methods with derivatives", lambda: fit(bandwidth=10.0)),
    (ConfigError, "only with method 'lwr'", lambda: fit(raw_kernels=True)),
    (ConfigError, "beta_z", lambda: fit(beta_z=-1.0)),
    (ShapeError, "coordinate 0, which steps back at sample 2", lambda: fit(schedule="position", y=[0, 2, 1, 2])),
    (ShapeError, "ends at its start", lambda: fit(schedule="position", y=[1, 2, 1, 1])),
    (ShapeError, "arrays in y and sample_weights", lambda: fit(t=[[0, 1, 2]] * 2, y=[[0, 1, 2]])),
    (ShapeError, "equal numbers of coordinates", lambda: fit(t=[[0, 1, 2]] * 2, y=[[0, 1, 2], np.zeros((3, 2))])),
    (ShapeError, "demonstration 1, got .* rows 1", lambda: fit(t=[[0, 1, 2]] * 2, y=[[0, 1, 2], [0, np.nan, 2]])),
    (ShapeError, "period above zero", lambda: periodic(period=0.0)),
    (ShapeError, "h above zero", lambda: periodic(h=-1.0)),
    (ShapeError, "alpha_z above zero", lambda: periodic(alpha_z=0.0)),
    (ShapeError, "rows 20", lambda: periodic(y=np.where(np.arange(30)[:, None] > 19, np.nan, CIRCLE))),
    (ShapeError, "one demonstration, got 2", lambda: periodic(t=[U, U], y=[CIRCLE, CIRCLE])),
    (ShapeError, "at least 2 demonstrations", lambda: promp(y=np.zeros((1, 30, 1)))),
    (ShapeError, "at least 2 demonstrations", lambda: promp(t=[U], y=[np.zeros((30, 1))])),
    (ShapeError, "at least 2 demonstrations", lambda: promp(t=[], y=[])),
    (ShapeError, "of demonstration 0", lambda: promp(y=np.full((3, 30, 1), np.nan))),
    (NotExcited, "at least 31 samples", lambda: promp(n_basis=31)),
    (ShapeError, "equal numbers of coordinates", lambda: promp(t=[U, U], y=[np.zeros((30, 1)), np.zeros((30, 2))])),
    (ShapeError, r"NaN or Inf in row 0 \(30", lambda: pose(T=np.full((30, 7), np.nan))),
    (ShapeError, "norm 1", lambda: pose(T=np.ones((30, 7)))),
    (ShapeError, "last rows", lambda: pose(T=np.ones((30, 4, 4)))),
    (ShapeError, "at half a turn", lambda: pose(T=HALF_TURNED)),
    (ConfigError, "time-dependent phase for poses", lambda: pose(schedule="position")),
]
POSE_RUNS: list[Wrong] = [
    (ShapeError, "half a turn apart", lambda: POSE.rollout(0.01, start=np.diag([-1.0, -1, 1, 1]) @ POSE.T_goal)),
    (ShapeError, "the same tau_d for position and rotation", lambda: moved(tau_d=1.0)),
    (ShapeError, "rotation with goal 0", lambda: moved(g=np.ones(3))),
    (ShapeError, "the position to be a Dmp", lambda: replace(POSE, position=None)),
    (ShapeError, "norm 1", lambda: replace(POSE, goal=np.ones(4))),
    (UnknownName, "frame", lambda: replace(POSE, frame="tool")),
    (ShapeError, "goal to be a pose", lambda: POSE.stepper().change_goal(np.eye(3))),
    (ConfigError, "base axes", lambda: replace(POSE, frame="goal").stepper().change_goal(np.eye(4))),
    (ConfigError, "rotate", lambda: pose(scaling="rotate").value.stepper().change_goal(POSES[15])),
    (ShapeError, "a goal that yumi_right can reach", lambda: POSE.controller(ROBOT, goal=far())),
]
RHYTHMS_AND_DISTRIBUTIONS: list[Wrong] = [
    (ShapeError, "weights of shape", lambda: replace(WAVE, weights=np.zeros(3))),
    (ShapeError, "g of shape", lambda: replace(WAVE, g=np.zeros(3))),
    (ShapeError, "h above zero", lambda: replace(WAVE, h=0.0)),
    (ShapeError, "period above zero", lambda: WAVE.stepper().change(period=0.0)),
    (ShapeError, "finite amplitude r", lambda: WAVE.stepper().change(r=np.nan)),
    (ShapeError, "turns above zero", lambda: rhythm().controller(ROBOT, turns=0.0)),
    (ShapeError, "6 joints for ur5e", lambda: rhythm().controller(OTHER)),
    (ShapeError, "neither", lambda: PROMP.condition(0.5)),
    (ShapeError, "got -1 s", lambda: PROMP.condition(-1.0, [0.0, 0.0])),
    (ShapeError, "from 0 to 0.5 s", lambda: PROMP.condition(1.0, [0.0, 0.0], duration=0.5)),
    (ShapeError, "demonstrations do not vary", lambda: replace(PROMP, cov=0 * PROMP.cov).condition(1.0, [9.0, 9.0])),
    (ShapeError, "seed", lambda: PROMP.sample(U, -1, 2)),
    (ConfigError, "count", lambda: PROMP.sample(U, 0, 0)),
    (ShapeError, "mean weights", lambda: replace(PROMP, mean=np.zeros(3))),
    (ShapeError, "symmetric cov", lambda: replace(PROMP, cov=np.triu(np.ones((12, 12))))),
    (ShapeError, "widths (> 0|.standard deviations. above 0)", lambda: replace(PROMP, widths=0 * PROMP.widths)),
]
OBSTACLES: list[Wrong] = [
    (ShapeError, "goal to be outside the clearance", lambda: avoiding(SPACE, [NEAR]).rollout(U)),
    (ShapeError, "start to be outside the clearance", lambda: avoiding(SPACE, [Capsule.sphere(SPACE.y0)]).stepper()),
    (ShapeError, "2 dimensions, got 3 dimensions at index 0", lambda: avoiding(DMP, [NEAR])),
    (ShapeError, "finite point", lambda: Capsule.sphere([0.0, np.nan, 0.0])),
    (ShapeError, "radius >= 0 m", lambda: Capsule.sphere([0.0, 0.0], -1.0)),
    (ConfigError, "clearance < reach", lambda: avoiding(SPACE, [], 0.2, 0.1)),
    (ConfigError, "2 or 3 coordinates", lambda: avoiding(SEVEN)),
    (ConfigError, "of 7 coordinates", lambda: avoiding(SPACE, robot=ROBOT)),
    (ConfigError, "link numbers from 1 to 7, got 8", lambda: avoiding(SEVEN, robot=ROBOT, links={8: NEAR})),
    (ConfigError, "in joint space", lambda: avoiding(SPACE).controller()),
    (ConfigError, "a robot for the capsules of the tool and links", lambda: avoiding(DMP, [BALL], tool=BALL)),
    (ConfigError, "a robot for the capsules of the tool and links", lambda: avoiding(DMP, [BALL], links={1: BALL})),
    (UnknownName, "form", lambda: avoiding(SPACE, form="wall")),
    *((ArmlabError, "(obstacles|capsules)", lambda x=x: avoiding(DMP, x)) for x in (BALL, ["ball"], None, [None])),
    *((ArmlabError, "capsules", lambda x=x: avoiding(DMP).stepper().place(x)) for x in (BALL, ["ball"], None, [None])),
]
CONTROL: list[Wrong] = [
    (ShapeError, "6 joints for ur5e", lambda: SEVEN.controller(OTHER)),
    (ShapeError, "6 joints for ur5e", lambda: TwoDofDmp(SEVEN).controller(OTHER)),
    (ShapeError, "limits for the 7 joints", lambda: SEVEN.controller(ROBOT, limits=bridge.Limits.of(OTHER))),
    (ShapeError, "joint 1 of yumi_right", lambda: set_to(SEVEN.controller(ROBOT), "goal", ROBOT.q_min - 1)),
    (ConfigError, "speed of at least 0", lambda: set_to(SEVEN.controller(ROBOT), "speed", -0.1)),
    (ConfigError, "amplitude", lambda: SEVEN.controller(ROBOT, amplitude=np.ones(7))),
    (ShapeError, "a Dmp, got str", lambda: TwoDofDmp("dmp")),  # type: ignore[arg-type]
    (ShapeError, "kp of at least 0", lambda: TwoDofDmp(DMP, kp=-1)),
    (ShapeError, "e0 of at least 0", lambda: TwoDofDmp(DMP, e0=-0.1)),
    (ShapeError, "e0 to be one number or 2", lambda: TwoDofDmp(DMP, e0=[0.1, 0.1, 0.1])),
    (ShapeError, "e_scale above 0", lambda: TwoDofDmp(DMP, e_scale=[0.0, 1.0])),
    (ShapeError, "e_max above 0", lambda: TwoDofDmp(DMP, e_max=0)),
    (ShapeError, "", lambda: TWO_DOF.stepper().step(-0.1, np.zeros(2), np.zeros(2))),
    (ShapeError, "", lambda: TWO_DOF.stepper().step(np.inf, np.zeros(2), np.zeros(2))),
    (ShapeError, "", lambda: TWO_DOF.stepper().step(0.1, np.zeros(3), np.zeros(2))),
    (ShapeError, "finite g", lambda: TWO_DOF.stepper().change_goal([np.nan, 0])),
    (ShapeError, r"coordinates \[1\]", lambda: TWO_DOF.stepper().change_goal([0.0, 3.0])),
    (ShapeError, r"coordinates \[0\]", lambda: DMP.stepper().change_goal([-3.0, 1.0])),
    (ShapeError, "finite t0 < t1", lambda: Hold(1.0, 1.0)),
    (ShapeError, "finite t0 < t1", lambda: Hold(np.nan, 1.0)),
    (ShapeError, "finite velocity", lambda: Push(0.0, 1.0, np.nan)),
    (ShapeError, "velocity", lambda: Push(0.0, 1.0, "fast")),  # type: ignore[arg-type]
    *((ShapeError, "dofs", lambda x=x: Hold(0.0, 1.0, x)._drive(3)) for x in ([3], [-1], [0, 0], [], [0.5])),
    (ShapeError, "one velocity, or 3", lambda: Push(0.0, 1.0, [1.0, 2.0])._drive(3)),
    (ShapeError, "finite time", lambda: Displace(np.inf, 0.1)),
    (ShapeError, "finite time", lambda: Displace(0.0, [0.1, np.nan])),
    (
        ShapeError,
        "one event per coordinate",
        lambda: TWO_DOF.simulate(0.01, [Hold(0.1, 0.5), Push(0.4, 0.6, 0.1, [1])]),
    ),
    (ShapeError, "displacement of 2", lambda: TWO_DOF.simulate(0.01, [Displace(0.1, [0.1, 0.2, 0.3])])),
    (ShapeError, "a list of events", lambda: TWO_DOF.simulate(0.01, Hold(0.1, 0.5))),  # type: ignore[arg-type]
    (ShapeError, "at most one plant", lambda: TWO_DOF.simulate(0.01, [lambda *_: np.zeros(2)] * 2)),
    (ShapeError, "finite accelerations", lambda: TWO_DOF.simulate(0.01, [lambda *_: np.zeros(3)])),
    (ShapeError, "finite accelerations", lambda: TWO_DOF.simulate(0.01, [lambda *_: np.full(2, np.nan)])),
]
PROFILES: list[Wrong] = [
    (ShapeError, "breaks", lambda: profiles.Profile(np.array([0.0, 1.0]), np.zeros((2, 6, 1)))),
    (ShapeError, "qd0 to be one number or of shape", lambda: profiles.quintic(Q0, Q1, 1.0, qd0=[1.0, 2.0])),
    (ShapeError, "qdd1 finite", lambda: profiles.quintic(Q0, Q1, 1.0, qdd1=np.nan)),
    (ShapeError, "duration of the segments", lambda: profiles.connect(CORNERS, [1.0, 2.0])),
    (ShapeError, "missing values in point 2", lambda: profiles.connect(np.where(CORNERS > 1, np.nan, CORNERS), 1.0)),
    (ShapeError, "increasing t of shape", lambda: profiles.spline([0.0, 1.0, 1.0, 2.0], CORNERS)),
    (ShapeError, "t of shape", lambda: profiles.spline([0.0, 1.0], CORNERS)),
    (ShapeError, "finite limits", lambda: profiles.time_optimal(Q0, Q1, 1.0, np.inf, 1.0)),
    (ShapeError, "qd0 within qd_max", lambda: profiles.time_optimal(Q0, Q1, 1.0, 1.0, 1.0, qd0=[0, 2.0, 0])),
    (ShapeError, "q0 and q1 to differ", lambda: profiles.time_optimal(Q0, Q0, 1.0, 1.0, 1.0)),
]
WRONG = PRIMITIVES + DEMONSTRATIONS + POSE_RUNS + RHYTHMS_AND_DISTRIBUTIONS + OBSTACLES + CONTROL + PROFILES


def rhythm() -> PeriodicDmp:
    return fit_periodic_dmp(U, ROBOT.q_home + 0.1 * np.sin(2 * np.pi * U)[:, None] * np.ones(7), period=1.0).value


@pytest.mark.parametrize(("error", "words", "call"), WRONG, ids=[words for _, words, _ in WRONG])
def test_words_of_refusals(error: type[ArmlabError], words: str, call: Callable[[], Any]) -> None:
    with pytest.raises(error, match=rf"(?s)^Expected .*{words}.*\.$|^Unknown .*{words}"):
        call()
