"""Streaming operators: the laws in formulas, step and run the same bits, jitter and gaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.signals import CausalDiff, Differentiator, ExpFilter, Integrator, LowPass2, Notch, Operator

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
@pytest.mark.parametrize("shape", [(), (7,), (2, 3)], ids=["number", "joints", "matrix"])
@pytest.mark.parametrize("stamped", [False, True])
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
    """What follows is as if the sample had never come, and its time belongs to the next step."""
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


def test_integrator_rules_and_first_steps() -> None:
    x = np.array([1.0, 3.0, 2.0])
    np.testing.assert_allclose(Integrator(0.5, 10.0).run(x), [10.0, 11.0, 12.25], rtol=1e-15)
    np.testing.assert_allclose(Integrator(0.5, 10.0, rule="euler").run(x), [10.5, 12.0, 13.0], rtol=1e-15)


def test_differentiator_first_steps() -> None:
    x = np.array([1.0, 3.0, 2.0])
    np.testing.assert_allclose(Differentiator(0.5).run(x), [0.0, 4.0, -2.0])
    np.testing.assert_allclose(Differentiator(0.5, init=0.0).run(x), [2.0, 4.0, -2.0])


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


def damped(t: np.ndarray, w: float, z: float) -> np.ndarray:
    turn = w * np.sqrt(1 - z * z)
    return 1 - np.exp(-z * w * t) * (np.cos(turn * t) + z * w / turn * np.sin(turn * t))


@pytest.mark.parametrize("jitter", [0.0, 0.4])
def test_oscillators_follow_their_formula_whatever_the_jitter(jitter: float) -> None:
    """Step response of the continuous filter at the true time stamps, to 1e-12."""
    rng = np.random.default_rng(0)
    t = np.concatenate([[0.0], np.cumsum(DT * (1 + jitter * rng.uniform(-1, 1, 200)))])
    w, ones = 2 * np.pi * 10.0, np.ones(201)
    exact = damped(t, w, np.sqrt(0.5))
    np.testing.assert_allclose(LowPass2(10.0, init=0.0).run(ones, t), exact, atol=1e-12)
    turn = w * np.sqrt(0.5)
    slope = np.exp(-turn * t) * np.sin(turn * t) * w * w / turn
    np.testing.assert_allclose(CausalDiff(10.0, init=0.0).run(ones, t), slope, atol=1e-12 * w)


def test_exponential_filter_is_free_of_jitter() -> None:
    rng = np.random.default_rng(0)
    t = np.concatenate([[0.0], np.cumsum(DT * rng.uniform(0.5, 1.5, 200))])
    np.testing.assert_allclose(ExpFilter(0.1, init=0.0).run(np.ones(201), t), 1 - np.exp(-t / 0.1), atol=1e-12)


def gain(operator: Operator, frequency: float) -> float:
    t = np.arange(20_000) * 1e-3
    y = operator.run(np.sin(2 * np.pi * frequency * t), t)[10_000:]
    return float(np.sqrt(2 * np.mean(y**2)))


def test_gains_at_the_corner() -> None:
    assert gain(LowPass2(10.0), 10.0) == pytest.approx(np.sqrt(0.5), rel=1e-3)
    assert gain(LowPass2(10.0), 100.0) == pytest.approx(0.01, rel=0.05)
    assert gain(CausalDiff(50.0), 2.0) == pytest.approx(2 * np.pi * 2.0, rel=1e-3)
    assert gain(Notch(30.0), 30.0) < 1e-2
    assert gain(Notch(30.0), 3.0) == pytest.approx(1.0, rel=0.01)
    assert gain(Notch(30.0, quality=10.0), 30.0 * np.exp(0.05)) == pytest.approx(np.sqrt(0.5), rel=0.02)


def test_causal_diff_is_exact_for_straight_lines_after_settling() -> None:
    t = np.arange(1000) * DT
    assert CausalDiff(10.0, DT).run(3.0 * t)[-1] == pytest.approx(3.0, rel=1e-12)


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


@every
def test_states_are_given_back_as_fresh_arrays(make) -> None:
    operator, x = make(), np.ones(3)
    first = operator.step(x)
    kept = np.array(first)
    operator.step(2 * x)
    np.testing.assert_array_equal(first, kept)
    assert x.tolist() == [1.0] * 3


def test_init_may_be_an_array_and_fixes_the_shape() -> None:
    assert Integrator(DT, np.array([1.0, 2.0])).step(np.zeros(2)).tolist() == [1.0, 2.0]
    with pytest.raises(ShapeError, match=r"of init, got \(3,\)"):
        Integrator(DT, np.array([1.0, 2.0])).step(np.zeros(3))
    operator = Integrator(DT)
    operator.reset(5.0)
    assert operator.step(0.0) == 5.0


def test_bad_input_is_refused() -> None:
    operator = LowPass2(10.0)
    with pytest.raises(ShapeError, match="Give t, as with the first sample, or dt"):
        operator.step(1.0)
    operator.step(1.0, 0.0)
    for t in (0.0, -1.0):
        with pytest.raises(ShapeError, match="Drop repeated samples"):
            operator.step(1.0, t)
    with pytest.raises(ShapeError, match="in row 2"):
        LowPass2(10.0).run(np.zeros(3), np.array([0.0, 1.0, 1.0]))
    unstamped = LowPass2(10.0, DT)
    unstamped.step(1.0)
    with pytest.raises(ShapeError, match="with every sample or with none"):
        unstamped.step(1.0, 0.5)
    with pytest.raises(ShapeError, match="shape of the first one"):
        unstamped.step(np.zeros(2))
    with pytest.raises(ShapeError, match="Use step for one sample"):
        unstamped.run(1.0)
    with pytest.raises(ShapeError, match=r"t of shape \(3,\)"):
        unstamped.run(np.zeros(3), np.zeros(2))
    with pytest.raises(ShapeError, match="real numbers"):
        unstamped.step("fast")
    with pytest.raises(ShapeError, match="finite init"):
        Integrator(DT, np.nan)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(UnknownName, match="rule of integration, got 'simpson'"):
        Integrator(DT, rule="simpson")
    with pytest.raises(ConfigError, match="step dt above 0"):
        Integrator(0.0)
    with pytest.raises(ConfigError, match="time constant above 0"):
        ExpFilter(0.0)
    with pytest.raises(ConfigError, match="alpha between 0 and 1"):
        ExpFilter.from_alpha(1.0, DT)
    with pytest.raises(ConfigError, match="between 0 and 125 Hz"):
        LowPass2(200.0, DT)
    with pytest.raises(ConfigError, match=r"above 0\.5"):
        Notch(30.0, 0.5)
