"""Signals: streaming operators, zero-phase filters and derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.signals import central_diff, decimate, filtfilt, lowpass_offline, smooth_diff
from armlab.signals.streaming import CausalDiff, Differentiator, ExpFilter, Integrator, LowPass2, Notch, Operator

DT = 0.004
MAKERS: dict[str, Callable[[], Operator]] = {
    "trapezoid": lambda: Integrator(DT, 1.0),
    "euler": lambda: Integrator(DT, 1.0, rule="euler"),
    "difference": lambda: Differentiator(DT),
    "exponential": lambda: ExpFilter(0.1, DT),
    "lowpass": lambda: LowPass2(10.0, DT),
    "slope": lambda: CausalDiff(10.0, DT),
    "notch": lambda: Notch(30.0, 2.0, DT),
}
every = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


@every
@pytest.mark.parametrize(("shape", "stamped"), [((), True), ((7,), False), ((2, 3), True)])
def test_run_is_the_loop_of_step_bit_for_bit(make, shape: tuple[int, ...], stamped: bool) -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((50, *shape))
    x[7] = np.nan
    t = np.cumsum(rng.uniform(0.5, 1.5, 50)) * DT if stamped else None
    looped, whole = make(), make()
    stepped = [looped.step(x[k], None if t is None else t[k]) for k in range(50)]
    np.testing.assert_array_equal(np.array(stepped), whole.run(x, t))
    assert isinstance(stepped[0], float) == (shape == ())
    assert (looped.gaps, looped.skipped) == (whole.gaps, whole.skipped)
    assert looped.skipped == 1


@every
def test_reset_forgets_everything(make) -> None:
    x = np.random.default_rng(0).standard_normal((20, 3))
    operator = make()
    first = operator.run(x)
    operator.step(np.full(3, np.nan))
    operator.reset()
    np.testing.assert_array_equal(operator.run(x), first)
    assert operator.skipped == 0
    operator.reset()
    operator.step(np.zeros(5))  # another signal


@every
def test_a_sample_that_is_not_finite_leaves_the_memory(make) -> None:
    x = np.random.default_rng(0).standard_normal((20, 2))
    t = np.arange(20) * DT
    broken = x.copy()
    broken[11, 1] = np.inf
    kept = np.arange(20) != 11
    without = make().run(x[kept], t[kept])
    for stamps in (t, None):
        out = make().run(broken, stamps)
        assert np.isnan(out[11]).all()
        np.testing.assert_allclose(out[kept], without, rtol=1e-10, atol=1e-12)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
@settings(max_examples=50)
def test_euler_integral_of_the_derivative_gives_the_signal_back(values: list[float]) -> None:
    x = np.array(values)
    derivative = Differentiator(DT, init=x[0]).run(x)
    np.testing.assert_allclose(Integrator(DT, 0.0, rule="euler").run(derivative), x - x[0], atol=1e-9)


def test_exponential_step_response_and_alpha() -> None:
    """y_k = 1 - alpha^(k+1) from init 0; the time constant is exact, not 1 / (250 (1 - alpha))."""
    filter_ = ExpFilter.from_alpha(0.99, DT, init=0.0)
    k = np.arange(200)
    np.testing.assert_allclose(filter_.run(np.ones(200)), 1.0 - 0.99 ** (k + 1), rtol=1e-12)
    assert ExpFilter.from_alpha(0.99, DT).run(np.array([5.0, 5.0])).tolist() == [5.0, 5.0]
    exact = ExpFilter(-DT / np.log(0.99), DT, init=0.0).run(np.ones(200))
    np.testing.assert_allclose(filter_.settling / 12.0, 0.39799, rtol=1e-4)
    filter_.reset()
    np.testing.assert_array_equal(filter_.run(np.ones(200)), exact)


def gain_of(operator: Operator, frequency: float) -> float:
    t = np.arange(20_000) * 1e-3
    y = operator.run(np.sin(2 * np.pi * frequency * t), t)[10_000:]
    return float(np.sqrt(2 * np.mean(y**2)))


def test_gains_at_the_corner() -> None:
    assert gain_of(LowPass2(10.0), 10.0) == pytest.approx(np.sqrt(0.5), rel=1e-3)
    assert gain_of(LowPass2(10.0), 100.0) == pytest.approx(0.01, rel=0.05)
    assert gain_of(CausalDiff(50.0), 2.0) == pytest.approx(2 * np.pi * 2.0, rel=1e-3)
    assert gain_of(Notch(30.0), 30.0) < 1e-2
    assert gain_of(Notch(30.0), 3.0) == pytest.approx(1.0, rel=0.01)
    assert gain_of(Notch(30.0, quality=10.0), 30.0 * np.exp(0.05)) == pytest.approx(np.sqrt(0.5), rel=0.02)


@every
def test_gaps_in_time_stamps_are_counted_not_printed(make) -> None:
    t = np.array([0.0, 1.0, 2.0, 3.4, 6.0, 7.0]) * DT
    operator = make()
    operator.run(np.zeros(6), t)
    assert operator.gaps == 1
    assert operator.longest_gap == pytest.approx(2.6 * DT)
    free = LowPass2(1.0)  # without dt the first step counts as usual
    free.run(np.zeros(6), t)
    assert free.gaps == 1


def test_init_may_be_an_array_and_fixes_the_shape() -> None:
    assert Integrator(DT, np.array([1.0, 2.0])).step(np.zeros(2)).tolist() == [1.0, 2.0]
    with pytest.raises(ShapeError, match=r"of init, got \(3,\)"):
        Integrator(DT, np.array([1.0, 2.0])).step(np.zeros(3))
    operator = Integrator(DT)
    operator.reset(5.0)
    assert operator.step(0.0) == 5.0


def after(t: float | None = None, dt: float | None = None) -> LowPass2:
    """A filter that has already processed one sample."""
    operator = LowPass2(10.0, dt)
    operator.step(1.0, t)
    return operator


@pytest.mark.parametrize(("error", "words", "call"), [
    (ShapeError, "Pass t, as with the first sample, or dt", lambda: LowPass2(10.0).step(1.0)),
    (ShapeError, "Drop repeated samples", lambda: after(0.0).step(1.0, 0.0)),
    (ShapeError, "Drop repeated samples", lambda: after(0.0).step(1.0, -1.0)),
    (ShapeError, "in row 2", lambda: LowPass2(10.0).run(np.zeros(3), np.array([0.0, 1.0, 1.0]))),
    (ShapeError, "with every sample or with none", lambda: after(dt=DT).step(1.0, 0.5)),
    (ShapeError, "shape of the first one", lambda: after(dt=DT).step(np.zeros(2))),
    (ShapeError, "Use step for one sample", lambda: after(dt=DT).run(1.0)),
    (ShapeError, r"t of shape \(3,\)", lambda: after(dt=DT).run(np.zeros(3), np.zeros(2))),
    (ShapeError, "real numbers", lambda: after(dt=DT).step("fast")),
    (ShapeError, "finite init", lambda: Integrator(DT, np.nan)),
    (UnknownName, "rule of integration, got 'simpson'", lambda: Integrator(DT, rule="simpson")),
    (ConfigError, "step dt above 0", lambda: Integrator(0.0)),
    (ConfigError, "time constant above 0", lambda: ExpFilter(0.0)),
    (ConfigError, "alpha between 0 and 1", lambda: ExpFilter.from_alpha(1.0, DT)),
    (ConfigError, "between 0 and 125 Hz", lambda: LowPass2(200.0, DT)),
    (ConfigError, r"above 0\.5", lambda: Notch(30.0, 0.5)),
])  # fmt: skip
def test_bad_samples_and_settings_are_refused(error: type[Exception], words: str, call: Callable[[], object]) -> None:
    with pytest.raises(error, match=words):
        call()


T = np.arange(5000) / 250.0
MIDDLE = slice(1000, 4000)


def response(y: np.ndarray, frequency: float) -> tuple[float, float]:
    """Gain and phase shift [rad] of y relative to a sine of that frequency."""
    phasor = np.exp(-2j * np.pi * frequency * T[MIDDLE])
    ratio = np.sum(y[MIDDLE] * phasor) / np.sum(np.sin(2 * np.pi * frequency * T[MIDDLE]) * phasor)
    return abs(ratio), float(np.angle(ratio))


@pytest.mark.parametrize("stamped", [False, True])
def test_two_passes_square_the_gain_and_have_no_phase(stamped: bool) -> None:
    x = np.sin(2 * np.pi * 5.0 * T)
    gain, phase = response(lowpass_offline(x, 250.0, 5.0), 5.0)
    assert gain == pytest.approx(0.5, abs=1e-3)  # two passes of -3 dB each at the corner
    assert abs(phase) < 1e-3
    t = T if stamped else None
    gain, phase = response(filtfilt(LowPass2(5.0, 0.004), x, t), 5.0)
    assert gain == pytest.approx(0.5, abs=2e-3)
    assert abs(phase) < 1e-3
    gain, phase = response(filtfilt(ExpFilter(0.1, 0.004), x, t), 5.0)
    assert gain == pytest.approx(1 / (1 + (2 * np.pi * 5.0 * 0.1) ** 2), rel=0.01)
    assert abs(phase) < 1e-3
    assert response(filtfilt(Notch(5.0, 2.0, 0.004), x, t), 5.0)[0] < 0.01


def test_filtfilt_of_uneven_samples_keeps_straight_lines() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.002, 0.006, 800))
    x = np.stack([3.0 * t - 1.0, np.full(800, 2.0)], axis=1)
    np.testing.assert_allclose(filtfilt(LowPass2(8.0), x, t), x, atol=1e-4)


def test_filtfilt_is_the_same_backward_and_clears_the_operator() -> None:
    x = np.random.default_rng(0).standard_normal(1000)
    operator = LowPass2(10.0, 0.004)
    forward = filtfilt(operator, x)
    np.testing.assert_allclose(filtfilt(operator, x[::-1])[::-1], forward, atol=1e-4)
    assert operator.step(7.0) == 7.0  # the first sample again


def test_central_diff_is_exact_for_parabolas_on_uneven_stamps() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 50))
    x = np.stack([t**2, 3 * t], axis=1)
    np.testing.assert_allclose(central_diff(x, t), np.stack([2 * t, np.full(50, 3.0)], axis=1), rtol=1e-9)


@pytest.mark.parametrize("bandwidth", [2.0, 10.0, 40.0])
def test_smooth_diff_has_the_bandwidth_that_was_asked_for(bandwidth: float) -> None:
    x = np.sin(2 * np.pi * bandwidth * T)
    derivative = smooth_diff(x, T, bandwidth)
    gain = np.sqrt(2 * np.mean(derivative[MIDDLE] ** 2)) / (2 * np.pi * bandwidth)
    assert gain == pytest.approx(np.sqrt(0.5), abs=0.1 if bandwidth > 20 else 0.03)


def test_smooth_diff_passes_slow_motion_and_stops_noise() -> None:
    np.testing.assert_allclose(smooth_diff(T**3, T, 10.0), 3 * T**2, atol=1e-6)
    noise = np.random.default_rng(0).standard_normal((5000, 2))
    assert np.std(smooth_diff(noise, T, 5.0)) < 0.1 * np.std(central_diff(noise, T))


def test_decimate_keeps_what_is_slow_and_stops_what_would_alias() -> None:
    slow, fast = np.sin(2 * np.pi * 2.0 * T), np.sin(2 * np.pi * 27.0 * T)
    kept = decimate(np.stack([slow, fast], axis=1), 250.0, 5)
    assert kept.shape == (1000, 2)
    np.testing.assert_allclose(kept[200:800, 0], slow[::5][200:800], atol=1e-3)
    assert np.max(np.abs(kept[200:800, 1])) < 0.2
    np.testing.assert_array_equal(decimate(slow, 250.0, 1), slow)


BAD = np.where(np.arange(100)[:, None] == 7, np.nan, np.ones((100, 2)))
X, SHORT = np.ones(100), T[:100]
NAN_IN_7, NUMBER = r"NaN or Inf in 1 rows, first \[7\]", "got a single number"
INCREASING = "increasing times for 4 samples, got "


@pytest.mark.parametrize(("error", "words", "call"), [
    (ShapeError, "cut-off between 0 and 125 Hz", lambda: lowpass_offline(X, 250.0, 200.0)),
    (ShapeError, "at least 16 samples", lambda: lowpass_offline(X[:5], 250.0, 10.0)),
    (ShapeError, NAN_IN_7, lambda: lowpass_offline(BAD, 250.0, 10.0)),
    (ShapeError, NAN_IN_7, lambda: filtfilt(LowPass2(10.0, 0.004), BAD)),
    (ShapeError, NAN_IN_7, lambda: smooth_diff(BAD, SHORT, 10.0)),
    (ShapeError, NAN_IN_7, lambda: decimate(BAD, 250.0, 2)),
    (ShapeError, r"NaN or Inf in 100 rows", lambda: decimate(np.nan * X, 250.0, 1)),
    (ShapeError, INCREASING + r"1 s in row 2 after 1 s\. Drop", lambda: central_diff(X[:4], [0.0, 1.0, 1.0, 2.0])),
    (ShapeError, INCREASING + "1 s in row 2 after 3 s", lambda: central_diff(X[:4], [0.0, 3.0, 1.0, 2.0])),
    (ShapeError, INCREASING + r"nan in row 2\. Drop", lambda: central_diff(X[:4], [0.0, 1.0, np.nan, 2.0])),
    (ShapeError, INCREASING + r"an array of shape \(3,\)\. Pass", lambda: central_diff(X[:4], [0.0, 1.0, 2.0])),
    (ShapeError, "finite, strictly increasing", lambda: central_diff(X, np.append(SHORT[:-1], np.inf))),
    (ShapeError, r"steps from 0\.5 s to 2 s", lambda: smooth_diff(X[:6], np.array([0.0, 1, 2, 4, 4.5, 5]), 0.1)),
    (ShapeError, r"1e-05 and 0\.3 of the sampling rate, got 0\.4", lambda: smooth_diff(0 * T, T, 100.0)),
    (ShapeError, r"1e-05 and 0\.3", lambda: smooth_diff(X, SHORT, 1e-9)),
    (ShapeError, "at least 313 samples for a bandwidth of 1 Hz, got 100", lambda: smooth_diff(X, SHORT, 1.0)),
    (ShapeError, "at least 2 samples", lambda: filtfilt(LowPass2(1.0, 0.1), X[:1])),
    (ConfigError, "got Differentiator", lambda: filtfilt(Differentiator(0.004), X)),
    *((ConfigError, "integer order >= 1", lambda wrong=wrong: lowpass_offline(X, 250.0, 10.0, order=wrong))
      for wrong in (0, 2.5, np.nan)),
    (ConfigError, "integer factor >= 1", lambda: decimate(X, 250.0, 2.5)),
    (ConfigError, "integer factor >= 1", lambda: decimate(X, 1.0, 0)),
    *((ShapeError, NUMBER, call) for call in (
        lambda: lowpass_offline(3.0, 250.0, 10.0), lambda: central_diff(3.0, SHORT), lambda: decimate(3.0, 250.0, 2),
        lambda: smooth_diff(3.0, SHORT, 5.0), lambda: filtfilt(ExpFilter(0.1, 0.004), 3.0))),
])  # fmt: skip
def test_bad_input_is_refused_with_a_sentence(error: type[Exception], words: str, call: Callable[[], object]) -> None:
    with pytest.raises(error, match=words):
        call()
