"""Laws of `limit_reference`, and its oracle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import kernels
from armlab.errors import ShapeError

from .. import oracles

T = 0.004
SLACK = 1e-7


def bounds(n: int, reach: float = 1.0, speed: float = 1.0, acceleration: float = 10.0) -> np.ndarray:
    return np.stack([np.full(n, x) for x in (-reach, reach, speed, acceleration, 0.1)])


def test_a_reference_that_can_be_followed_is_followed_exactly() -> None:
    sent, asked = np.zeros((3, 2)), None
    for k in range(500):
        q = np.array([0.3, -0.2]) * (1.0 - np.cos(0.8 * T * k))
        sent, clamped, ratio, refused = kernels.limit_reference(sent, bounds(2), T, q, asked)
        asked = q
        np.testing.assert_array_equal(sent[0], q)
        assert (clamped.any(), ratio, refused) == (False, 1.0, 0)


def test_velocity_ratio_keeps_the_direction() -> None:
    limits = bounds(2, reach=np.inf, acceleration=1e6)
    sent, clamped, ratio, _ = kernels.limit_reference(np.zeros((3, 2)), limits, T, None, None, np.array([4.0, 1.0]))
    np.testing.assert_allclose(sent[1], [1.0, 0.25])
    np.testing.assert_allclose(sent[0], [T, 0.25 * T])
    assert (clamped.tolist(), ratio) == ([2, 0], 0.25)


def test_hold_is_a_ramp_then_rest() -> None:
    sent = np.array([[0.0], [0.1], [0.1]])
    speeds = []
    for _ in range(4):
        sent, clamped, *_ = kernels.limit_reference(sent, bounds(1), T)
        speeds.append(sent[2, 0])
    np.testing.assert_allclose(speeds, [0.06, 0.02, 0.0, 0.0], rtol=0.0, atol=1e-12)
    assert not clamped.any()


def test_catching_up_does_not_overshoot() -> None:
    sent, asked, target = np.zeros((3, 1)), None, np.array([0.09])
    path = []
    for _ in range(100):
        sent, *_ = kernels.limit_reference(sent, bounds(1), T, target, asked)
        asked = target
        path.append(sent[0, 0])
    assert max(path) <= 0.09 + 1e-12
    assert path[-1] == 0.09
    assert np.all(np.diff(path) >= 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_arm_brakes_before_either_end(sign: float) -> None:
    """At 1 rad/s and 10 rad/s2 over 0.5 rad: the acceleration limit acts, then no limit, then braking, then rest."""
    sent, acted, forward = np.zeros((3, 1)), [], np.array([sign])
    for _ in range(300):
        before = sent
        sent, clamped, *_ = kernels.limit_reference(sent, bounds(1, reach=0.5), T, None, None, forward)
        assert abs(sent[1, 0] - before[1, 0]) <= 10.0 * T + 1e-9
        acted.append(int(clamped[0]))
    changes = [one for k, one in enumerate(acted) if k == 0 or one != acted[k - 1]]
    assert changes == [4, 0, 8, 12], "from rest the speed asked for is too far as well"
    assert sent[0, 0] == pytest.approx(0.5 * sign, abs=1e-12)


@pytest.mark.parametrize(("behind", "nearer"), [(4.0, 2.0), (1.5, 1.0), (7.5, 3.0)])
def test_catching_up_with_a_reference_that_moves(behind: float, nearer: float) -> None:
    """By hand, in units of a T^2 and a T: 2 + 2^2 / 2 = 4, 1 + 1^2 / 2 = 1.5; the speed of the reference is added."""
    asked, step = np.array([0.2]), 10.0 * T
    sent = np.stack((asked - behind * step * T, *np.full((2, 1), 0.1 + nearer * step)))
    moved, clamped, *_ = kernels.limit_reference(sent, bounds(1), T, asked + 0.1 * T, asked)
    np.testing.assert_allclose(moved[1:, 0], 0.1 + nearer * step)
    assert not clamped.any()


def test_speeds_are_scaled_by_the_limit_of_each_joint() -> None:
    limits = bounds(2, acceleration=1e6)
    limits[2] = [2.0, 0.5]
    sent, clamped, ratio, _ = kernels.limit_reference(np.zeros((3, 2)), limits, T, None, None, np.array([3.0, 1.0]))
    np.testing.assert_allclose(sent[1], [1.5, 0.5])
    assert (clamped.tolist(), ratio) == ([2, 2], 0.5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_is_just_within_the_limits_is_sent_as_it_is(sign: float) -> None:
    """Values within the limits are never clamped; a relative tolerance of 1e-9 lets only tiny excesses pass."""
    step = 10.0 * T
    for wanted, last, bits in (
        (step, 0.0, 0), (step - 2e-11, 0.0, 0), (step + 1e-9, 0.0, 4), (1.0 - 5e-10, 1.0, 0)
    ):  # fmt: skip
        start, speed = sign * np.array([[0.0], [last], [last]]), sign * np.array([wanted])
        sent, clamped, ratio, _ = kernels.limit_reference(start, bounds(1), T, None, None, speed)
        assert (clamped[0], ratio) == (bits, 1.0)
        np.testing.assert_array_equal(sent[1], sign * step if bits else speed)
    end = sign * np.array([[0.95], [1.0], [1.0]])
    assert not kernels.limit_reference(end, bounds(1), T, sign * np.ones(1))[1][0] & 1, "the end itself is within"


def test_without_a_limit_on_acceleration_an_arm_stops_at_its_end() -> None:
    limits, forward = bounds(1, acceleration=np.inf), np.ones(1)
    sent, clamped, *_ = kernels.limit_reference(np.array([[0.999], [0.0], [0.0]]), limits, T, None, None, forward)
    np.testing.assert_allclose(sent[:2, 0], [1.0, 0.001 / T])
    assert clamped[0] == 8
    sent, clamped, *_ = kernels.limit_reference(sent, limits, T, None, None, forward)
    assert (sent[:, 0].tolist(), clamped[0]) == ([1.0, 0.0, 0.0], 8)


def test_results_are_read_only() -> None:
    sent, clamped, *_ = kernels.limit_reference(np.zeros((3, 2)), bounds(2), T)
    assert not sent.flags.writeable
    assert not clamped.flags.writeable


def test_the_longest_jump_is_allowed() -> None:
    limits, period = bounds(1), 2.0**-8
    limits[4] = 0.125
    for q, refused in ((0.125 + period, 0), (np.nextafter(0.125 + period, 1.0), -1)):
        assert kernels.limit_reference(np.zeros((3, 1)), limits, period, np.array([q]))[3] == refused


def test_a_position_reached_is_that_one_to_the_last_bit() -> None:
    for q in np.random.default_rng(3).uniform(-1.5e-4, 1.5e-4, (200, 1)):
        np.testing.assert_array_equal(kernels.limit_reference(np.zeros((3, 1)), bounds(1), T, q)[0][0], q)
    limits = bounds(1, reach=np.inf, speed=10.0, acceleration=1.0)
    farthest = np.array([0.25])  # one step of acceleration from rest: a T^2, without rounding
    sent, *_ = kernels.limit_reference(np.zeros((3, 1)), limits, 0.5, farthest, farthest)
    assert sent[:, 0].tolist() == [0.25, 0.5, 0.5]


def test_a_speed_within_the_limits_is_sent_to_the_last_bit() -> None:
    for speed in np.random.default_rng(4).uniform(-0.04, 0.04, (200, 1)):
        sent, *_ = kernels.limit_reference(np.array([[0.7], [0.0], [0.0]]), bounds(1), T, None, None, speed)
        np.testing.assert_array_equal(sent[1:, 0], speed[0])


def test_the_speed_given_beside_a_position_is_sent_within_its_own_limits() -> None:
    sent, clamped, ratio, _ = kernels.limit_reference(
        np.zeros((3, 2)), bounds(2), T, np.zeros(2), np.zeros(2), np.array([0.03, -0.5])
    )
    np.testing.assert_allclose(sent, [[0.0, 0.0], [0.0, 0.0], [0.03, -0.04]], rtol=0.0, atol=1e-15)
    assert (clamped.tolist(), ratio) == ([0, 0], 1.0)


@pytest.mark.parametrize("lag", [0.0, 0.05, 0.2])
def test_from_the_speed_allowed_the_arm_can_stop_whatever_the_next_steps_last(lag: float) -> None:
    """Full speed towards a limit with steps of 1 to 48 ms: the deceleration is never above the limit."""
    rng, sent = np.random.default_rng(2), np.array([[-0.9], [1.0], [1.0]])
    for _ in range(2000):
        dt, before = float(rng.choice([0.001, 0.004, 0.024, 0.048])), sent
        sent, *_ = kernels.limit_reference(sent, bounds(1), dt, None, None, np.ones(1), lag)
        assert before[1, 0] - sent[1, 0] <= 10.0 * dt * (1 + 1e-9)
        assert sent[0, 0] + lag * sent[1, 0] + sent[1, 0] ** 2 / 20.0 <= 1.0 + 1e-12
    assert sent[0, 0] > 0.999


@pytest.mark.parametrize(
    ("arguments", "refused"),
    [
        (([np.nan, 0.0], None, None), 1),
        (([0.0, np.inf], None, None), 2),
        (([0.0, 0.0], None, [0.0, np.nan]), 2),
        ((None, None, [-np.inf, 0.0]), 1),
        (([0.0, -0.105], None, None), -2),
        (([0.0, 0.103], None, None), 0),
    ],
)
def test_refusals_hold(arguments: tuple[list[float] | None, ...], refused: int) -> None:
    moving = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.0]])
    arrays = [None if a is None else np.array(a) for a in arguments]
    sent, _, _, found = kernels.limit_reference(moving, bounds(2), T, *arrays)
    assert found == refused
    if refused:
        np.testing.assert_array_equal(sent, kernels.limit_reference(moving, bounds(2), T)[0])
    assert np.isfinite(sent).all()


@st.composite
def commands(draw: st.DrawFn) -> list[tuple[np.ndarray | None, np.ndarray | None]]:
    """Anything a controller may return, in segments of several samples."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    found: list[tuple[np.ndarray | None, np.ndarray | None]] = []
    for kind in draw(
        st.lists(st.sampled_from(["still", "walk", "edge", "velocity", "both", "hold", "bad"]), min_size=1)
    ):
        centre = rng.uniform(-1.2, 1.2, 3)
        scale = 10.0 ** rng.uniform(-4, 0)
        for _ in range(draw(st.integers(1, 60))):
            noise = scale * rng.standard_normal(3)
            found.append(
                {
                    "still": (centre, None),
                    "walk": (noise, None),
                    "edge": (np.sign(centre) * 0.99, None),
                    "velocity": (None, 5.0 * centre),
                    "both": (0.05 * centre, 10.0 * noise),
                    "hold": (None, None),
                    "bad": (centre * np.nan, noise),
                }[kind]
            )
    return found


