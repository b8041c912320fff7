"""Movement primitives, including orientations, and their control: against oracles and closed forms; refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from armlab import kernels, robots
from armlab.errors import ShapeError
from armlab.lie import quaternion, so3
from armlab.motion.primitive.equation import placed

from .. import oracles
from ..oracles.primitive import PHASES


def arguments(phase: str, m: int, n: int, alpha: float, damping: float, seed: int) -> tuple[Any, ...]:
    rng = np.random.default_rng(seed)
    centres, widths = placed("time" if phase == "periodic" else phase, "time", m, 3.0, 0.8)
    return centres, widths, rng.normal(size=(m, n)), alpha, alpha**2 * damping, 1.0, 0.4, phase


def assert_close(ours: Any, wanted: Any) -> None:
    for a, b in zip(ours, wanted, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(b).max(initial=0.0)))


cases = st.fixed_dictionaries(
    {
        "phase": st.sampled_from(PHASES),
        "m": st.integers(3, 60),
        "n": st.integers(1, 8),
        "alpha": st.sampled_from([0.3, 4.0, 25.0, 100.0]),
        "damping": st.sampled_from([0.01, 0.25 * (1 - 1e-9), 0.25, 0.25 * (1 + 1e-9), 3.0]),
        "seed": st.integers(0, 999),
    }
)


@given(cases, st.sampled_from([None, 1, 3, 17]), st.booleans(), st.sampled_from([1e-3, 0.05, 1.0]))
@settings(max_examples=30)
def test_rollout_is_the_reference(case: dict[str, Any], K: int | None, own: bool, longest: float) -> None:
    ours, wanted = kernels.Primitive(*arguments(**case)), oracles.Primitive(*arguments(**case))
    rng = np.random.default_rng(case["seed"])
    if case["phase"] == "position":
        longest, K = min(longest, 0.05 / case["alpha"]), K and min(K, 2)  # few steps: the reference is slow
    n, t = case["n"], np.cumsum(rng.uniform(0.1, 1.0, 6)) * longest
    parts = rng.normal(size=(4, *(() if K is None else (K,)), n))
    weights = rng.normal(size=(K or 1, case["m"], n)) if own else None
    assert_close(ours.rollout(t, 0.4, *parts, weights), wanted.rollout(t, 0.4, *parts, weights))
    if case["phase"] != "position":
        assert_close(ours.response(t, 0.4, 0.02), wanted.response(t, 0.4, 0.02))


@given(cases, st.sampled_from([0.0, 12.5]), st.booleans())
@settings(max_examples=20)
def test_stepper_is_the_reference(case: dict[str, Any], rate: float, brakes: bool) -> None:
    rng = np.random.default_rng(case["seed"])
    n, limit = case["n"], np.full(case["n"], 30.0) if brakes else None
    start = (*rng.normal(size=(4, n)), 0.4)
    goal, dt = rng.normal(size=(2, n)), rng.uniform(1e-4, 2e-3, 30)
    runs = []
    for module in (kernels, oracles):
        stepper = module.PrimitiveStepper(module.Primitive(*arguments(**case)), rate)
        stepper.start(*start)
        rows = [(*stepper.outputs(), stepper.forcing)]
        for k, h in enumerate(dt):
            if k == 10:
                stepper.change_goal(*goal, limit)
            if k == 20:
                stepper.change_tau(0.7)
            rows.append((*stepper.step(h), stepper.forcing))
        runs.append([*np.array(rows).swapaxes(0, 1), np.array([stepper.tau, stepper.elapsed])])
    assert_close(*runs)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("phase", PHASES)
def test_basis_and_forcing_are_the_reference(batch: tuple[int, ...], phase: str) -> None:
    args = arguments(phase, 12, 3, 25.0, 0.25, 1)
    x = np.random.default_rng(0).uniform(-1.0, 2.0, batch)
    own = np.broadcast_to(x[..., None], (*batch, 3)) if phase == "position" else x
    ours, wanted = kernels.Primitive(*args), oracles.Primitive(*args)
    for name, at in (("basis", x), ("forcing", own)):
        a, b = getattr(ours, name)(at), getattr(wanted, name)(at)
        assert_close([a], [b])
        out = np.empty_like(a)
        assert getattr(ours, name)(at, out=out) is out


@pytest.mark.parametrize("phase", PHASES)
def test_design_is_the_basis_in_a_corner_of_zeros(phase: str) -> None:
    args, rng = arguments(phase, 12, 3, 25.0, 0.25, 1), np.random.default_rng(2)
    x, factors = rng.uniform(-1.0, 2.0, 9), rng.normal(size=9)
    p = kernels.Primitive(*args)
    found = p.design(x, factors, 11, 14)
    assert found.shape == (14, 11)
    np.testing.assert_allclose(found[:12, :9], (p.basis(x) * factors[:, None]).T, rtol=1e-14, atol=1e-16)
    assert not found[12:].any()
    assert not found[:, 9:].any()
    for bad in ((x, factors[:8], 11, 14), (x, factors * np.nan, 11, 14), (x, factors, 8, 14), (x, factors, 11, 11)):
        with pytest.raises(ShapeError):
            p.design(*bad)


def test_kernels_are_exact_to_the_last_digits() -> None:
    """They use our own exponential; it is tested from 1 down to where kernels are dropped."""
    centres = np.array([0.0, 1.0])
    p = kernels.Primitive(centres, np.array([1.0, 0.11]), np.zeros((2, 1)), 25.0, 156.25, 1.0, 0.25, "canonical")
    x = np.linspace(0.0, 2.0, 2001)
    off = 0.5 * x**2 - 0.5 * ((x - 1.0) / 0.11) ** 2
    wanted = np.stack([1 / (1 + np.exp(off)), 1 / (1 + np.exp(-off))], axis=1)
    np.testing.assert_allclose(p.basis(x), np.where(wanted < 1e-17, 0.0, wanted), rtol=4e-15, atol=1e-17)


def test_batch_is_bit_for_bit_a_loop() -> None:
    p = kernels.Primitive(*arguments("canonical", 30, 3, 25.0, 0.25, 0))
    rng = np.random.default_rng(1)
    t, parts, weights = np.linspace(0, 1, 50), rng.normal(size=(4, 21, 3)), rng.normal(size=(21, 30, 3))
    together = p.rollout(t, 0.3, *parts)
    own = p.rollout(t, 0.3, *parts, weights)
    for k in range(21):
        for many, one in zip(together, p.rollout(t, 0.3, *parts[:, k])):
            np.testing.assert_array_equal(many[:, k] if many.ndim == 3 else many, one)
        for many, one in zip(own, p.rollout(t, 0.3, *parts[:, k : k + 1], weights[k : k + 1])):
            np.testing.assert_array_equal(many[:, k : k + 1] if many.ndim == 3 else many, one)


def test_bad_arguments_are_refused() -> None:
    good = arguments("canonical", 5, 2, 25.0, 0.25, 0)
    for i, bad in ((1, -good[1]), (2, good[2][:4]), (2, good[2] * np.nan), (3, 0.0), (5, np.nan), (7, "clock")):
        with pytest.raises(ShapeError):
            kernels.Primitive(*good[:i], bad, *good[i + 1 :])
    p, two = kernels.Primitive(*good), np.zeros(2)
    for t, tau, y0 in (([0, 0], 1.0, two), ([0, np.nan], 1.0, two), ([0, 1], 0.0, two), ([0, 1], 1.0, np.zeros(3))):
        with pytest.raises(ShapeError):
            p.rollout(np.array(t, dtype=float), tau, y0, two, two, two)
    with pytest.raises(ShapeError, match="weights"):
        p.rollout(np.array([0.0, 1.0]), 1.0, two, two, two, two, np.zeros((1, 4, 2)))
    position = kernels.Primitive(*good[:7], "position")
    with pytest.raises(ShapeError, match="not linear"):
        position.response(np.array([0.0, 1.0]), 1.0, 0.1)
    with pytest.raises(ShapeError, match="1e7"):
        position.rollout(np.array([0.0, 1e9]), 1.0, two, two, two, two)
    stepper = kernels.PrimitiveStepper(p)
    stepper.start(two, two, two, two, 1.0)
    for dt in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ShapeError):
            stepper.step(dt)
    with pytest.raises(ShapeError):
        stepper.change_goal(two, two, -two - 1)
    with pytest.raises(ShapeError):
        stepper.change_tau(0.0)


def primitive(module: Any, weights: Any, alpha: float = 25.0, stiffness: float = 156.25, pace: float = 1.0) -> Any:
    """One coordinate with three kernels and a phase of time."""
    centres, widths = np.linspace(0.0, 1.0, 3), np.full(3, 0.4)
    return module.Primitive(centres, widths, np.reshape(weights, (3, 1)), alpha, stiffness, 1.0, pace, "time")


SPRINGS = {  # damping and stiffness; near critical on both sides, for the cosh and cos series
    "critical": (25.0, 156.25),
    "nearly, above": (25.0, 156.25 - 1e-6),
    "nearly, below": (25.0, 156.25 + 1e-6),
    "overdamped": (25.0, 100.0),
    "underdamped": (25.0, 2000.0),
    "hardly damped": (1.0, 1e4),
}


@pytest.mark.parametrize("spring", SPRINGS)
def test_a_step_of_any_length_is_exact_for_a_quadratic_force(spring: str) -> None:
    alpha, stiffness = SPRINGS[spring]
    A = np.zeros((5, 5))  # of y - g, y', 1, s, s^2
    A[0, 1], A[3, 2], A[4, 3] = 1.0, 1.0, 2.0
    for r in (1e-3, 9e-3, 0.038, 0.041, 0.3, 0.9, 3.0):  # time constants: a step is long from 0.04 or 0.01 on
        p = primitive(kernels, [20.0, -35.0, 60.0], alpha, stiffness, 1.0 / r)  # the phase goes from 0 to 1 in it
        f0, fm, f1 = p.forcing(np.array([0.0, 0.5, 1.0]))[:, 0]
        A[1] = -stiffness, -alpha, f0, (4 * fm - 3 * f0 - f1) / r, 2 * (f0 - 2 * fm + f1) / r**2
        for y0, v0, g in ((0.0, 0.0, 0.0), (1.0, -2.0, 0.3)):
            y, yd, *_ = p.rollout(np.array([0.0, r]), 1.0, *(np.array([a]) for a in (y0, v0, g, 1.0)))
            wanted = expm(A * r) @ [y0 - g, v0, 1.0, 0.0, 0.0]
            np.testing.assert_allclose([y[1, 0] - g, yd[1, 0]], wanted[:2], rtol=1e-11, err_msg=f"r = {r}")


T = np.linspace(0.0, 1.3, 60)
Q0, GOAL = quaternion.from_matrix(so3.exp([0.2, -0.4, 0.9])), quaternion.from_matrix(so3.exp([-0.8, 0.6, 0.3]))
W0, MAP, TAU = np.array([0.4, -1.0, 0.2]), np.array([[0.5, -0.2, 0.1], [0.3, 1.5, 0.0], [0.0, 0.4, -0.7]]), 0.35


def turning(phase: str = "canonical", n: int = 3) -> Any:
    weights = 40.0 * np.random.default_rng(1).normal(size=(12, n))
    centres = np.linspace(0.05, 1.0, 12)
    return kernels.Primitive(centres, np.full(12, 0.06), weights, 25.0, 156.25, 1.0, 1 / 3, phase)


def test_a_goal_half_a_turn_away_breaks_nothing() -> None:
    half = quaternion.multiply(quaternion.from_matrix(so3.exp([0, 0, np.pi])), Q0)
    q, _, _ = kernels.rotation_rollout(turning(), T, TAU, Q0, 0 * W0, half, np.eye(3))
    assert np.isfinite(q).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": [0.0, 0.1, 0.1]}, "increasing times"),
        ({"t": []}, "at least one time"),
        ({"t": [0.0, np.nan]}, "finite t"),
        ({"t": [0.0, 1e9]}, "time constants"),
        ({"tau": 0.0}, "tau above zero"),
        ({"q0": np.zeros(4)}, "a unit quaternion wxyz as q0, got norm 0"),
        ({"goal": np.zeros(3)}, "goal of shape"),
        ({"w0": [0, np.inf, 0]}, "finite w0"),
        ({"map": np.eye(4)}, "map of shape"),
    ],
)
def test_refusals(change: dict, words: str) -> None:
    given = {"t": T, "tau": TAU, "q0": Q0, "w0": W0, "goal": GOAL, "map": MAP, **change}
    with pytest.raises(ShapeError, match=words):
        kernels.rotation_rollout(
            turning(),
            *(np.asarray(v, float) if k != "tau" else v for k, v in given.items()),
        )


def test_another_primitive_or_step_is_refused() -> None:
    for other in (
        turning(n=2),
        turning(phase="position"),
    ):
        with pytest.raises(ShapeError, match="three coordinates"):
            kernels.RotationStepper(other)
    with pytest.raises(ShapeError, match="dt above zero"):
        kernels.RotationStepper(turning()).step(0.0)


def test_order_is_four_where_a_force_turns_the_axis() -> None:
    """A soft spring, so that steps are long for the rotation; without ``theta x (theta x z) / 12`` the order is
    three."""
    weights = np.tile([30.0, -40.0, 20.0], (4, 1))
    p = kernels.Primitive(np.linspace(0.0, 1.0, 4), np.full(4, 0.3), weights, 1.0, 1.0, 1.0, 1.0, "canonical")
    start, goal = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.8, 0.0, 0.6, 0.0])
    ends = [
        kernels.rotation_rollout(p, np.linspace(0, 0.2, n + 1), 1.0, start, np.array([0.0, 8.0, 0.0]), goal, np.eye(3))
        for n in (20, 40, 240)
    ]
    coarse, better = (np.linalg.norm(q[-1] - ends[-1][0][-1]) for q, *_ in ends[:2])
    assert np.log2(coarse / better) > 3.7


SPEED = np.array([1.0, 0.7, -2.0])


def law_of(side: Any, phase: str, n: int, m: int, seed: int, change: dict[int, Any] | None = None) -> Any:
    """A control law of either module, with some arguments (by number, from tau = 0) changed."""
    draw = np.random.default_rng(seed)
    centres, weights = np.linspace(0.05, 1.0, m), 30 * draw.normal(size=(m, n))
    primitive = side.Primitive(centres, np.full(m, 0.08), weights, 25.0, 156.25, 1.0, 0.4, phase)
    zone, gains = np.where(np.arange(n) % 2, 0.01, 0.0), np.array([25.0, 10.0, 1e3, 5.0, 0.05])
    given = [0.5, *draw.normal(size=(3, n)), gains, zone, np.ones(n)]
    for i, value in (change or {}).items():
        given[i] = value
    return side.TwoDof(primitive, *given)


def state(n: int, seed: int, x: float, apart: float) -> np.ndarray:
    draw = np.random.default_rng(seed)
    yc = draw.normal(size=n)
    parts = (yc, draw.normal(size=n), 0.02 * draw.normal(size=n), yc + apart, draw.normal(size=n), [x, 0.0])
    return np.concatenate(parts)


@given(
    phase=st.sampled_from(PHASES),
    n=st.integers(1, 8),
    m=st.integers(1, 40),
    seed=st.integers(0, 99),
    x=st.sampled_from([0.0, 1e-6, 0.4, 1.0, 1.04, 3.0]),
    apart=st.sampled_from([0.0, 0.03, 0.06]),
    steps=st.integers(1, 3),
)
@settings(max_examples=60)
def test_both_give_the_same(phase, n, m, seed, x, apart, steps) -> None:
    start, driven = state(n, seed, x, apart), np.where(np.arange(n) % 2, np.nan, 0.1)
    ya, yad = start[:n] + 0.01, np.zeros(n)
    ways = []
    for side in (kernels, oracles):
        law = law_of(side, phase, n, m, seed)
        y = law.advance(start, 0.004, steps, driven, SPEED)
        then, found = law.follow(y, 0.004, steps, SPEED, ya, yad)
        passed, _ = law.follow(y, 0.004, steps, SPEED, np.full(n, np.nan), yad)
        ways.append((y, law.reference(y, SPEED), law.slopes(y, SPEED), then, found, passed, law.time_constant(y)))
    for native, reference in zip(*ways, strict=True):
        np.testing.assert_allclose(native, reference, rtol=1e-12, atol=1e-12 * (1 + np.abs(reference).max()))


def test_freezes_and_thaws() -> None:
    law = law_of(kernels, "canonical", 2, 9, 1)
    y, still = state(2, 1, 0.5, 0.06), np.zeros(2)
    y = law.advance(y, 0.004, 1, still, np.ones(3))
    assert y[-1] == 1
    y[6:8] = y[:2] + 0.045  # above 0.8 e_max
    assert law.advance(y, 0.004, 1, still, np.ones(3))[-1] == 1
    y[6:8] = y[:2] + 0.039
    assert law.advance(y, 0.004, 1, still, np.ones(3))[-1] == 0


def test_inputs_stay_and_may_be_read_only() -> None:
    law, y = law_of(kernels, "time", 3, 9, 1), state(3, 1, 0.5, 0.0)
    y.flags.writeable = False
    before = y.copy()
    law.follow(y, 0.004, 1, SPEED, y[:3], y[3:6])
    law.advance(y, 0.0, 1, y[:3], SPEED)
    np.testing.assert_array_equal(y, before)


@pytest.mark.parametrize(
    "change",
    [
        {0: 0.0},
        {1: np.zeros(5)},
        {2: np.full(2, np.nan)},
        {3: None},
        {4: np.array([25.0, 10.0, -1.0, 5.0, 1.0])},
        {4: np.array([25.0, 10.0, 1.0, 5.0, np.nan])},
        {5: np.full(2, -1.0)},
        {6: np.zeros(2)},
    ],
)
def test_wrong_parameters_of_the_law_are_refused(change: dict[int, Any]) -> None:
    with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
        law_of(kernels, "time", 2, 9, 0, change)


@pytest.mark.parametrize(
    "misuse",
    [
        lambda law, y: law.advance(y[1:], 0.1, 1, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, -0.1, 1, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, np.nan, 1, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, 0.1, 0, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, 0.1, 1, np.zeros(3), SPEED),
        lambda law, y: law.advance(y, 0.1, 1, np.zeros(2), np.zeros(2)),
        lambda law, y: law.follow(y, 0.1, 1, SPEED, np.zeros(3), np.zeros(2)),
        lambda law, y: law.follow(y, 0.1, 1, SPEED, np.zeros(2), None),
        lambda law, y: law.reference(None, SPEED),
        lambda law, y: law.slopes(y[1:], SPEED),
        lambda law, y: law.time_constant(y[:3]),
    ],
)
def test_wrong_calls_of_the_law_are_refused(misuse) -> None:
    with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
        misuse(law_of(kernels, "canonical", 2, 9, 0), state(2, 0, 1.0, 0.0))


ROBOT = robots.load("yumi_right")
SLIDING = np.zeros(7, dtype=bool)
SLIDING[2] = True


def test_bad_obstacles_are_refused() -> None:
    good = np.zeros((1, 10))
    chain = kernels.Chain(ROBOT.chain.frames, SLIDING)
    space = kernels.Obstacles(3, None, None, 0.02, 0.1)
    law = kernels.Primitive([0.5], [0.5], np.ones((1, 2)), 25.0, 156.25, 1.0, 0.4, "time")
    for words, call in {
        "0 <= clearance < reach": lambda m=kernels: m.Obstacles(3, None, None, 0.2, 0.1),
        "2 or 3 dimensions": lambda m=kernels: m.Obstacles(4, None, None, 0.0, 0.1),
        "links from 1 to 7": lambda m=kernels, c=chain: m.Obstacles(c, [8.0], good[:, :7], 0.0, 0.1),
        "radius >= 0": lambda f=space: f.place(good - 1.0),
        "finite capsules": lambda f=space: f.place(good * np.nan),
        "capsules of shape": lambda f=space: f.place(np.zeros((1, 7))),
        "finite y": lambda f=space: f.add(np.full(3, np.nan), good[0, :3], good[0, :3], good[0, :3]),
        "obstacles for 2 coordinates": lambda m=kernels, f=space, p=law: m.PrimitiveStepper(p, 0.0, f),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()


@pytest.mark.parametrize("kind", ["plane", "space", "arm"])
def test_a_distance_that_is_not_known_is_no_large_one(kind: str) -> None:
    arm = {"plane": 2, "space": 3, "arm": kernels.Chain(ROBOT.chain.frames, SLIDING)}[kind]
    bodies = (np.array([7.0]), np.full((1, 7), 0.02)) if kind == "arm" else (None, None)
    field = kernels.Obstacles(arm, *bodies, 0.02, 0.5)
    field.place(np.full((2, 10), 0.1) * ([1, 1, 0, 1, 1, 0, 1, 1, 1, 0] if kind == "plane" else 1))
    n = 7 if kind == "arm" else arm
    for i in range(n):
        y = np.where(np.arange(n) == i, np.nan, 0.3)
        assert np.isnan(field.distance(y)), i
