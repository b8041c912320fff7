"""Runs of a movement primitive: parameters, motion over time, and sample-by-sample stepping."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._display import Shown
from armlab._numbers import check_name, make_read_only, number, positive
from armlab.errors import ConfigError, NotConverged, ShapeError
from armlab.lie import so3
from armlab.motion.arguments import at_least_zero, clock, vector
from armlab.motion.primitive.equation import Equation

HALF_TURN = 1e-6  # sine below which opposite directions have no unique smallest rotation

FORCINGS = ("shift", "scale")
BRAKE = 1.05  # factor on the peak acceleration of the demonstration

LONGEST = 1e4  # maximum run time in time constants; each takes the solver one or two steps


class RunOptions(TypedDict, total=False):
    """Options of a run of a `Dmp`; options that are omitted or None take the values of the demonstration."""

    duration: float | None
    tau_d: float | None
    y0: ArrayLike | None
    v0: ArrayLike | None
    g: ArrayLike | None
    amplitude: ArrayLike | None


@dataclass(frozen=True, eq=False, repr=False)
class Rollout(Shown):
    """Trajectory at N times; for a batch of K runs, the arrays are (N, K, n).

    Attributes
    ----------
    t : (N,) times [s].
    y, yd, ydd : (N, n) position, velocity, acceleration in the unit of the demonstration, per s and s^2.
    x : (N,) phase; (N, n) with one phase per coordinate.
    forcing : (N, n) the forcing term f, in the unit of y.
    """

    t: np.ndarray
    y: np.ndarray
    yd: np.ndarray
    ydd: np.ndarray
    x: np.ndarray
    forcing: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, *(field.name for field in fields(self)))


@dataclass(frozen=True)
class RunParameters:
    """Parameters of a run with arrays (n,), or of K runs on a common clock with arrays (K, n); `tau` is in seconds."""

    dmp: Equation
    primitive: Any
    tau: float
    y0: np.ndarray
    v0: np.ndarray
    g: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(
        cls,
        dmp: Equation,
        runs: int | None = None,
        /,
        duration: float | None = None,
        tau_d: float | None = None,
        y0: ArrayLike | None = None,
        v0: ArrayLike | None = None,
        g: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> RunParameters:
        """Fill in omitted `RunOptions` from the demonstration.

        `runs` is the number of runs, or 1 to infer it from the shapes of the arguments; None selects a single run with
        arrays (n,).
        """
        tau = _tau(dmp, duration, tau_d)
        given = {"y0": y0, "v0": v0, "g": g, "amplitude": amplitude}
        parts = {name: vector(a, name, dmp.n) for name, a in given.items() if a is not None}
        if amplitude is not None and dmp.scaling != "amplitude":
            raise ConfigError(
                f"Expected an amplitude only with scaling 'amplitude', got an amplitude with {dmp.scaling!r}. Omit the "
                "amplitude, or fit with scaling='amplitude'."
            )
        shape = (dmp.n,) if runs is None else (runs, dmp.n)
        whole = shape if runs is None else _many_runs(dmp, parts, shape)
        if runs is None:
            _check_one_run(parts, shape)
        start, goal = (np.broadcast_to(parts.get(name, own), whole) for name, own in (("y0", dmp.y0), ("g", dmp.g)))
        check_goal(dmp, goal)
        scale, primitive, R = np.ones(whole), dmp._primitive, None
        if dmp.scaling == "goal":
            scale = goal_scale(dmp, start, goal)
        elif amplitude is not None:
            scale = np.broadcast_to(parts["amplitude"], whole)
        elif dmp.scaling == "rotate":
            R = rotation(dmp.g - dmp.y0, goal - start)
            primitive = dmp._primitive_of(dmp.weights @ R.T)
        if v0 is None:
            speed = scale * dmp.v0 if R is None else R @ dmp.v0
            speed = speed * (dmp.tau_d / tau)
        else:
            speed = np.broadcast_to(parts["v0"], whole)
        return cls(dmp, primitive, tau, start, np.ascontiguousarray(speed), goal, np.ascontiguousarray(scale))

    def times(self, t: ArrayLike) -> np.ndarray:
        """Return times (N,) as given, or from 0 to the end of the motion in steps of t [s]."""
        return clock(t, self.tau * self.dmp.duration / self.dmp.tau_d)

    def towards(self, g: ArrayLike, scaled: bool) -> RunParameters:
        """Return this run with a new goal (n,); the forcing is scaled with the displacement or left unchanged."""
        goal = np.array(vector(g, "g", self.dmp.n))
        _check_one_run({"g": goal}, (self.dmp.n,))
        check_goal(self.dmp, goal)
        return replace(self, g=goal, scale=goal_scale(self.dmp, self.y0, goal) if scaled else self.scale)


def _tau(dmp: Equation, duration: float | None, tau_d: float | None) -> float:
    if duration is not None and tau_d is not None:
        raise ConfigError(
            "Expected either duration or tau_d, got both. Omit either "
            "duration or tau_d, because the primitive fixes their ratio."
        )
    if tau_d is not None:
        return positive(tau_d, "tau_d [s]", "A typical value is 1 s.")
    if duration is None:
        return dmp.tau_d
    return positive(duration, "duration [s]", "A typical value is 1 s.") * dmp.tau_d / dmp.duration


def _check_one_run(parts: dict[str, np.ndarray], shape: tuple[int, ...]) -> None:
    for name, part in parts.items():
        if part.shape != shape:
            raise ShapeError(
                f"Expected {name} of shape {shape} for one run, got {part.shape}. Use rollout_batch for many runs, or "
                "one stepper per run."
            )


def _many_runs(dmp: Equation, parts: dict[str, np.ndarray], shape: tuple[int, ...]) -> tuple[int, ...]:
    if dmp.scaling == "rotate":
        raise ConfigError("Expected a scaling other than 'rotate' for a batch, got 'rotate'. Use rollout for each run.")
    try:
        return np.broadcast_shapes(shape, *(part.shape for part in parts.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {part.shape}" for name, part in parts.items())
        raise ShapeError(
            f"Expected arrays with the same number of runs K, got {shapes}. Pass (K, n) or (n,)."
        ) from None


def check_goal(dmp: Equation, g: np.ndarray) -> None:
    """Raise an error if a goal is outside the limits of the primitive."""
    if dmp.limits is None:
        return
    low, high = dmp.limits
    outside = np.unique(np.nonzero((g < low) | (g > high))[-1])
    if len(outside):
        raise ShapeError(
            f"Expected a goal within the limits, got coordinates {outside.tolist()} of {g} outside {low[outside]} to "
            f"{high[outside]}. Choose another goal."
        )


def goal_scale(dmp: Equation, y0: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the ratio (..., n) of the displacement to the demonstrated displacement; 1 if the demonstrated
    displacement is too small."""
    way = dmp.g - dmp.y0
    still = np.zeros(dmp.n, dtype=bool)
    still[list(dmp.unscaled)] = True
    return np.where(still, 1.0, (g - y0) / np.where(still, 1.0, way))


