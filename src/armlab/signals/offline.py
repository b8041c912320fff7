"""Zero-phase filters and derivatives of recorded signals, which use future samples."""

from __future__ import annotations

import numpy as np

from armlab._numbers import number, numbers
from armlab.errors import ConfigError, ShapeError
from armlab.signals.streaming import Operator

__all__ = ["central_diff", "decimate", "filtfilt", "lowpass_offline", "smooth_diff"]

UNEVEN = 0.1  # largest relative deviation of a time step in an evenly sampled record
PASSED = 0.8  # ratio of the decimation cut-off to the new Nyquist frequency
ORDER = 3  # polynomial order of smooth_diff
WINDOW = 1.25  # product of bandwidth and window length
NARROWEST, WIDEST = 1e-5, 0.3  # ratio of bandwidth to sampling rate, for windows of 125000 and 5 samples


def lowpass_offline(x: np.ndarray, rate: float, cutoff: float, order: int = 4) -> np.ndarray:
    """Filter along axis 0 with a forward-backward Butterworth filter, which has zero phase and twice the order.

    Parameters
    ----------
    x : (N, ...) samples, finite.
    rate : sampling rate [Hz].
    cutoff : corner frequency of one pass [Hz], below ``rate / 2``.
    order : filter order of one pass.

    Returns
    -------
    (N, ...) filtered samples.

    Raises
    ------
    ShapeError : if the record is too short or not finite, or the cut-off is outside (0, rate / 2).
    ConfigError : if order is not a positive integer.
    """
    from scipy.signal import butter, sosfiltfilt

    x = _record(x)
    cutoff, rate = number(cutoff, "the cut-off [Hz]"), number(rate, "the rate [Hz]")
    if not 0.0 < cutoff < rate / 2 < np.inf:
        raise ShapeError(f"Expected a cut-off between 0 and {rate / 2:g} Hz (half the rate), got {cutoff:g} Hz.")
    if not 1 <= number(order, "the order", ConfigError) < np.inf or order % 1:
        raise ConfigError(f"Expected an integer order >= 1, got {order:g}. The default is 4.")
    sections = np.asarray(butter(int(order), cutoff / (rate / 2), output="sos"))
    needed = 6 * sections.shape[0] + 4
    if len(x) < needed:
        raise ShapeError(f"Expected at least {needed} samples along axis 0, got shape {x.shape}. Record longer.")
    _check_finite(x)
    return sosfiltfilt(sections, x, axis=0)


