"""Profiles against their laws and closed forms, and ruckig's against its own evaluation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import MissingExtra, ShapeError
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
        assert profile.dt == PERIOD == 0.004
        np.testing.assert_allclose(profile.t[:-1], 0.004 * np.arange(len(profile.t) - 1), rtol=0, atol=1e-12)
        assert profile.t[-1] == profile.duration
        assert 0 < profile.t[-1] - profile.t[-2] <= 0.004 * (1 + 1e-9)
        for own, asked in zip((profile.q, profile.qd, profile.qdd), profile.at(profile.t)):
            np.testing.assert_array_equal(own, asked)
            assert not own.flags.writeable
        assert Profile(profile.breaks, profile.coefficients, dt=0.1).t[1] == 0.1

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


class TestReferenceNumbers:
    def test_blend_of_the_two_link_demo(self) -> None:
        profile = blend(0.0, 1.0, 100.0, dt=1.0)
        np.testing.assert_allclose(profile.q[[10, 33, 50, 90], 0], [0.0225, 0.245025, 0.5, 0.9775], rtol=0, atol=1e-15)
        np.testing.assert_allclose(profile.qd_peak, 0.015, rtol=1e-12)
        np.testing.assert_allclose(profile.qdd_peak, 4.5e-4, rtol=1e-12)
        np.testing.assert_allclose(profile.breaks[1], 100 / 3, rtol=1e-12)

    def test_connect_joins_all_segments_and_starts_on_the_first_point(self) -> None:
        profile = connect(CORNERS, 2.0)
        np.testing.assert_array_equal(profile.q[0], CORNERS[0])
        assert profile.t[0] == 0.0
        q, qd, _ = profile.at([2.0, 4.0, 6.0])
        np.testing.assert_allclose(q, CORNERS[1:], rtol=0, atol=1e-15)
        np.testing.assert_allclose(qd, 0.0, atol=1e-14)
        assert np.ptp(profile.at(np.linspace(0, 2, 30))[0][:, 0]) == 0.0  # straight from corner to corner

    def test_minimum_jerk(self) -> None:
        profile = minimum_jerk(Q0, Q1, 2.0)
        u = profile.t[:, None] / 2.0
        np.testing.assert_allclose(profile.q, Q0 + (Q1 - Q0) * (10 * u**3 - 15 * u**4 + 6 * u**5), atol=1e-14)
        np.testing.assert_allclose(profile.qd_peak, 15 / 8 * np.abs(Q1 - Q0) / 2.0, rtol=1e-12)
        np.testing.assert_allclose(profile.qdd_peak, 10 / np.sqrt(3) * np.abs(Q1 - Q0) / 4.0, rtol=1e-12)

    def test_quintic_meets_both_ends(self) -> None:
        ends = {"qd0": [0.2, 0, -1], "qd1": [1.0, 2.0, 3.0], "qdd0": [3.0, 1.0, 0.0], "qdd1": [-1.0, 0, 2]}
        profile = quintic(Q0, Q1, 0.7, **ends)
        wanted = [Q0, Q1, *ends.values()]
        found = [profile.q[0], profile.q[-1], profile.qd[0], profile.qd[-1], profile.qdd[0], profile.qdd[-1]]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)

    def test_spline_passes_its_points_with_continuous_acceleration(self) -> None:
        profile = spline([3.0, 4.0, 4.5, 6.0], CORNERS)
        q, _, left = profile.at(np.array([0, 1.0, 1.5, 3.0]) - 1e-9)
        right = profile.at(np.array([0, 1.0, 1.5, 3.0]) + 1e-9)[2]
        np.testing.assert_allclose(q, CORNERS, rtol=0, atol=1e-8)
        np.testing.assert_allclose(left[1:-1], right[1:-1], atol=1e-6)
        np.testing.assert_allclose(profile.qd[[0, -1]], 0.0, atol=1e-13)


numbers = st.floats(-3.0, 3.0)
limits = st.floats(0.05, 5.0)


@settings(max_examples=20)
@given(q0=st.tuples(numbers, numbers), q1=st.tuples(numbers, numbers), v=st.tuples(limits, limits), a=limits)
def test_a_trapezoid_reaches_a_limit_and_exceeds_none(q0, q1, v, a) -> None:
    if max(abs(x - y) for x, y in zip(q0, q1)) < 1e-6:
        return
    profile = trapezoidal(q0, q1, v, a)
    shares = np.concatenate([profile.qd_peak / v, profile.qdd_peak / a])
    assert shares.max() <= 1 + 1e-9
    assert (profile.qdd_peak / a).max() >= 1 - 1e-9
    np.testing.assert_allclose(profile.q[[0, -1]], [q0, q1], rtol=0, atol=1e-12)
    straight = (profile.q - q0)[:, 0] * (q1[1] - q0[1]) - (profile.q - q0)[:, 1] * (q1[0] - q0[0])
    assert np.abs(straight).max() < 1e-12


def test_a_trapezoid_takes_longer_when_asked() -> None:
    profile = trapezoidal(Q0, Q1, 1.0, 2.0)
    assert profile.duration == pytest.approx(1.2 / 1.0 + 1.0 / 2.0)
    longer = trapezoidal(Q0, Q1, 1.0, 2.0, duration=3.0)
    assert longer.duration == pytest.approx(3.0)
    np.testing.assert_allclose(longer.at(1.0)[0], profile.at(profile.duration / 3)[0], atol=1e-12)
    with pytest.raises(ShapeError, match=r"1\.7 s or more"):
        trapezoidal(Q0, Q1, 1.0, 2.0, duration=1.0)


class TestTimeOptimal:
    def test_it_is_ruckigs(self) -> None:
        ruckig = pytest.importorskip("ruckig", reason="ruckig is not installed (extra motion)")
        rng = np.random.default_rng(0)
        for _ in range(20):
            q0, q1, v0, v1 = rng.uniform(-1, 1, (4, 3))
            v, a, j = 1.0, rng.uniform(0.5, 3, 3), rng.uniform(2, 40, 3)
            profile = time_optimal(q0, q1, v, a, j, qd0=v0, qd1=v1)
            wanted, found = ruckig.InputParameter(3), ruckig.Trajectory(3)
            wanted.current_position, wanted.target_position = q0.tolist(), q1.tolist()
            wanted.current_velocity, wanted.target_velocity = v0.tolist(), v1.tolist()
            wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [v] * 3, a.tolist(), j.tolist()
            ruckig.Ruckig(3).calculate(wanted, found)
            assert profile.duration == found.duration
            for t in np.linspace(0, found.duration, 7)[:-1]:
                for own, theirs in zip(profile.at(t), found.at_time(t)):
                    np.testing.assert_allclose(own, theirs, rtol=0, atol=1e-9)
            assert (profile.qd_peak <= v * (1 + 1e-9)).all()
            assert (profile.qdd_peak <= a * (1 + 1e-9)).all()
            jerk = 6 * np.abs(profile.coefficients[:, 3]).max(axis=0)
            assert (jerk <= j * (1 + 1e-9)).all()
            np.testing.assert_allclose(profile.q[-1], q1, rtol=0, atol=1e-10)
            np.testing.assert_allclose(profile.qd[-1], v1, rtol=0, atol=1e-10)

    def test_a_long_motion_touches_all_limits(self) -> None:
        profile = optimal(0.0, 10.0, 1.0, 2.0, 10.0)
        assert profile.duration == pytest.approx(10.0 / 1.0 + 1.0 / 2.0 + 2.0 / 10.0)
        np.testing.assert_allclose([profile.qd_peak[0], profile.qdd_peak[0]], [1.0, 2.0], rtol=1e-12)

    def test_without_ruckig_it_says_how_to_get_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(__import__("sys").modules, "ruckig", None)
        with pytest.raises(MissingExtra, match=r"armlab\[motion\]"):
            time_optimal(0.0, 1.0, 1.0, 1.0, 1.0)