def rotation(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return the smallest rotation, scaled by the ratio of lengths, from the old to the new displacement (3, 3)."""
    a, b = np.linalg.norm(old), np.linalg.norm(new)
    if not (a > 0 and b > 0):
        raise ShapeError(
            "Expected a goal different from the start with scaling 'rotate', got the same point. Use scaling 'none'."
        )
    u, v = old / a, new / b
    axis, cosine = np.cross(u, v), float(u @ v)
    if cosine < 0 and np.linalg.norm(axis) < HALF_TURN:
        raise ShapeError(
            "Expected a displacement that is not opposite to that of the demonstration, got "
            "a rotation by half a turn, whose axis is ambiguous. Use an intermediate goal."
        )
    skew = so3.hat(axis)
    return b / a * (np.eye(3) + skew + skew @ skew / (1.0 + cosine))


def advance(dt: float, *steppers: Any) -> list[Any]:
    """Advance compiled steppers by dt [s] and return their results."""
    try:
        return [one.step(dt) for one in steppers]
    except TypeError:
        number(dt, "dt [s]")  # raises an error with a clear message
        raise


class Stepper:
    """Sample-by-sample run of a `Dmp`; created by `Dmp.stepper`.

    The stepper is equivalent to `Dmp.rollout`, but step sizes may vary, and the goal and duration may change. A
    filtered goal follows ``g' = rate (goal - g) / tau_d``, and the forcing is scaled with the filtered goal. After a
    goal change, a brake enforces ``v^2 <= 2 a |goal - y|`` where possible, and keeps y on the same side of the goal.

    Parameters
    ----------
    run : the run, with start, goal and time.
    goal_forcing : "shift" or "scale"; None: the default for the scaling.
    goal_rate : product of tau_d and the rate of the goal filter.
    brake : whether to brake in monotone coordinates.
    around : obstacles to avoid, as `armlab.kernels.Obstacles`.

    Raises
    ------
    UnknownName : unknown goal_forcing.
    ConfigError : "scale" without scaling "goal", or a negative goal_rate.
    """

    def __init__(
        self,
        run: RunParameters,
        goal_forcing: str | None = None,
        goal_rate: float = 0.0,
        brake: bool = False,
        around: Any = None,
    ) -> None:
        dmp = run.dmp
        if goal_forcing is None:
            goal_forcing = "scale" if dmp.scaling == "goal" else "shift"
        check_name(goal_forcing, "goal_forcing", FORCINGS)
        if goal_forcing == "scale" and dmp.scaling != "goal":
            raise ConfigError(
                f"Expected goal_forcing 'shift' with scaling {dmp.scaling!r}, got 'scale'. Fit with scaling='goal'."
            )
        self._dmp, self._run, self._scales = dmp, run, goal_forcing == "scale"
        self._limit = np.where(dmp.monotone, BRAKE * dmp.peak_acceleration, 0.0) if brake else None
        self._kernel = kernels.PrimitiveStepper(run.primitive, at_least_zero(goal_rate, "goal_rate"), around)
        self.reset()

    def reset(self) -> None:
        """Return to the start and restore the initial goal and duration."""
        run = self._run
        self._t, self._goal = 0.0, run.g
        self._kernel.start(run.y0, run.v0, run.g, run.scale, run.tau)

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return y, yd, ydd, each (n,).

        Parameters
        ----------
        dt : time since the last sample [s], above zero.

        Raises
        ------
        ShapeError : dt is not finite and positive.
        """
        state = advance(dt, self._kernel)[0]
        self._t += dt
        return state

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Current position, velocity and acceleration, each (n,)."""
        return self._kernel.outputs()

    @property
    def t(self) -> float:
        """Time since the start [s]."""
        return self._t

    @property
    def x(self) -> np.ndarray:
        """Current phase; (n,) with one phase per coordinate."""
        if self._dmp.schedule == "position":
            return progress(self.state[0], self._run.y0, self._goal)
        return self._dmp.phase(self._kernel.elapsed * self._dmp.tau_d)

    @property
    def goal(self) -> np.ndarray:
        """Current goal (n,), before the filter."""
        return self._goal

    @property
    def duration(self) -> float:
        """Duration of the whole motion at the current time constant [s]."""
        return self._kernel.tau * self._dmp.duration / self._dmp.tau_d

    def change_goal(self, g: ArrayLike) -> None:
        """Change the goal.

        Parameters
        ----------
        g : (n,) goal, in the unit of y.

        Raises
        ------
        ShapeError : wrong shape, not finite, outside the limits of the primitive.
        """
        run = self._run.towards(g, self._scales)
        self._kernel.change_goal(run.g, run.scale, self._limit)
        self._goal = run.g

    def change_duration(self, duration: float) -> None:
        """Change the duration; the velocity stays continuous.

        Parameters
        ----------
        duration : duration of the whole motion at this time constant [s].

        Raises
        ------
        ShapeError : duration is not finite and positive.
        """
        value = positive(duration, "duration [s]", "A typical value is 1 s.")
        self._kernel.change_tau(value * self._dmp.tau_d / self._dmp.duration)


def solved(run: RunParameters, t: np.ndarray, rtol: float, atol: float) -> Rollout:
    """Integrate a run at increasing times t (N,) [s] with the Dormand-Prince method of order 8."""
    from scipy.integrate import solve_ivp

    if not (0 < number(rtol, "rtol", ConfigError) < 1 and 0 < number(atol, "atol", ConfigError) < np.inf):
        raise ConfigError(f"Expected tolerances above zero, got rtol {rtol:g} and atol {atol:g}. Try 1e-10.")
    if t.ndim != 1 or not len(t) or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise ShapeError(f"Expected increasing times (N,), got shape {t.shape}. Drop repeated samples.")
    dmp = run.dmp
    if not t[-1] - t[0] <= LONGEST * run.tau:
        raise ShapeError(
            f"Expected times within {LONGEST:g} time constants, got {(t[-1] - t[0]) / run.tau:.3g}. Use a shorter "
            "motion."
        )
    n, s = dmp.n, (t - t[0]) / run.tau
    alpha, stiffness, pace = dmp.alpha_z, dmp.alpha_z * dmp.beta_z, dmp.tau_d / dmp.duration

    def phase(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        return progress(y, run.y0, run.g) if dmp.schedule == "position" else dmp.phase(s * dmp.tau_d)

    def slope(s: np.ndarray, state: np.ndarray) -> np.ndarray:
        y, z = state[:n], state[n:]
        f = run.scale * run.primitive.forcing(phase(s, y))
        return np.concatenate([z, stiffness * (run.g - y) - alpha * z + f])

    # The forcing is not smooth at the ends of the time gate.
    breaks = [b / pace for b in (1.0, 1.1) if dmp.schedule == "time" and b / pace < s[-1]]
    state, rows = np.concatenate([run.y0, run.tau * run.v0]), []
    for begin, end in zip([0.0, *breaks], [*breaks, s[-1]]):
        last = end == s[-1]
        inside = s[(s >= begin) & ((s < end) | last)]
        if begin == end:  # a single time
            rows.append(state[None])
            continue
        at = inside if last else np.append(inside, end)
        found = solve_ivp(slope, (begin, end), state, "DOP853", at, rtol=rtol, atol=atol, max_step=(end - begin) / 20)
        if not found.success:
            raise NotConverged(
                f"Expected the integration to succeed, but it failed: {found.message} Loosen the tolerances."
            )
        rows.append(found.y.T[: len(inside)])
        state = found.y[:, -1]
    y, z = np.split(np.concatenate(rows), 2, axis=1)
    x = phase(s, y)
    f = run.scale * run.primitive.forcing(x)
    return Rollout(t, y, z / run.tau, (stiffness * (run.g - y) - alpha * z + f) / run.tau**2, x, f)


def progress(y: np.ndarray, y0: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the phase of schedule "position": ``(g - y) / (g - y0)``, clipped to [0, 1]; 0 without displacement."""
    way = g - y0
    return np.where(way == 0, 0.0, np.clip((g - y) / np.where(way == 0, 1.0, way), 0.0, 1.0))