@given(commands())
@settings(max_examples=60)
def test_no_command_steps_above_the_limits(script: list[tuple[np.ndarray | None, np.ndarray | None]]) -> None:
    limits, sent, asked = bounds(3, reach=0.99), np.zeros((3, 3)), None
    a, fastest = 10.0, 1.0
    for q, qd in script:
        before = sent
        sent, _, ratio, refused = kernels.limit_reference(sent, limits, T, q, asked, qd)
        asked = None if refused else q
        assert np.isfinite(sent).all()
        assert np.abs(sent[0]).max() <= 0.99 + SLACK
        assert np.abs(sent[1:]).max() <= fastest + SLACK
        assert np.abs(sent[1:] - before[1:]).max() <= a * T + SLACK
        np.testing.assert_allclose(sent[0] - before[0], sent[1] * T, rtol=0.0, atol=SLACK)
        assert 0.0 < ratio <= 1.0


def test_an_arm_outside_its_limits_may_only_come_back() -> None:
    limits = bounds(1, reach=0.5)
    outside = np.array([[0.6], [0.0], [0.0]])
    away, clamped, *_ = kernels.limit_reference(outside, limits, T, np.array([0.65]))
    assert away[0, 0] == 0.6
    assert clamped[0] & 1
    back, *_ = kernels.limit_reference(outside, limits, T, np.array([0.55]))
    assert 0.599 < back[0, 0] < 0.6


