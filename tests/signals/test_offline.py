"""Zero-phase filters and derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab import signals
from armlab.errors import ArmlabError, ConfigError, ShapeError
from armlab.signals import (
    Differentiator,
    ExpFilter,
    LowPass2,
    Notch,
    central_diff,
    decimate,
    filtfilt,
    lowpass_offline,
    smooth_diff,
)

T = np.arange(5000) / 250.0
MIDDLE = slice(1000, 4000)


def response(y: np.ndarray, frequency: float) -> tuple[float, float]:
    """Gain and phase shift [rad] of y over a sine of that frequency."""
    phasor = np.exp(-2j * np.pi * frequency * T[MIDDLE])
    ratio = np.sum(y[MIDDLE] * phasor) / np.sum(np.sin(2 * np.pi * frequency * T[MIDDLE]) * phasor)
    return abs(ratio), float(np.angle(ratio))


def test_lowpass_offline_has_no_phase_and_the_gain_of_two_passes() -> None:
    gain, phase = response(lowpass_offline(np.sin(2 * np.pi * 5.0 * T), 250.0, 5.0), 5.0)
    assert gain == pytest.approx(0.5, abs=1e-3)  # two passes of -3 dB each at the corner
    assert abs(phase) < 1e-3


@pytest.mark.parametrize("stamped", [False, True])
def test_filtfilt_squares_the_gain_and_has_no_phase(stamped: bool) -> None:
    x = np.sin(2 * np.pi * 5.0 * T)
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


def test_bad_input_is_refused_with_a_sentence() -> None:
    with pytest.raises(ShapeError, match="cut-off between 0 and 125 Hz"):
        lowpass_offline(np.zeros(100), 250.0, 200.0)
    with pytest.raises(ShapeError, match="at least 16 samples"):
        lowpass_offline(np.zeros(5), 250.0, 10.0)
    bad = np.where(np.arange(100)[:, None] == 7, np.nan, np.ones((100, 2)))
    for filtered in (
        lambda: lowpass_offline(bad, 250.0, 10.0),
        lambda: filtfilt(LowPass2(10.0, 0.004), bad),
        lambda: smooth_diff(bad, T[:100], 10.0),
        lambda: decimate(bad, 250.0, 2),
    ):
        with pytest.raises(ShapeError, match=r"NaN or Inf in 1 rows, first \[7\]"):
            filtered()
    for times, got in (
        ([0.0, 1.0, 1.0, 2.0], r"1 s in row 2 after 1 s\. Drop repeated"),
        ([0.0, 3.0, 1.0, 2.0], "1 s in row 2 after 3 s"),
        ([0.0, 1.0, np.nan, 2.0], r"nan in row 2\. Drop the rows without a time"),
        ([0.0, 1.0, 2.0], r"an array of shape \(3,\)\. Give one time for each sample"),
    ):
        with pytest.raises(ShapeError, match=f"strictly increasing times for 4 samples, got {got}"):
            central_diff(np.zeros(4), np.array(times))
    with pytest.raises(ShapeError, match=r"steps from 0\.5 s to 2 s"):
        smooth_diff(np.zeros(6), np.array([0.0, 1.0, 2.0, 4.0, 4.5, 5.0]), 0.1)
    with pytest.raises(ShapeError, match=r"between 1e-05 and 0\.3 of the sampling rate, got 0\.4"):
        smooth_diff(np.zeros(5000), T, 100.0)
    with pytest.raises(ShapeError, match="at least 313 samples for a bandwidth of 1 Hz, got 100"):
        smooth_diff(np.zeros(100), T[:100], 1.0)
    with pytest.raises(ConfigError, match="got Differentiator"):
        filtfilt(Differentiator(0.004), np.zeros(100))
    with pytest.raises(ShapeError, match="at least 2 samples"):
        filtfilt(LowPass2(1.0, 0.1), np.zeros(1))
    with pytest.raises(ShapeError, match=r"1e-05 and 0\.3"):
        smooth_diff(np.ones(100), 0.004 * np.arange(100), 1e-9)
    for wrong in (0, 2.5, np.nan):
        with pytest.raises(ConfigError, match="whole order of at least 1"):
            lowpass_offline(np.ones(100), 250.0, 10.0, order=wrong)
    with pytest.raises(ConfigError, match="whole factor of at least 1"):
        decimate(np.ones(100), 250.0, 2.5)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"NaN or Inf in 100 rows"):
        decimate(np.full(100, np.nan), 250.0, 1)
    t = 0.004 * np.arange(100)
    for function in (
        lambda x: lowpass_offline(x, 250.0, 10.0),
        lambda x: central_diff(x, t),
        lambda x: decimate(x, 250.0, 2),
        lambda x: smooth_diff(x, t, 5.0),
        lambda x: filtfilt(ExpFilter(0.1, 0.004), x),
    ):
        with pytest.raises(ShapeError, match="got a number"):
            function(3.0)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="finite, strictly increasing"):
        central_diff(t, np.append(t[:-1], np.inf))
    with pytest.raises(ConfigError, match="factor of at least 1"):
        decimate(np.zeros(10), 1.0, 0)


SAMPLES = np.sin(np.arange(100) / 10.0)
TIMES = np.arange(100) / 100.0
CALLS: dict[str, Callable] = {
    "samples": lambda x: signals.lowpass_offline(x, 100.0, 5.0),
    "rate": lambda x: signals.lowpass_offline(SAMPLES, x, 5.0),
    "cutoff": lambda x: signals.lowpass_offline(SAMPLES, 100.0, x),
    "order": lambda x: signals.lowpass_offline(SAMPLES, 100.0, 5.0, x),
    "factor": lambda x: signals.decimate(SAMPLES, 100.0, x),
    "times": lambda x: signals.central_diff(SAMPLES, x),
    "bandwidth": lambda x: signals.smooth_diff(SAMPLES, TIMES, x),
    "operator": lambda x: signals.filtfilt(x, SAMPLES, TIMES),
    "step": lambda x: signals.Integrator("x" if x is None else x),
    "corner": lambda x: signals.LowPass2(x, 0.01),
    "quality": lambda x: signals.Notch(10.0, x),
    "time constant": lambda x: signals.ExpFilter(x, 0.01),
}


@pytest.mark.parametrize("other", [None, "5", -1.0, np.nan, np.inf, [[1, 2], [3]], np.zeros((0, 2)), 1j], ids=repr)
@pytest.mark.parametrize("what", CALLS)
def test_something_else_gets_a_sentence(what: str, other: object) -> None:
    with pytest.raises(ArmlabError, match=r"^Expected .*\.$"):
        CALLS[what](other)
