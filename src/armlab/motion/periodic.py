"""Rhythmic movement primitive: equation, fit, stepper and controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import number, numbers, positive
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Excitation, Fit
from armlab.motion.arguments import at_least_zero, clock, kernel_count, vector
from armlab.motion.control import Arms, Controller, JointLimits, Pace, at_pace, check_joints, own_steps
from armlab.motion.primitive.demonstrations import read_demos
from armlab.motion.primitive.run import Rollout, advance
from armlab.motion.primitive.weights import block_covariance, solve
from armlab.motion.storage import Saved, freeze_arrays
from armlab.state import State

GRID = 1024  # phases per period, to resolve harmonics up to 512

MAX_CONDITION = 1e11
DETERMINED = 1e4  # condition number above which the motion between samples is not determined
NEXT = 2.0  # largest gap between samples, in kernel spacings, that still determines every kernel
NEGLIGIBLE = 1e-18  # fraction of the largest harmonic below which harmonics are dropped

Start = tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False, repr=False)
class PeriodicDmp(Saved, kind="periodic_dmp"):
    """Rhythmic movement primitive of n coordinates over the phase ``phi = 2 pi t / period``.

    ``tau_d^2 ydd = alpha_z (beta_z (g - y) - tau_d yd) + r psi(phi) w`` with ``tau_d = period / (2 pi)`` and
    ``psi_j = exp(h (cos(phi - c_j) - 1))`` divided by their sum.

    Attributes
    ----------
    weights : (n_basis, n) kernel weights, in the unit of y.
    centres : (n_basis,) kernel centres [rad].
    h : concentration of the kernels.
    period : period of the demonstration [s].
    g : (n,) baseline.
    alpha_z, beta_z : constants of the spring.

    Raises
    ------
    ShapeError : fields with inconsistent shapes, non-finite values, or non-positive constants.

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
        """Return an `armlab.kernels.Primitive` that begins at a given phase.

        Parameters
        ----------
        phase : phi at the start of the run [rad].
        """
        widths = np.full(len(self.centres), 1.0 / np.sqrt(self.h))
        stiffness = self.alpha_z * self.beta_z
        return kernels.Primitive(
            self.centres - phase, widths, self.weights, self.alpha_z, stiffness, 1.0, 1.0, "periodic"
        )

    @cached_property
    def _harmonics(self) -> np.ndarray:
        """Coefficients (513, n) of ``exp(i k phi)`` in the steady-state motion around the baseline."""
        phi = 2 * np.pi / GRID * np.arange(GRID)
        f = np.fft.rfft(self.primitive_from().forcing(phi), axis=0) / GRID
        return f * transfer(self.alpha_z, self.alpha_z * self.beta_z)[:, None]

    def steady(self, phase: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the steady-state motion around the baseline and its phase derivative, each (..., n), at phases (...).

        Parameters
        ----------
        phase : phi [rad].
        """
        k = np.arange(GRID // 2 + 1)
        double = np.where((k == 0) | (k == GRID // 2), 1.0, 2.0)
        wave = np.exp(1j * k * numbers(phase, "phase", ShapeError)[..., None]) * double
        return np.real(wave @ self._harmonics), np.real(wave * (1j * k) @ self._harmonics)

    def _start_state(
        self, period: float | None, g: ArrayLike | None, r: float, y0: Any, v0: Any, phase: float
    ) -> Start:
        """Return the time constant, position, velocity, baseline and scale of a run; by default in steady state."""
        tau = (self.period if period is None else positive(period, "period [s]")) / (2 * np.pi)
        base, size = self.g if g is None else vector(g, "g", self.n), amplitude(r)
        y, rate = self.steady(number(phase, "phase [rad]"))
        begin = base + size * y if y0 is None else vector(y0, "y0", self.n)
        speed = size * rate / tau if v0 is None else vector(v0, "v0", self.n)
        return tau, begin, speed, base, np.full(self.n, size)

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
        """Run the primitive with one step per interval, exact for the spring and of fourth order for the forcing.

        Parameters
        ----------
        t : (N,) increasing times [s], relative to the first; or a time step [s] for a run of one period.
        period : period of the run [s].
        g : (n,) baseline.
        r : amplitude factor around the baseline.
        y0, v0 : (n,) start position and velocity; default: steady state.
        phase : phi at the start [rad].

        Raises
        ------
        ShapeError : non-increasing times, wrong shapes, NaN, or a non-positive period.
        """
        tau, *state = self._start_state(period, g, r, y0, v0, phase)
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
        """Return a stepper that runs the primitive sample by sample; baseline, amplitude and period may change.

        The stepper's ``step(dt)`` and `state` return y, yd and ydd, each (n,). ``change(g=..., r=..., period=...)``
        changes parameters without a jump, and ``reset()`` returns to the start; `phase` is the current phi [rad].

        Parameters
        ----------
        period, g, r, y0, v0, phase : as in `rollout`.

        Raises
        ------
        ShapeError : as in `rollout`.
        """
        return PeriodicStepper(self, self._start_state(period, g, r, y0, v0, phase), float(phase))

    def controller(
        self,
        robot: Arms,
        *,
        limits: JointLimits | Sequence[JointLimits] | None = None,
        period: float | None = None,
        g: ArrayLike | None = None,
        r: float = 1.0,
        turns: float = np.inf,
    ) -> Controller:
        """Return a controller ``State -> Command`` for `armlab.bridge` that starts and ends at rest at the baseline.

        Parameters
        ----------
        robot, limits : as in `Dmp.controller`.
        period, g, r : as in `rollout`.
        turns : number of periods before the arm comes to rest; the amplitude ramps up over the first period and down
            over the last.

        Raises
        ------
        ShapeError : wrong number of joints, a baseline outside the limits, or any cause listed for `rollout`.
        """
        return PeriodicController(robot, self, {"period": period, "g": g, "r": r, "turns": turns}, limits)


def amplitude(r: Any) -> float:
    """Return the amplitude r as a float, or raise an error if it is not finite."""
    found = number(r, "r")
    if not np.isfinite(found):
        raise ShapeError(f"Expected a finite amplitude r, got {found:g}. The demonstration has r = 1.")
    return found


def transfer(alpha: float, stiffness: float) -> np.ndarray:
    """Return the frequency response of the spring to a forcing ``exp(i k phi)``, for k from 0 to 512."""
    k = np.arange(GRID // 2 + 1)
    return 1.0 / (stiffness - k**2 + 1j * alpha * k)


class PeriodicStepper:
    """Sample-by-sample run of a `PeriodicDmp`, equivalent to a rollout; created by `PeriodicDmp.stepper`."""

    def __init__(self, dmp: PeriodicDmp, start: Start, phase: float) -> None:
        self._n, self._first, self._phase = dmp.n, start, phase
        self._kernel = kernels.PrimitiveStepper(dmp.primitive_from(phase))
        self.reset()

    def reset(self) -> None:
        """Return to the start and restore the initial baseline, amplitude and period."""
        tau, y0, v0, g, scale = self._first
        self._g, self._scale = g, scale
        self._kernel.start(y0, v0, g, scale, tau)

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return y, yd, ydd, each (n,)."""
        return advance(dt, self._kernel)[0]

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Current position, velocity and acceleration, each (n,)."""
        return self._kernel.outputs()

    @property
    def phase(self) -> float:
        """Current phase phi [rad], which keeps increasing from period to period."""
        return self._phase + self._kernel.elapsed

    def change(self, *, g: ArrayLike | None = None, r: float | None = None, period: float | None = None) -> None:
        """Change baseline, amplitude or period; position and velocity stay continuous."""
        goal = self._g if g is None else vector(g, "g", self._n)
        scale = self._scale if r is None else np.full(self._n, amplitude(r))
        tau = self._kernel.tau if period is None else positive(period, "period") / (2 * np.pi)
        self._g, self._scale = goal, scale
        self._kernel.change_tau(tau)
        self._kernel.change_goal(goal, scale)


class PeriodicController(Controller):
    """Controller of a `PeriodicDmp` that starts and ends at rest; `goal` is the baseline, which may change."""

    def __init__(
        self,
        robot: Arms,
        dmp: PeriodicDmp,
        settings: Mapping[str, Any],
        limits: JointLimits | Sequence[JointLimits] | None = None,
    ) -> None:
        check_joints(robot, dmp.n)
        period, self._r, self._turns = settings["period"], settings["r"], number(settings["turns"], "turns")
        if not self._turns > 0.0:
            raise ShapeError(f"Expected turns above zero, got {self._turns:g}. Use infinity to repeat indefinitely.")
        dmp.stepper(period=period, r=self._r)
        self._dmp, self._period = dmp, dmp.period if period is None else float(period)
        super().__init__(robot, limits, dmp.g if settings["g"] is None else settings["g"])

    def _begin(self, state: State) -> None:
        self._elapsed = 0.0
        self._stepper = self._dmp.stepper(
            period=self._period, g=self._goal, r=0.0, y0=state.q, v0=np.zeros_like(state.q)
        )

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        for h in own_steps(dt, pace):
            self._elapsed += h
            self._stepper.change(r=self._r * self._share())
            self._stepper.step(h)
        return at_pace(self._stepper.state, pace)

    def _share(self) -> float:
        """Return the current fraction of the amplitude: smooth rise in the first period, smooth fall in the last."""
        turn = self._elapsed / self._period
        u = min(max(min(turn, self._turns - turn), 0.0), 1.0)
        return u * u * (3.0 - 2.0 * u)

    def _change_goal(self, g: np.ndarray) -> None:
        self._stepper.change(g=g)

    @property
    def _is_over(self) -> bool:
        return self._elapsed >= self._turns * self._period


def fit_periodic_dmp(
    t: ArrayLike,
    y: ArrayLike,
    *,
    period: float,
    n_basis: int = 25,
    h: float | None = None,
    g: ArrayLike | None = None,
    alpha_z: float = 25.0,
    ridge: float = 0.0,
) -> Fit[PeriodicDmp]:
    """Fit a rhythmic movement primitive, using the weights whose steady-state motion is closest to the demonstration.

    The steady-state motion is linear in the weights, so no measurement is differentiated (see
    docs/theory/periodic_dmp.md).

    Parameters
    ----------
    t : (N,) increasing times [s], over one or more periods; the phase is 0 at the first sample.
    y : (N, n) positions [rad or m].
    period : period [s]. An error of 1 % in the period ruins a fit to ten periods: try several values and keep the one
        with the smallest `sigma`.
    n_basis : number of kernels, 3 to 1000.
    h : concentration of the kernels; default: ``(n_basis / (2 pi))^2``.
    g : (n,) baseline; default: the mean of the samples. The kernels compensate for a baseline that differs from the
        mean.
    alpha_z : constant of the critically damped spring.
    ridge : penalty on the squared weights.

    Returns
    -------
    Fit of a `PeriodicDmp`. `residuals` (N, n).

    Raises
    ------
    ShapeError : wrong shapes, NaN or non-increasing times (with row numbers), a non-positive period, or several
        demonstrations.
    ConfigError : options out of range.
    NotExcited : part of the period has no samples, and no ridge is set.
    """
    kernel_count(n_basis, 25)
    demos = read_demos(t, y, None)
    if len(demos) > 1:
        raise ShapeError(
            f"Expected one demonstration, got {len(demos)} demonstrations "
            "with different initial phases. Fit a single recording of many periods."
        )
    demo = demos[0]
    seconds, penalty = (
        positive(period, "period", "Measure the period from peak to peak."),
        at_least_zero(ridge, "ridge"),
    )
    n = demo.y.shape[1]
    blank = PeriodicDmp(
        weights=np.zeros((n_basis, n)),
        centres=2 * np.pi / n_basis * np.arange(n_basis),
        h=(n_basis / (2 * np.pi)) ** 2 if h is None else h,
        period=seconds,
        g=demo.y.mean(axis=0) if g is None else vector(g, "g", n),
        alpha_z=alpha_z,
        beta_z=number(alpha_z, "alpha_z") / 4.0,
    )
    A = _responses(blank, 2 * np.pi / seconds * demo.t)
    off = demo.y - blank.g
    found = solve(A, off, np.full(n_basis, penalty) if penalty else None)
    if not penalty:
        _check_seen(2 * np.pi / seconds * demo.t, found.triangle)
    return _fit(blank, A, off, found, penalty)


def _check_seen(phi: np.ndarray, triangle: np.ndarray) -> None:
    """Raise an error if part of the period has no samples and weights are therefore undetermined."""
    m = len(triangle)
    turns = np.sort(phi / (2 * np.pi) % 1.0)
    ends = np.append(turns[1:], turns[0] + 1.0)
    i = int(np.argmax(ends - turns))
    if ends[i] - turns[i] <= NEXT / m:
        return
    excitation = Excitation.of(triangle, [f"weight {j}" for j in range(m)], DETERMINED)
    if excitation.rank < m:
        missing = f"from {turns[i]:.2g} to {ends[i] % 1.0 or 1.0:.2g} of the period"
        raise NotExcited(
            f"Expected samples over the whole period, got no samples {missing}, which leaves "
            f"{m - excitation.rank} of {m} weights undetermined. Record a whole period, use fewer kernels, or set a "
            "ridge.",
            [excitation.weakest],
            [f"no sample {missing}"],
        )


def _responses(blank: PeriodicDmp, phi: np.ndarray) -> np.ndarray:
    """Return the steady-state motion (N, n_basis) of each individual kernel."""
    grid = 2 * np.pi / GRID * np.arange(GRID)
    spectrum = np.fft.rfft(blank.primitive_from().basis(grid), axis=0) / GRID
    spectrum *= transfer(blank.alpha_z, blank.alpha_z * blank.beta_z)[:, None]
    size = np.abs(spectrum).max(axis=1)
    last = int(np.flatnonzero(size > NEGLIGIBLE * size.max())[-1])
    spectrum[1 : GRID // 2] *= 2.0
    turns = np.ones((last + 1, len(phi)), dtype=complex)
    turns[1:] = np.exp(1j * phi)
    np.cumprod(turns, axis=0, out=turns)  # ten times faster than evaluating sines
    return (turns.T @ spectrum[: last + 1]).real


def _fit(blank: PeriodicDmp, A: np.ndarray, off: np.ndarray, found: Any, ridge: float) -> Fit[PeriodicDmp]:
    m, n = blank.weights.shape
    residuals = off - A @ found.x
    sigma = np.sqrt((residuals**2).sum(axis=0) / max(len(off) - m, 1))
    unit = np.broadcast_to(found.G - ridge * found.G @ found.G, (n, m, m))
    names = [f"weight {j}" for j in range(m)]
    return Fit(
        value=replace(blank, weights=found.x),
        names=tuple(name if n == 1 else f"{name} of coordinate {i}" for i in range(n) for name in names),
        units=("unit of y",) * (m * n),
        parameters=found.x.T.ravel(),
        cov=block_covariance(unit, sigma),
        sigma=sigma,
        residuals=residuals,
        n=len(off),
        excitation=Excitation.of(found.triangle, names, MAX_CONDITION),
        classes=tuple(f"position of coordinate {i} [unit of y]" for i in range(n)),
    )
