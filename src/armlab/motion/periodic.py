"""The movement primitive of rhythmic motion: its equation, its fit, its stepper and its controller."""

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

GRID = 1024  # phases of one period: _harmonics up to 512

MAX_CONDITION = 1e11
SEEN = 1e4  # condition beyond which the motion where there are no samples is a guess
NEXT = 2.0  # distances of kernels between samples that tell every kernel
QUIET = 1e-18  # of the largest: _harmonics that are left out

Start = tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


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
    def _harmonics(self) -> np.ndarray:
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
        return np.real(wave @ self._harmonics), np.real(wave * (1j * k) @ self._harmonics)

    def _start_state(
        self, period: float | None, g: ArrayLike | None, r: float, y0: Any, v0: Any, phase: float
    ) -> Start:
        """Return time constant, position, velocity, baseline and scale of a run; by default in steady motion."""
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
        """Return what runs the primitive sample by sample, with baseline, amplitude and period that may change.

        Its ``step(dt)`` and `state` return y, yd and ydd, each (n,); ``change(g=..., r=..., period=...)`` goes on with
        other values without a jump, ``reset()`` back to the start; `phase` is phi now [rad].

        Parameters
        ----------
        period, g, r, y0, v0, phase : as of `rollout`.

        Raises
        ------
        ShapeError : as of `rollout`.
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
        """Return a controller ``State -> Command`` for `armlab.bridge`: from rest at the baseline, and back to it.

        Parameters
        ----------
        robot, limits : as of `Dmp.controller`.
        period, g, r : as of `rollout`. turns : after which it rests; the motion grows over the first and fades over the
            last.

        Raises
        ------
        ShapeError : another number of joints, a baseline outside the limits, and as of `rollout`.
        """
        return PeriodicController(robot, self, {"period": period, "g": g, "r": r, "turns": turns}, limits)


def amplitude(r: Any) -> float:
    """Return a finite amplitude."""
    found = number(r, "r")
    if not np.isfinite(found):
        raise ShapeError(f"Expected a finite amplitude r, got {found:g}. 1 is that of the demonstration.")
    return found


def transfer(alpha: float, stiffness: float) -> np.ndarray:
    """Return what the spring makes of a forcing ``exp(i k phi)``, for k from 0 to 512."""
    k = np.arange(GRID // 2 + 1)
    return 1.0 / (stiffness - k**2 + 1j * alpha * k)


class PeriodicStepper:
    """One run of a `PeriodicDmp`, sample by sample; made by `PeriodicDmp.stepper`. The numbers of its rollout."""

    def __init__(self, dmp: PeriodicDmp, start: Start, phase: float) -> None:
        self._n, self._first, self._phase = dmp.n, start, phase
        self._kernel = kernels.PrimitiveStepper(dmp.primitive_from(phase))
        self.reset()

    def reset(self) -> None:
        """Go back to the start, with the first baseline, amplitude and period."""
        tau, y0, v0, g, scale = self._first
        self._g, self._scale = g, scale
        self._kernel.start(y0, v0, g, scale, tau)

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return y, yd, ydd, each (n,)."""
        return advance(dt, self._kernel)[0]

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and acceleration now, each (n,)."""
        return self._kernel.outputs()

    @property
    def phase(self) -> float:
        """Phase phi now [rad], growing."""
        return self._phase + self._kernel.elapsed

    def change(self, *, g: ArrayLike | None = None, r: float | None = None, period: float | None = None) -> None:
        """Go on with another baseline, amplitude or period; position and velocity do not jump."""
        goal = self._g if g is None else vector(g, "g", self._n)
        scale = self._scale if r is None else np.full(self._n, amplitude(r))
        tau = self._kernel.tau if period is None else positive(period, "period") / (2 * np.pi)
        self._g, self._scale = goal, scale
        self._kernel.change_tau(tau)
        self._kernel.change_goal(goal, scale)


class PeriodicController(Controller):
    """A `PeriodicDmp`: from rest at the baseline the motion grows over a turn, and over the last one it fades.

    `goal` is the baseline; it may be set while it runs.
    """

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
            raise ShapeError(f"Expected turns above zero, got {self._turns:g}. Infinity goes on for ever.")
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
        """Return how much of the amplitude there is now: a smooth step up over the first turn, down over the last."""
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
    """Fit a rhythmic movement primitive: the weights whose own steady motion is nearest to the demonstration.

    The steady motion is linear in the weights, see docs/theory/periodic_dmp.md; nothing measured is differentiated.

    Parameters
    ----------
    t : (N,) increasing times [s], of a period or of any number of them; the phase is 0 at the first.
    y : (N, n) positions [rad or m].
    period : [s]; a hundredth off it spoils ten periods, so try others and take the one with the least `sigma`.
    n_basis : kernels, 3 to 1000. h : their concentration; ``(n_basis / (2 pi))^2`` when left out.
    g : (n,) baseline; the mean of the samples when left out: the kernels can make any other.
    alpha_z : constant of the spring, critically damped. ridge : penalty of the squared weights.

    Returns
    -------
    Fit of a `PeriodicDmp`. `residuals` (N, n).

    Raises
    ------
    ShapeError : shapes, NaN and times that do not increase, with their rows; no positive period; several
        demonstrations. ConfigError : options out of range.
    NotExcited : samples that leave part of the period out, and no ridge; with that part.
    """
    kernel_count(n_basis, 25)
    demos = read_demos(t, y, None)
    if len(demos) > 1:
        raise ShapeError(
            f"Expected one demonstration, got {len(demos)}: their phases would begin apart. Fit one, with many periods."
        )
    demo = demos[0]
    seconds, penalty = positive(period, "period", "Measure it from peak to peak."), at_least_zero(ridge, "ridge")
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
    """Refuse samples that leave out a part of the period in which the weights are not told."""
    m = len(triangle)
    turns = np.sort(phi / (2 * np.pi) % 1.0)
    ends = np.append(turns[1:], turns[0] + 1.0)
    i = int(np.argmax(ends - turns))
    if ends[i] - turns[i] <= NEXT / m:
        return
    excitation = Excitation.of(triangle, [f"weight {j}" for j in range(m)], SEEN)
    if excitation.rank < m:
        missing = f"from {turns[i]:.2g} to {ends[i] % 1.0 or 1.0:.2g} of it"
        raise NotExcited(
            f"Expected samples from the whole period, got none {missing}, which leaves {m - excitation.rank} of {m} "
            "weights untold. Record a whole period, take fewer kernels, or give a ridge.",
            [excitation.weakest],
            [f"no sample {missing}"],
        )


def _responses(blank: PeriodicDmp, phi: np.ndarray) -> np.ndarray:
    """Return the steady motion (N, n_basis) that each kernel alone makes."""
    grid = 2 * np.pi / GRID * np.arange(GRID)
    spectrum = np.fft.rfft(blank.primitive_from().basis(grid), axis=0) / GRID
    spectrum *= transfer(blank.alpha_z, blank.alpha_z * blank.beta_z)[:, None]
    size = np.abs(spectrum).max(axis=1)
    last = int(np.flatnonzero(size > QUIET * size.max())[-1])
    spectrum[1 : GRID // 2] *= 2.0
    turns = np.ones((last + 1, len(phi)), dtype=complex)
    turns[1:] = np.exp(1j * phi)
    np.cumprod(turns, axis=0, out=turns)  # a tenth of the time of as many sines
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
