"""The movement primitive of rhythmic motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import number, numbers, positive
from armlab.errors import ShapeError
from armlab.motion._harmonics import GRID, transfer
from armlab.motion._saved import Saved, freeze_arrays
from armlab.motion._setting import clock, vector
from armlab.motion.periodic_stepper import PeriodicStepper
from armlab.motion.rollout import Rollout

if TYPE_CHECKING:
    from armlab.motion.control import Arms, Controller, Limits

__all__ = ["PeriodicDmp"]


@dataclass(frozen=True, eq=False)
class PeriodicDmp(Saved, kind="periodic_dmp"):
    """A movement primitive of n coordinates that repeats itself, over the phase ``phi = 2 pi t / period``.

    ``tau_d^2 ydd = alpha_z (beta_z (g - y) - tau_d yd) + r psi(phi) w`` with ``tau_d = period / (2 pi)`` and
    ``psi_j = exp(h (cos(phi - c_j) - 1))`` over their sum.

    Attributes
    ----------
    weights : (n_basis, n) in the unit of y. centres : (n_basis,) [rad]. h : concentration of the kernels.
    period : of the demonstration [s]. g : (n,) baseline. alpha_z, beta_z : constants of the spring.

    Raises
    ------
    ShapeError : fields that do not fit each other, are not finite or not above zero.

    References
    ----------
    Ijspeert, Nakanishi, Hoffmann, Pastor and Schaal (2013), Neural Computation 25(2), 328-373, section 2.1.3.
    """

    weights: np.ndarray
    centres: np.ndarray
    h: float
    period: float
    g: np.ndarray
    alpha_z: float = 25.0
    beta_z: float = 6.25

    UNITS: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("weights", "g"), "unit of y"),
        "centres": "rad",
        "period": "s",
        **dict.fromkeys(("h", "alpha_z", "beta_z"), "1"),
    }

    def __post_init__(self) -> None:
        """Check and freeze."""
        freeze_arrays(self, "weights", "centres", "g")
        if self.weights.ndim != 2 or not self.weights.size:
            raise ShapeError(f"Expected weights of shape (n_basis, n), got {self.weights.shape}.")
        m, n = self.weights.shape
        for name, shape in {"centres": (m,), "g": (n,)}.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(f"Expected {name} of shape {shape}, got {getattr(self, name).shape}.")
        for name in ("h", "period", "alpha_z", "beta_z"):
            object.__setattr__(self, name, positive(getattr(self, name), name))

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.weights.shape[1]

    def primitive_from(self, phase: float = 0.0) -> Any:
        """Return an `armlab.kernels.Primitive` that begins at a phase.

        Parameters
        ----------
        phase : phi at its start [rad].
        """
        widths = np.full(len(self.centres), 1.0 / np.sqrt(self.h))
        stiffness = self.alpha_z * self.beta_z
        return kernels.Primitive(
            self.centres - phase, widths, self.weights, self.alpha_z, stiffness, 1.0, 1.0, "periodic"
        )

    @cached_property
    def harmonics(self) -> np.ndarray:
        """Coefficients (513, n) of ``exp(i k phi)`` in the steady motion around the baseline."""
        phi = 2 * np.pi / GRID * np.arange(GRID)
        f = np.fft.rfft(self.primitive_from().forcing(phi), axis=0) / GRID
        return f * transfer(self.alpha_z, self.alpha_z * self.beta_z)[:, None]

    def steady(self, phase: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the steady motion around the baseline at phases (...), and its rate with the phase, (..., n) each.

        Parameters
        ----------
        phase : phi [rad].
        """
        k = np.arange(GRID // 2 + 1)
        double = np.where((k == 0) | (k == GRID // 2), 1.0, 2.0)
        wave = np.exp(1j * k * numbers(phase, "phase", ShapeError)[..., None]) * double
        return np.real(wave @ self.harmonics), np.real(wave * (1j * k) @ self.harmonics)

    def start(
        self,
        period: float | None,
        g: ArrayLike | None,
        r: float,
        y0: ArrayLike | None,
        v0: ArrayLike | None,
        phase: float,
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return time constant, position, velocity, baseline and scale of a run: what is left out is in steady motion.

        Parameters
        ----------
        period, g, r, y0, v0, phase : as of `rollout`.
        """
        tau = (self.period if period is None else positive(period, "period [s]")) / (2 * np.pi)
        base, amplitude = self.g if g is None else vector(g, "g", self.n), number(r, "r")
        if not np.isfinite(amplitude):
            raise ShapeError(f"Expected a finite amplitude r, got {amplitude:g}.")
        y, rate = self.steady(number(phase, "phase [rad]"))
        begin = base + amplitude * y if y0 is None else vector(y0, "y0", self.n)
        speed = amplitude * rate / tau if v0 is None else vector(v0, "v0", self.n)
        return tau, begin, speed, base, np.full(self.n, amplitude)

    def rollout(
        self,
        t: ArrayLike,
        *,
        period: float | None = None,
        g: ArrayLike | None = None,
        r: float = 1.0,
        y0: ArrayLike | None = None,
        v0: ArrayLike | None = None,
        phase: float = 0.0,
    ) -> Rollout:
        """Run the primitive with one step per interval: the spring exactly, the forcing to fourth order.

        Parameters
        ----------
        t : (N,) increasing times [s], the motion starts at the first; or one step [s] for one period.
        period : [s]. g : (n,) baseline. r : factor on the motion around it.
        y0, v0 : (n,) start; that of the steady motion when left out. phase : phi at the start [rad].

        Raises
        ------
        ShapeError : times that do not increase, other shapes, NaN, no positive period.
        """
        tau, *state = self.start(period, g, r, y0, v0, phase)
        times = clock(t, 2 * np.pi * tau)
        y, yd, ydd, x, f = self.primitive_from(phase).rollout(times, tau, *state)
        return Rollout(np.array(times), y, yd, ydd, x + phase, f)

    def stepper(
        self,
        *,
        period: float | None = None,
        g: ArrayLike | None = None,
        r: float = 1.0,
        y0: ArrayLike | None = None,
        v0: ArrayLike | None = None,
        phase: float = 0.0,
    ) -> PeriodicStepper:
        """Return what runs the primitive sample by sample, with baseline, amplitude and period that may change.

        Parameters
        ----------
        period, g, r, y0, v0, phase : as of `rollout`.

        Raises
        ------
        ShapeError : as of `rollout`.
        """
        return PeriodicStepper(self, self.start(period, g, r, y0, v0, phase), float(phase))

    def controller(
        self,
        robot: Arms,
        *,
        limits: Limits | Sequence[Limits] | None = None,
        period: float | None = None,
        g: ArrayLike | None = None,
        r: float = 1.0,
        turns: float = np.inf,
    ) -> Controller:
        """Return a controller ``State -> Command`` for `armlab.bridge`: from rest at the baseline, and back to it.

        Parameters
        ----------
        robot : the arm whose joints the coordinates are, or several arms whose joints are one after another.
        limits : what has q_min, q_max, qd_max and qdd_max (n,), such as `bridge.Limits`, one per arm;
            those of the robots when None.
        period, g, r : as of `rollout`. turns : after which it rests; the motion grows over the first and fades over the
            last.

        Raises
        ------
        ShapeError : another number of joints, a baseline outside the limits, and as of `rollout`.
        """
        from armlab.motion.periodic_controller import PeriodicController

        return PeriodicController(robot, self, {"period": period, "g": g, "r": r, "turns": turns}, limits)
