"""Stateful streaming operators for the control loop: one output sample per input sample.

All operators have ``step(x)`` or ``step(x, t)``, ``run(x)`` or ``run(x, t)`` (bit-identical to a loop over `step`), and
``reset(init)``. A sample is a number or an array of constant shape. The step h is `dt` or the time stamp difference, so
filters keep their time constants under jitter. For a non-finite sample, an operator returns NaN and leaves its state
unchanged.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Self

import numpy as np

from armlab._numbers import check_name, number
from armlab.errors import ConfigError
from armlab.kernels import SignalOperator

__all__ = ["CausalDiff", "Differentiator", "ExpFilter", "Integrator", "LowPass2", "Notch", "Operator"]

RULES = ("trapezoid", "euler")
BUTTERWORTH = float(np.sqrt(0.5))
SETTLED = 12.0  # time constants, after which the initial state has decayed to 6e-6


class Operator:
    """Base class of stateful operators. Copies and pickles preserve the state.

    Parameters
    ----------
    kernel : the compiled operator.
    dt : step [s]; NaN if every sample has a time stamp.
    settling : settling time of a filter [s]; 0 for other operators.
    """

    __slots__ = ("_kernel", "dt", "settling")

    def __init__(self, kernel: SignalOperator, dt: float, settling: float = 0.0) -> None:
        self._kernel = kernel
        self.dt: float = dt
        self.settling: float = settling

    def __repr__(self) -> str:
        rate = "time stamps" if np.isnan(self.dt) else f"dt = {self.dt:g} s"
        return f"<{type(self).__name__}, {rate}, {self.skipped} samples skipped>"

    def __copy__(self) -> Self:
        """Return an independent operator with the same state."""
        return deepcopy(self)

    def step(self, x: np.ndarray | float, t: float | None = None) -> np.ndarray | float:
        """Advance by one sample and return an output of the same shape.

        Parameters
        ----------
        x : sample, a number or an array.
        t : time stamp [s], given for all samples or for none; default: a step of dt.

        Raises
        ------
        ShapeError : if the shape differs from the first sample's, times do not increase, or only some samples have
            time stamps.
        """
        return self._kernel.step(x, t)

    def run(self, x: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
        """Process samples (N, ...) from the current state, and return the outputs (N, ...).

        Parameters
        ----------
        x : (N, ...) samples.
        t : (N,) time stamps [s], or None.
        """
        return self._kernel.run(x, t)

    def reset(self, init: np.ndarray | float | None = None) -> None:
        """Reset the state and the counters; the next sample is treated as the first.

        Parameters
        ----------
        init : new initial value; default: the value passed to the constructor.
        """
        self._kernel.reset(init)

    @property
    def gaps(self) -> int:
        """Number of gaps, that is, steps longer than 1.5 dt or, without dt, 1.5 times the first step."""
        return self._kernel.gaps

    @property
    def longest_gap(self) -> float:
        """Longest gap [s], or 0 without gaps."""
        return self._kernel.longest_gap

    @property
    def skipped(self) -> int:
        """Number of non-finite samples."""
        return self._kernel.skipped


class Integrator(Operator):
    """Integral of a signal: ``I_k = I_{k-1} + h (x_k + x_{k-1}) / 2``, or ``+ h x_k`` with the Euler rule.

    The first step returns init (trapezoid) or ``init + dt x_0`` (Euler). Counterpart of the macro @integrate in
    TFRT-7651 (Bagge Carlson and Haage 2017, section 4.1).

    Parameters
    ----------
    dt : step [s].
    init : initial value.
    rule : "trapezoid" or "euler".
    """

    __slots__ = ()

    def __init__(self, dt: float, init: np.ndarray | float = 0.0, rule: str = "trapezoid") -> None:
        check_name(rule, "rule of integration", RULES)
        super().__init__(SignalOperator(rule, 0.0, 0.0, _step(dt), init), _step(dt))


class Differentiator(Operator):
    """Backward difference ``(x_k - x_{k-1}) / h``; the first step returns 0, or ``(x_0 - init) / dt``.

    The difference amplifies noise by 1/h; `CausalDiff` also filters the signal. Counterpart of the macro @differentiate
    in TFRT-7651.

    Parameters
    ----------
    dt : step [s].
    init : value before the first sample.
    """

    __slots__ = ()

    def __init__(self, dt: float, init: np.ndarray | float | None = None) -> None:
        super().__init__(SignalOperator("difference", 0.0, 0.0, _step(dt), init), _step(dt))


class ExpFilter(Operator):
    """First-order low-pass filter ``y_k = a y_{k-1} + (1 - a) x_k`` with ``a = exp(-h / T)`` for the actual step h.

    The filter starts at the first sample or, with `init`, one step dt before it. The macro @expfilt in TFRT-7651 takes
    `a` instead of `T`, as does `from_alpha`.

    Parameters
    ----------
    time_constant : T [s].
    dt : step [s]; without it, samples need time stamps.
    init : initial value.
    """

    __slots__ = ()

    def __init__(self, time_constant: float, dt: float | None = None, init: np.ndarray | float | None = None) -> None:
        if not 0 < number(time_constant, "the time constant [s]", ConfigError) < np.inf:
            raise ConfigError(f"Expected a time constant above 0 s, got {time_constant!r}.")
        step = _step(dt)
        super().__init__(SignalOperator("exponential", time_constant, 0.0, step, init), step, SETTLED * time_constant)

    @classmethod
    def from_alpha(cls, alpha: float, dt: float, init: np.ndarray | float | None = None) -> ExpFilter:
        """Return the filter with ``T = -dt / ln(alpha)``, about ``dt / (1 - alpha)``.

        Parameters
        ----------
        alpha : forgetting factor per step dt, in (0, 1); higher values smooth more.
        dt : step [s].
        init : initial value.
        """
        if not 0 < number(alpha, "the forgetting factor alpha", ConfigError) < 1:
            raise ConfigError(f"Expected alpha between 0 and 1, got {alpha!r}. Try 0.99; higher values smooth more.")
        return cls(-_step(dt) / np.log(alpha), dt, init)


class LowPass2(Operator):
    """Causal second-order Butterworth low-pass filter: ``y'' + sqrt(2) w y' + w^2 y = w^2 x``, ``w = 2 pi cutoff``.

    The discretisation is exact for piecewise linear input, so jitter causes no error. The filter starts at rest at the
    first sample or at `init`. The filter delays slow signals by ``sqrt(2) / w``.

    Parameters
    ----------
    cutoff : half-power frequency [Hz].
    dt : step [s]; without it, samples need time stamps.
    init : initial value.
    """

    __slots__ = ()

    def __init__(self, cutoff: float, dt: float | None = None, init: np.ndarray | float | None = None) -> None:
        w, step = _corner(cutoff, dt), _step(dt)
        super().__init__(SignalOperator("lowpass", w, BUTTERWORTH, step, init), step, SETTLED / (BUTTERWORTH * w))


class CausalDiff(Operator):
    """Derivative of the output of `LowPass2`, without noise amplification above the cut-off frequency.

    The output starts at 0 and is exact for ramps after settling.

    Parameters
    ----------
    cutoff : cut-off frequency of the low-pass filter [Hz].
    dt : step [s]; without it, samples need time stamps.
    init : initial value of the signal.
    """

    __slots__ = ()

    def __init__(self, cutoff: float, dt: float | None = None, init: np.ndarray | float | None = None) -> None:
        super().__init__(SignalOperator("slope", _corner(cutoff, dt), BUTTERWORTH, _step(dt), init), _step(dt))


class Notch(Operator):
    """Notch filter: ``(s^2 + w^2) / (s^2 + w / Q s + w^2)``, ``w = 2 pi frequency``.

    The discretisation is exact for piecewise linear input. The filter starts at rest at the first sample.

    Parameters
    ----------
    frequency : notch frequency [Hz].
    quality : Q > 1/2, the ratio of the frequency to the 3 dB bandwidth.
    dt : step [s]; without it, samples need time stamps.
    """

    __slots__ = ()

    def __init__(self, frequency: float, quality: float = 2.0, dt: float | None = None) -> None:
        if not 0.5 < number(quality, "the quality", ConfigError) < np.inf:
            raise ConfigError(f"Expected a quality above 0.5, got {quality!r}. Higher values give a narrower notch.")
        w, step = _corner(frequency, dt), _step(dt)
        super().__init__(SignalOperator("notch", w, 0.5 / quality, step), step, SETTLED * 2.0 * quality / w)


def _step(dt: float | None) -> float:
    if dt is None:
        return np.nan
    if not 0 < number(dt, "the step dt [s]", ConfigError) < np.inf:
        raise ConfigError(f"Expected a step dt above 0 s, got {dt!r}.")
    return float(dt)


def _corner(frequency: float, dt: float | None) -> float:
    highest = np.inf if dt is None else 0.5 / _step(dt)
    if not 0 < number(frequency, "the frequency [Hz]", ConfigError) < highest:
        raise ConfigError(f"Expected a frequency between 0 and {highest:g} Hz (half the rate), got {frequency!r}.")
    return 2.0 * np.pi * frequency
