"""Streaming operators: small objects with memory for the control loop, one sample in, one sample out.

All have ``step(x)`` or ``step(x, t)``, ``run(x)`` or ``run(x, t)`` (equal to a loop of `step` bit for bit), and
``reset(init)``. A sample is a number or an array; its shape is that of the first one. The step h is `dt`, or the true
difference of the time stamps: filters keep their time constants whatever the jitter. A sample that is not finite gives
NaN and leaves the memory as it is.
"""

from __future__ import annotations

import numpy as np

from armlab._numbers import check_name, number
from armlab.errors import ConfigError
from armlab.kernels import SignalOperator

__all__ = ["CausalDiff", "Differentiator", "ExpFilter", "Integrator", "LowPass2", "Notch", "Operator"]

RULES = ("trapezoid", "euler")
BUTTERWORTH = float(np.sqrt(0.5))
SETTLED = 12.0  # time constants after which a start is forgotten: 6e-6 of it is left


class Operator:
    """Operator with memory; the classes below are the ones to use.

    Parameters
    ----------
    kernel : does the work.
    dt : step [s], NaN when every sample has a time stamp.
    settling : time [s] after which a filter has forgotten its start; 0 for operators that are no filters.
    """

    __slots__ = ("_kernel", "dt", "settling")

    def __init__(self, kernel: SignalOperator, dt: float, settling: float = 0.0) -> None:
        self._kernel = kernel
        self.dt = dt
        self.settling = settling

    def step(self, x: np.ndarray | float, t: float | None = None) -> np.ndarray | float:
        """Advance by one sample and return the output, of the same shape.

        Parameters
        ----------
        x : sample, a number or an array.
        t : time stamp [s], with every sample or with none; without it the step is dt.

        Raises
        ------
        ShapeError : another shape than the first sample, a stamp that does not increase, stamps now and then.
        """
        return self._kernel.step(x, t)

    def run(self, x: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
        """Step along samples (N, ...) and return the outputs (N, ...), from the memory as it is.

        Parameters
        ----------
        x : (N, ...) samples. t : (N,) time stamps [s] or None.
        """
        return self._kernel.run(x, t)

    def reset(self, init: np.ndarray | float | None = None) -> None:
        """Forget all samples, and the gaps; the next one is the first.

        Parameters
        ----------
        init : new initial value; the one given at construction when left out.
        """
        self._kernel.reset(init)

    @property
    def gaps(self) -> int:
        """Steps longer than 1.5 dt, or than 1.5 times the first step where no dt was given."""
        return self._kernel.gaps

    @property
    def longest_gap(self) -> float:
        """The longest of these steps [s]; 0 without any."""
        return self._kernel.longest_gap

    @property
    def skipped(self) -> int:
        """Samples that were not finite."""
        return self._kernel.skipped


class Integrator(Operator):
    """Integral of a signal: ``I_k = I_{k-1} + h (x_k + x_{k-1}) / 2``, or ``+ h x_k`` with the Euler rule.

    The first step returns init (trapezoid) or ``init + dt x_0`` (Euler). The macro @integrate of TFRT-7651 (Bagge
    Carlson and Haage 2017, section 4.1).

    Parameters
    ----------
    dt : step [s]. init : initial value. rule : "trapezoid" or "euler".
    """

    __slots__ = ()

    def __init__(self, dt: float, init: np.ndarray | float = 0.0, rule: str = "trapezoid") -> None:
        check_name(rule, "rule of integration", RULES)
        super().__init__(SignalOperator(rule, 0.0, 0.0, _step(dt), init), _step(dt))


class Differentiator(Operator):
    """Backward difference ``(x_k - x_{k-1}) / h``; the first step returns 0, or ``(x_0 - init) / dt``.

    The macro @differentiate of TFRT-7651. It amplifies noise by 1/h: `CausalDiff` filters too.

    Parameters
    ----------
    dt : step [s]. init : value before the first sample.
    """

    __slots__ = ()

    def __init__(self, dt: float, init: np.ndarray | float | None = None) -> None:
        super().__init__(SignalOperator("difference", 0.0, 0.0, _step(dt), init), _step(dt))


class ExpFilter(Operator):
    """First-order low-pass ``y_k = a y_{k-1} + (1 - a) x_k`` with ``a = exp(-h / T)`` of the true step h.

    Starts at the first sample; with init it takes a step of dt from there. The macro @expfilt of TFRT-7651 has a as its
    argument: `from_alpha`.

    Parameters
    ----------
    time_constant : T [s]. dt : step [s]; time stamps are needed without it. init : initial value.
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
        alpha : forgetting factor in (0, 1) per step of dt; higher is smoother. dt : step [s]. init : initial value.
        """
        if not 0 < number(alpha, "the forgetting factor alpha", ConfigError) < 1:
            raise ConfigError(f"Expected alpha between 0 and 1, got {alpha!r}. Higher is smoother; 0.99 is usual.")
        return cls(-_step(dt) / np.log(alpha), dt, init)


class LowPass2(Operator):
    """Causal Butterworth low-pass of second order: ``y'' + sqrt(2) w y' + w^2 y = w^2 x``, ``w = 2 pi cutoff``.

    Solved exactly for straight lines between the samples, so that jitter does not change it. Starts at rest at the
    first sample, or at init. Delays slow signals by ``sqrt(2) / w``.

    Parameters
    ----------
    cutoff : frequency of half power [Hz]. dt : step [s]; time stamps are needed without it. init : initial value.
    """

    __slots__ = ()

    def __init__(self, cutoff: float, dt: float | None = None, init: np.ndarray | float | None = None) -> None:
        w, step = _corner(cutoff, dt), _step(dt)
        super().__init__(SignalOperator("lowpass", w, BUTTERWORTH, step, init), step, SETTLED / (BUTTERWORTH * w))


class CausalDiff(Operator):
    """Derivative of what `LowPass2` lets through: a differentiator that does not amplify noise above its cut-off.

    Exact for straight lines after the filter has settled; starts at 0.

    Parameters
    ----------
    cutoff : of the low-pass [Hz]. dt : step [s]; time stamps are needed without it. init : initial value of the signal.
    """

    __slots__ = ()

    def __init__(self, cutoff: float, dt: float | None = None, init: np.ndarray | float | None = None) -> None:
        super().__init__(SignalOperator("slope", _corner(cutoff, dt), BUTTERWORTH, _step(dt), init), _step(dt))


class Notch(Operator):
    """Filter that stops one frequency: ``(s^2 + w^2) / (s^2 + w / Q s + w^2)``, ``w = 2 pi frequency``.

    Solved exactly for straight lines between the samples. Starts at rest at the first sample.

    Parameters
    ----------
    frequency : that is stopped [Hz]. quality : Q > 1/2, frequency over the width that is attenuated by 3 dB or more.
    dt : step [s]; time stamps are needed without it.
    """

    __slots__ = ()

    def __init__(self, frequency: float, quality: float = 2.0, dt: float | None = None) -> None:
        if not 0.5 < number(quality, "the quality", ConfigError) < np.inf:
            raise ConfigError(f"Expected a quality above 0.5, got {quality!r}. A higher one stops a narrower band.")
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