def test_at_an_end_the_speed_sent_is_that_of_the_position_sent() -> None:
    """Within the rounding tolerance, a speed may lead beyond the limit; the position stops at it."""
    q = 1.0 - 1e-13
    sent, *_ = kernels.limit_reference(np.array([[q], [0.0], [0.0]]), bounds(1), T, None, None, np.array([6e-11]))
    assert sent[0, 0] == 1.0
    assert sent[1, 0] == (1.0 - q) / T


@given(st.integers(0, 2**32))
@settings(max_examples=200)
def test_native_is_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, period = int(rng.integers(1, 9)), 10.0 ** rng.uniform(-3, -1.5)
    sent = rng.uniform(-1.5, 1.5, (3, n))
    limits = np.abs(rng.normal(1.0, 0.5, (5, n))) * [[-1.2], [1.2], [1.0], [15.0], [0.3]] + 1e-3
    if rng.random() < 0.3:
        limits[[0, 1, 3], 0] = [-np.inf, np.inf, np.inf]
    q = sent[0] + rng.choice([1e-4, 1e-2, 0.2]) * rng.standard_normal(n)
    last = q + rng.choice([0.0, 1e-5, 1e-2]) * rng.standard_normal(n)
    qd = rng.choice([0.1, 1.0, 10.0]) * rng.standard_normal(n)
    if rng.random() < 0.1:
        qd[-1] = np.nan
    arguments = [x if rng.random() < 0.6 else None for x in (q, last, qd)]
    arguments.append(rng.choice([0.0, 0.05, 0.3]))
    ours = kernels.limit_reference(sent, limits, period, *arguments)
    wanted = oracles.limit_reference(sent, limits, period, *arguments)
    np.testing.assert_allclose(ours[0], wanted[0], rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(ours[1], wanted[1])
    assert ours[1].dtype == wanted[1].dtype == np.uint8
    assert ours[2] == pytest.approx(wanted[2], abs=1e-15)
    assert ours[3] == wanted[3]


def test_the_kernel_checks_shapes() -> None:
    assert kernels.limit_reference(np.zeros((3, 64)), bounds(64), T)[3] == 0
    with pytest.raises(ShapeError, match=r"at most 64 joints.* got 65, 0\.004"):
        kernels.limit_reference(np.zeros((3, 65)), bounds(65), T)
    with pytest.raises(ShapeError, match="sent"):
        kernels.limit_reference(np.zeros((2, 3)), bounds(2), T)
    with pytest.raises(ShapeError, match="bounds"):
        kernels.limit_reference(np.zeros((3, 2)), np.zeros((4, 2)), T)
    with pytest.raises(ShapeError, match="q_ref"):
        kernels.limit_reference(np.zeros((3, 2)), bounds(2), T, np.zeros(3))
    with pytest.raises(ShapeError, match="positive period"):
        kernels.limit_reference(np.zeros((3, 2)), bounds(2), 0.0)


@given(st.integers(0, 2**32))
@settings(max_examples=200)
def test_feedback_is_judged_as_the_oracle_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 8))
    values = rng.standard_normal((6, n))
    q, before, reference, speed, fastest, allowed = values
    before = q + rng.choice([0.0, 0.03, 1.0]) * before
    reference = q + rng.choice([0.0, 0.2, 3.0]) * reference
    limits = np.abs(rng.normal(1.5, 0.5, (3, n))) * [[-1.0], [1.0], [0.5]]
    if n and rng.random() < 0.2:
        values[rng.integers(0, 6), -1] = np.nan
    margin, step, seconds, kept, lag = rng.uniform(0.0, [1.0, 0.05, 0.1, 1.0, 0.3])
    for last in (before, None):
        arguments = q, last, limits, margin, step, seconds
        assert kernels.implausible(*arguments) == oracles.implausible(*arguments)
    if not np.isnan(speed).any():  # speeds are ours
        arguments = q, reference, speed, np.abs(np.nan_to_num(fastest)), np.abs(allowed), kept, lag
        ours, wanted = kernels.following_error(*arguments), oracles.following_error(*arguments)
        np.testing.assert_array_equal(ours[0], wanted[0])
        assert ours[1:] == wanted[1:]
    velocity = kernels.filtered_velocity(q, before, speed, 0.004, 30.0)
    np.testing.assert_allclose(velocity, oracles.filtered_velocity(q, before, speed, 0.004, 30.0), rtol=1e-12)
    assert not velocity.flags.writeable


