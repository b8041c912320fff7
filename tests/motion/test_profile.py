"""Every profile against its laws: derivatives, joints, samples, rest at the ends, limits."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion.profiles import (
    PERIOD,
    Profile,
    blend,
    connect,
    minimum_jerk,
    quintic,
    spline,
    time_optimal,
    trapezoidal,
)

Q0, Q1 = np.array([0.1, -0.4, 1.0]), np.array([1.3, 0.2, 1.0])
CORNERS = np.array([[0.5, -0.5], [0.5, 0.0], [1.5, 0.0], [1.5, -0.5]])


def optimal(*args: object, **kwargs: object) -> Profile:
    pytest.importorskip("ruckig", reason="ruckig is not installed (extra motion)")
    return time_optimal(*args, **kwargs)  # type: ignore[arg-type]


MAKERS = {
    "minimum_jerk": lambda: minimum_jerk(Q0, Q1, 1.7),
    "quintic": lambda: quintic(Q0, Q1, 1.7, qd0=[0.2, 0, -1], qd1=0.3, qdd0=1.0, qdd1=[-1, 0, 2]),
    "trapezoidal": lambda: trapezoidal(Q0, Q1, 1.0, 2.0),
    "triangle": lambda: trapezoidal(Q0, Q1, 10.0, 2.0),
    "blend": lambda: blend(Q0, Q1, 1.7),
    "connect": lambda: connect(CORNERS, [1.0, 2.0, 0.5]),
    "spline": lambda: spline([3.0, 4.0, 4.5, 6.0], CORNERS, qd1=0.1),
    "time_optimal": lambda: optimal(Q0, Q1, 1.0, 2.0, 10.0),
}
EVERY = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


@EVERY
class TestLaws:
    def test_velocity_and_acceleration_are_derivatives(self, make) -> None:
        profile = make()
        inner = np.setdiff1d(np.linspace(0.013, profile.duration - 0.013, 400), profile.breaks)
        inner = inner[np.abs(inner[:, None] - profile.breaks).min(axis=1) > 1e-3]
        h = 1e-5
        (before, slow, _), (q, qd, qdd), (after, fast, _) = (profile.at(inner + s) for s in (-h, 0, h))
        np.testing.assert_allclose((after - before) / (2 * h), qd, atol=1e-7)
        np.testing.assert_allclose((fast - slow) / (2 * h), qdd, atol=1e-6)
        np.testing.assert_allclose((after + before) / 2, q, atol=1e-8)

    def test_position_and_velocity_do_not_jump(self, make) -> None:
        profile = make()
        at, eps = profile.breaks[1:-1], 1e-12
        for left, right in zip(profile.at(at - eps)[:2], profile.at(at + eps)[:2]):
            np.testing.assert_allclose(left, right, atol=1e-10)

    def test_samples_are_those_of_the_clock_and_end_at_the_end(self, make) -> None:
        profile = make()
        np.testing.assert_allclose(profile.t[:-1], 0.004 * np.arange(len(profile.t) - 1), rtol=0, atol=1e-12)
        assert profile.t[-1] == profile.duration
        assert 0 < profile.t[-1] - profile.t[-2] <= 0.004 * (1 + 1e-9)
        for own, asked in zip((profile.q, profile.qd, profile.qdd), profile.at(profile.t)):
            np.testing.assert_array_equal(own, asked)

    def test_it_is_frozen(self, make) -> None:
        profile = make()
        for values in (profile.t, profile.q, profile.qd, profile.qdd, profile.breaks, profile.coefficients):
            assert not values.flags.writeable

    def test_it_rests_before_and_after(self, make) -> None:
        profile = make()
        q, qd, qdd = profile.at([[-1.0], [profile.duration + 1.0]])
        np.testing.assert_array_equal(q[:, 0], profile.q[[0, -1]])
        assert q.shape == (2, 1, profile.q.shape[1])
        assert not qd.any()
        assert not qdd.any()

    def test_peaks_are_those_of_dense_samples(self, make) -> None:
        profile = make()
        dense = np.linspace(0, profile.duration, 20001)
        for peak, values in zip((profile.qd_peak, profile.qdd_peak), profile.at(dense)[1:]):
            most = np.abs(values).max(axis=0)
            assert (most <= peak * (1 + 1e-12) + 1e-12).all()
            np.testing.assert_allclose(most, peak, rtol=1e-3, atol=1e-9)

    def test_slowed_touches_a_limit_on_the_same_path(self, make) -> None:
        profile = make()
        slow = profile.slowed(0.2, [0.3] * profile.q.shape[1])
        touch = max((slow.qd_peak / 0.2).max(), (slow.qdd_peak / 0.3).max())
        assert abs(touch - 1.0) < 1e-9
        k = slow.duration / profile.duration
        assert k > 1
        t = np.linspace(0, profile.duration, 50)
        np.testing.assert_allclose(slow.at(k * t)[0], profile.at(t)[0], rtol=0, atol=1e-12)
        same = profile.slowed(1e3, 1e3)
        assert same.duration == profile.duration

    def test_a_period_of_the_user(self, make) -> None:
        profile = make()
        coarse = Profile(profile.breaks, profile.coefficients, dt=0.1)
        assert coarse.t[1] == 0.1


def test_the_period_is_that_of_the_control_loop() -> None:
    assert PERIOD == 0.004
    assert minimum_jerk(Q0, Q1, 1.0).dt == PERIOD


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Profile(np.array([0.0, 1.0]), np.zeros((2, 6, 1))), "breaks"),
        (lambda: Profile(np.array([0.0, 1.0]), np.zeros((1, 6, 1)), dt=0.0), "dt .* above zero"),
        (lambda: minimum_jerk(Q0, Q1, 1.0).slowed(qd_max=0.0), "qd_max above zero"),
    ],
)
def test_bad_input_is_refused_by_a_sentence(call, words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        call()