def central_diff(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Differentiate along axis 0 by second-order central differences at the given times, one-sided at the ends.

    Parameters
    ----------
    x : (N, ...) samples.
    t : (N,) times [s], strictly increasing.

    Returns
    -------
    (N, ...) derivative [unit of x per second].
    """
    x = _record(x)
    return np.gradient(x, _check_times(t, len(x), 3), axis=0, edge_order=2)


def filtfilt(operator: Operator, x: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
    """Run a streaming filter forward and backward along axis 0, for zero phase and squared gain.

    Both ends of the record are extended by point reflection, each over the settling time of the filter. The operator is
    reset.

    Parameters
    ----------
    operator : ExpFilter, LowPass2 or Notch.
    x : (N, ...) samples, finite.
    t : (N,) times [s], strictly increasing; required for operators without dt, and for unevenly spaced samples.

    Returns
    -------
    (N, ...) filtered samples.

    Raises
    ------
    ConfigError : if the operator is not a filter.
    ShapeError : if values are not finite, or times do not increase.

    References
    ----------
    Gustafsson (1996), Determining the initial states in forward-backward filtering.
    """
    if not isinstance(operator, Operator):
        raise ConfigError(f"Expected a filter, got {type(operator).__name__}. For example, use LowPass2(10.0).")
    if not operator.settling:
        raise ConfigError(
            f"Expected a filter to run forward and backward, got {type(operator).__name__}. "
            "Use central_diff or smooth_diff for derivatives."
        )
    x = _record(x)
    if len(x) < 2:
        raise ShapeError(f"Expected at least 2 samples along axis 0, got shape {x.shape}. Record longer.")
    _check_finite(x)
    times = None if t is None else _check_times(t, len(x), 2)
    step = operator.dt if times is None else float(np.median(np.diff(times)))
    pad = len(x) - 1 if np.isnan(step) else min(len(x) - 1, int(np.ceil(operator.settling / step)))
    longer = _reflected(x, pad)
    times = None if times is None else _reflected(times, pad)
    for _ in range(2):
        operator.reset()
        longer = operator.run(longer, times)[::-1]
        times = None if times is None else -times[::-1]
    operator.reset()
    return np.array(longer[pad : pad + len(x)])


def decimate(x: np.ndarray, rate: float, factor: int) -> np.ndarray:
    """Keep every `factor`-th sample along axis 0 after a zero-phase low-pass filter at 0.8 of the new Nyquist
    frequency.

    Parameters
    ----------
    x : (N, ...) samples, finite.
    rate : sampling rate [Hz].
    factor : decimation factor, at least 1; the new rate is ``rate / factor``.

    Returns
    -------
    (ceil(N / factor), ...) samples; the first output sample has the time of the first input sample.

    Raises
    ------
    ConfigError : if factor is not a positive integer.
    ShapeError : if the record is too short or not finite.
    """
    if not 1 <= number(factor, "the factor", ConfigError) < np.inf or factor % 1:
        raise ConfigError(f"Expected an integer factor >= 1, got {factor:g}. Use Table.resample for other rates.")
    x, factor = _record(x), int(factor)
    _check_finite(x)
    return x.copy() if factor == 1 else lowpass_offline(x, rate, PASSED * 0.5 * rate / factor)[::factor]


def smooth_diff(x: np.ndarray, t: np.ndarray, bandwidth: float) -> np.ndarray:
    """Differentiate along axis 0 with a zero-phase Savitzky-Golay filter (cubic polynomials in a sliding window).

    The window length is the odd number for which the 3 dB bandwidth, relative to the ideal derivative, is closest to
    `bandwidth`.

    Parameters
    ----------
    x : (N, ...) samples, finite.
    t : (N,) evenly spaced times [s].
    bandwidth : 3 dB bandwidth of the derivative [Hz].

    Returns
    -------
    (N, ...) derivative [unit of x per second].

    Raises
    ------
    ShapeError : if the times are not evenly spaced, the bandwidth is unattainable, or the record is shorter than the
        window.

    References
    ----------
    Savitzky and Golay (1964); Schafer (2011), What is a Savitzky-Golay filter?
    """
    from scipy.signal import savgol_filter

    x = _record(x)
    _check_finite(x)
    steps = np.diff(_check_times(t, len(x), 5))
    dt = float(np.mean(steps))
    if np.max(np.abs(steps - dt)) > UNEVEN * dt:
        raise ShapeError(
            f"Expected evenly spaced times, got steps from {steps.min():.4g} s to {steps.max():.4g} s. Resample the "
            "record first, or use central_diff."
        )
    bandwidth = number(bandwidth, "the bandwidth [Hz]")
    window = _window(bandwidth * dt)
    if window > len(x):
        raise ShapeError(
            f"Expected at least {window} samples for a bandwidth of {bandwidth:g} Hz, got {len(x)}. Record longer."
        )
    return np.asarray(savgol_filter(x, window, ORDER, deriv=1, delta=dt, axis=0, mode="interp"))


def _window(bandwidth: float) -> int:
    """Return the odd window length with the 3 dB bandwidth closest to `bandwidth` [cycles per sample]."""
    from scipy.signal import savgol_coeffs

    if not NARROWEST <= bandwidth < WIDEST:
        raise ShapeError(
            f"Expected a bandwidth between {NARROWEST:g} and {WIDEST:g} of the sampling rate, got {bandwidth:.3g}. "
            "Use central_diff for higher bandwidths."
        )

    def loss(window: int) -> float:
        offsets = np.arange(window) - window // 2
        taps = savgol_coeffs(window, ORDER, deriv=1, use="dot")
        gain = np.sum(taps * np.sin(2 * np.pi * bandwidth * offsets)) / (2 * np.pi * bandwidth)
        return float(abs(gain - np.sqrt(0.5)))

    middle = 2 * int(WINDOW / bandwidth / 2) + 1
    return min((window for window in range(middle - 4, middle + 5, 2) if window >= ORDER + 2), key=loss)


def _reflected(x: np.ndarray, pad: int) -> np.ndarray:
    """Extend (N, ...) by point reflection at both ends."""
    return np.concatenate([2 * x[:1] - x[pad:0:-1], x, 2 * x[-1:] - x[-2 : -pad - 2 : -1]])


def _record(x: np.ndarray) -> np.ndarray:
    x = numbers(x, "samples", ShapeError)
    if x.ndim < 1:
        raise ShapeError("Expected samples of shape (N, ...), got a single number. Pass an array.")
    return x


def _check_times(t: np.ndarray, count: int, least: int) -> np.ndarray:
    t = numbers(t, "times", ShapeError)
    if t.shape != (count,) or count < least:
        got = f"an array of shape {t.shape}. Pass one time per sample, and a longer record."
    elif not np.isfinite(t).all():
        row = int(np.argmin(np.isfinite(t)))
        got = f"{t[row]} in row {row}. Drop the rows without a time first."
    elif not np.all(np.diff(t) > 0):
        row = int(np.argmin(np.diff(t) > 0)) + 1
        got = f"{t[row]:.6g} s in row {row} after {t[row - 1]:.6g} s. Drop repeated and decreasing timestamps first."
    else:
        return t
    raise ShapeError(f"Expected at least {least} finite, strictly increasing times for {count} samples, got {got}")


def _check_finite(x: np.ndarray) -> None:
    bad = np.flatnonzero(~np.isfinite(x).all(axis=tuple(range(1, x.ndim))))
    if len(bad):
        raise ShapeError(
            f"Expected finite samples, got NaN or Inf in {len(bad)} rows, first {bad[:5].tolist()}. Drop the rows, or "
            "split the record there."
        )