def test_the_edges_of_plausible_feedback() -> None:
    limits = np.array([[-1.0, -1.0], [1.0, 1.0], [2.0, 2.0]])
    for q, before, found in (
        ([1.25, 0.0], None, 0), ([0.0, -1.25], None, 0), ([1.5, 2.0], None, 2), ([1.5, 1.5], None, 1),
        ([-1.5, np.nan], None, 2), ([np.nan, np.nan], None, 1), ([0.0, 0.75], [0.0, 0.0], 0),
        ([0.75, 1.0], [0.0, 0.0], -2),
        ([1.0, -1.0], [0.0, 0.0], -1), ([1.5, 0.0], [0.0, 0.0], 1), ([0.0, 0.0], [0.0, np.nan], -2),
    ):  # fmt: skip
        last = None if before is None else np.array(before)
        assert kernels.implausible(np.array(q), last, limits, 0.25, 0.5, 0.125) == found
    for error, near in ((0.75, True), (1.0, False), (np.nan, False)):
        arguments = np.array([1.0, -2.0]), np.array([4.0, 1.0]), np.full(2, 0.25), 0.5, 0.25
        fastest, worst, is_near = kernels.following_error(np.zeros(2), np.array([-error, 0.0]), *arguments)
        assert (fastest.tolist(), worst, is_near) == ([2.0, 2.0], 0, near)
    with pytest.raises(ShapeError, match="bounds"):
        kernels.implausible(np.zeros(2), None, np.zeros((2, 2)), 0.1, 0.1, 0.1)
    with pytest.raises(ShapeError, match="speed"):
        kernels.following_error(np.zeros(2), np.zeros(2), np.zeros(3), np.zeros(2), np.zeros(2), 1.0, 0.1)
    with pytest.raises(ShapeError, match="velocity"):
        kernels.filtered_velocity(np.zeros(2), np.zeros(2), np.zeros(3), 0.004, 30.0)
