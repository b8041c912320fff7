"""The dynamic movement primitive: a spring that a learned force bends on its way to the goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import generator, number, numbers
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.motion.arguments import clock
from armlab.motion.control import Arms, Controller, JointLimits, Pace, at_pace, check_joints, own_steps
from armlab.motion.primitive.equation import Equation
from armlab.motion.primitive.run import Rollout, RunOptions, RunParameters, Stepper, progress, solved
from armlab.motion.storage import Saved
from armlab.state import State


@dataclass(frozen=True, eq=False)
class Dmp(Equation, Saved, kind="dmp"):
    """A movement primitive of n coordinates that share one phase.

    ``tau_d^2 ydd = alpha_z (beta_z (g - y) - tau_d yd) + s (psi(x) w) x``, ``tau_d x' = -alpha_x x``: a critically
    damped spring to the goal and a forcing term that fades. The weights are in the size of the demonstration; s scales
    the forcing with the goal (`scaling`). With `schedule` "time" the phase is time over duration and the forcing fades
    over the tenth after it; with "position" each coordinate's own progress is its phase.

    Attributes
    ----------
    weights : (n_basis, n) of the kernels, in the unit of y. centres, widths : (n_basis,) of them in the phase; widths
        are standard deviations.
    tau_d, duration : time constant and duration of the demonstration [s].
    y0, v0, g : (n,) its start, velocity at the start, and goal.
    extent : (n,) its range. peak_acceleration : (n,) its largest acceleration. monotone : (n,) whether it never turned.
    alpha_z, beta_z, alpha_x : constants of the spring and of the phase.
    schedule : "canonical", "time" or "position". scaling : of the forcing: "goal", "none", "amplitude" or "rotate".
    convention : of alpha_x and tau_d: "lund" (1, a third of the duration) or "ijspeert" (alpha_z / 3, the duration).
    demo_weights : (M, n_basis, n) of each of M >= 3 demonstrations; None where there were fewer.
    limits : (2, n) lowest and highest goal that is accepted; None for any.

    References
    ----------
    Ijspeert, Nakanishi, Hoffmann, Pastor and Schaal (2013), Neural Computation 25(2), 328-373. Derivations:
    docs/theory/dmp.md.
    """

    @property
    def weight_covariance(self) -> np.ndarray:
        """Covariance (n_basis n, n_basis n) of the weights between demonstrations, weights in C order.

        Raises
        ------
        ConfigError : it was fitted to fewer than three demonstrations.
        """
        apart = self._apart().reshape(len(self._apart()), -1)
        return apart.T @ apart

    def sample(self, rng: np.random.Generator) -> Dmp:
        """Return the primitive with weights drawn from ``N(mean, weight_covariance)`` of its demonstrations.

        Parameters
        ----------
        rng : of the random numbers.

        Raises
        ------
        ConfigError : it was fitted to fewer than three demonstrations.
        """
        apart = self._apart()
        drawn = np.tensordot(generator(rng).standard_normal(len(apart)), apart, 1)
        return replace(self, weights=self._mean_weights + drawn)

    @property
    def _mean_weights(self) -> np.ndarray:
        """Mean (n_basis, n) of the weights of the demonstrations; the weights where there were fewer than three."""
        return self.weights if self.demo_weights is None else self.demo_weights.mean(axis=0)

    def _apart(self) -> np.ndarray:
        """Return a root of the covariance: deviations of the demonstrations over the root of their number less one."""
        if self.demo_weights is None:
            raise ConfigError(
                "Expected a primitive of at least three demonstrations, got one without demo_weights. Fit it to more."
            )
        return (self.demo_weights - self._mean_weights) / np.sqrt(len(self.demo_weights) - 1)

    def times(self, dt: float, duration: float | None = None) -> np.ndarray:
        """Return times from 0 in steps of `dt` to the end of a motion [s].

        Parameters
        ----------
        dt : step [s]. duration : of the motion [s]; that of the demonstration when left out.

        Raises
        ------
        ShapeError : no finite step above zero.
        """
        return clock(number(dt, "dt [s]"), self.duration if duration is None else duration)

    def rollout(self, t: ArrayLike, **run: Unpack[RunOptions]) -> Rollout:
        """Run the primitive with one step per interval: the spring exactly, the forcing to fourth order.

        What is left out is that of the demonstration. Where the times are far apart, compared with the kernels, use
        `solve`.

        Parameters
        ----------
        t : (N,) increasing times [s], the motion starts at the first; or one step [s] until the end of the motion.
        **run : `RunOptions`: ``duration`` or ``tau_d`` of the run [s]; ``y0``, ``v0``, ``g`` (n,): start, velocity at
            it, goal; ``amplitude`` (n,): factors on the forcing, with scaling "amplitude".

        Raises
        ------
        ShapeError : times that do not increase, other shapes, NaN. ConfigError : both duration and tau_d.
        """
        return self._run(RunParameters.of(self, **run), t)

    def rollout_batch(self, t: ArrayLike, *, weights: ArrayLike | None = None, **run: Unpack[RunOptions]) -> Rollout:
        """Run the primitive K times over one clock; arrays (N, K, n), equal to K rollouts.

        Parameters
        ----------
        t : as in `rollout`.
        weights : (K, n_basis, n) of each run; its own when left out.
        **run : as in `rollout`; ``y0``, ``v0``, ``g``, ``amplitude`` (K, n) or (n,).

        Raises
        ------
        ShapeError, ConfigError : as in `rollout`, or scaling "rotate".
        """
        own = None if weights is None else numbers(weights, "weights", ShapeError)
        if own is not None and own.shape[1:] != self.weights.shape:
            raise ShapeError(
                f"Expected weights of shape (K, {self.n_basis}, {self.n}), got {own.shape}. Fit with as many kernels."
            )
        return self._run(RunParameters.of(self, 1 if own is None else len(own), **run), t, own)

    def _run(self, run: RunParameters, t: ArrayLike, weights: np.ndarray | None = None) -> Rollout:
        times = run.times(t)
        y, yd, ydd, x, f = run.primitive.rollout(times, run.tau, run.y0, run.v0, run.g, run.scale, weights)
        if self.schedule == "position":
            x = progress(y, run.y0, run.g)
        return Rollout(times, y, yd, ydd, x, f)

    def solve(self, t: ArrayLike, *, rtol: float = 1e-10, atol: float = 1e-12, **run: Unpack[RunOptions]) -> Rollout:
        """Solve the primitive adaptively (Dormand and Prince, order 8): the reference of `rollout`, and slow.

        Parameters
        ----------
        t : as in `rollout`. rtol, atol : tolerances. **run : as in `rollout`.

        Raises
        ------
        ShapeError, ConfigError : as in `rollout`.
        """
        setting = RunParameters.of(self, **run)
        return solved(setting, setting.times(t), rtol, atol)

    def stepper(
        self,
        *,
        goal_forcing: str | None = None,
        goal_rate: float = 0.0,
        brake: bool = False,
        **run: Unpack[RunOptions],
    ) -> Stepper:
        """Return what runs the primitive sample by sample, with a goal and a duration that may change on the way.

        Parameters
        ----------
        goal_forcing : of a goal that changes: "shift" leaves the forcing, "scale" scales it with the displacement;
            "scale" where the scaling is "goal", otherwise "shift".
        goal_rate : of a first-order filter of the goal, times tau_d; 0 for none.
        brake : keep ``v^2 <= 2 a |g - y|`` in monotone coordinates after a change of goal, a 1.05 times the largest
            acceleration of the demonstration.
        **run : as in `rollout`.

        Raises
        ------
        ShapeError, ConfigError : as in `rollout`. UnknownName : another goal_forcing.
        """
        return Stepper(RunParameters.of(self, **run), goal_forcing, goal_rate, brake)

    def controller(
        self,
        robot: Arms,
        *,
        limits: JointLimits | Sequence[JointLimits] | None = None,
        duration: float | None = None,
        g: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> Controller:
        """Return a controller ``State -> Command`` for `armlab.bridge`, which starts where the arm is, at rest.

        It tells the arm the path, whatever the arm does; `TwoDofDmp.controller` waits for an arm that was held up.

        Parameters
        ----------
        robot : the arm whose joints the coordinates are, or several arms whose joints are one after another.
        limits : what has q_min, q_max, qd_max and qdd_max (n,), such as `bridge.Limits`, one per arm;
            those of the robots when None.
        duration, g, amplitude : as in `rollout`.

        Raises
        ------
        ShapeError : a primitive of another number of joints, a goal outside the limits. ConfigError : as in `rollout`.
        """
        return DmpController(robot, self, {"duration": duration, "g": g, "amplitude": amplitude}, limits)


class DmpController(Controller):
    """A plain `Dmp`, or its kind with a stepper: the arm is told the path and its velocity, whatever it does."""

    def __init__(
        self,
        robot: Arms,
        dmp: Any,
        settings: Mapping[str, Any],
        limits: JointLimits | Sequence[JointLimits] | None = None,
    ) -> None:
        check_joints(robot, dmp.n)
        self._dmp, self._settings = dmp, settings
        self._stepper: Any = dmp.stepper(**settings)
        super().__init__(robot, limits, self._stepper.goal)

    def _begin(self, state: State) -> None:
        given = {**self._settings, "g": self._goal, "y0": state.q, "v0": np.zeros_like(state.q)}
        self._stepper = self._dmp.stepper(**given)

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        for h in own_steps(dt, pace):
            self._stepper.step(h)
        return at_pace(self._stepper.state, pace)

    def _change_goal(self, g: np.ndarray) -> None:
        self._stepper.change_goal(g)

    @property
    def _is_over(self) -> bool:
        return self._stepper.t >= self._stepper.duration


FINE = 4000  # steps of the response over a duration, at least
GRID = 401  # times at which the change of the path is measured
RIDGE = 1e-7  # of the largest singular value: what the path does not tell of the weights stays as it is
SAME = 1e-10
ROUNDS = 3  # the last digits


def with_via_points(dmp: Dmp, t: ArrayLike, y: ArrayLike | None = None, yd: ArrayLike | None = None) -> Dmp:
    """Return the primitive whose own motion passes positions or velocities at given times, changed least elsewhere.

    The motion is linear in the weights, so points are linear conditions ``C dw = c``. Of all changes of the weights
    that meet them the one with the least ``sum |dy|^2`` over the duration is taken. The motion with the start, goal and
    duration of the demonstration passes the points; others scale with it.

    With the time of the end, its goal and a velocity the motion ends moving: hand it over there, to `profiles.quintic`
    or another primitive; if it runs on it comes back to the goal and settles.

    Parameters
    ----------
    dmp : with a phase of time. t : (k,) times since the start, in the time of the demonstration [s], above 0.
    y : (k, n) positions. yd : (k, n) velocities.

    Raises
    ------
    ShapeError : neither positions nor velocities, shapes, NaN, times outside the duration or twice.
    ConfigError : schedule "position". NotExcited : more points than the weights can meet.
    """
    if dmp.schedule == "position":
        raise ConfigError(
            "Expected a phase of time for via-points, got schedule 'position'. Use 'canonical' or 'time'."
        )
    times = np.atleast_1d(numbers(t, "t", ShapeError))
    inside = (
        times.ndim == 1 and np.isfinite(times).all() and np.all((times > 0.0) & (times <= dmp.duration * (1 + 1e-12)))
    )
    if not inside or len(np.unique(times)) != len(times):
        raise ShapeError(
            f"Expected different times (k,) above 0 and up to the duration, {dmp.duration:g} s, got {times.tolist()}."
        )
    wanted = [_points(values, what, len(times), dmp.n) for values, what in ((y, "y"), (yd, "yd")) if values is not None]
    if not wanted:
        raise ShapeError("Expected positions or velocities to pass, got neither. Give y or yd.")
    kinds = [k for k, values in enumerate((y, yd)) if values is not None]
    grid = np.unique(np.concatenate([np.linspace(0.0, dmp.duration, GRID), times]))
    responses = dmp._primitive.response(grid, dmp.tau_d, dmp.duration / FINE)
    rows = np.searchsorted(grid, times)
    C = np.concatenate([responses[k][rows, :-3] for k in kinds])
    change = _least_change(responses[0][:, :-3], C)
    ends = np.stack([dmp.y0, dmp.v0, dmp.g])
    constant = np.concatenate([responses[k][rows, -3:] for k in kinds]) @ ends
    weights = dmp.weights
    for _ in range(ROUNDS):
        weights = weights + change @ (np.concatenate(wanted) - constant - C @ weights)
    return replace(dmp, weights=weights)


def _least_change(Y: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return what makes changes of the weights (m, r) of what is missed: least ``|Y dw|`` with ``C dw`` as asked."""
    s, V = np.linalg.svd(Y, full_matrices=False)[1:]
    inverse = V.T / np.sqrt(s**2 + (RIDGE * s[0]) ** 2)  # of a root of the quadratic form
    steps = C @ inverse
    gram = steps @ steps.T
    values = np.linalg.eigvalsh(gram / np.sqrt(np.outer(gram.diagonal(), gram.diagonal())))
    if not values[0] > SAME:
        raise NotExcited(
            f"Expected points that {Y.shape[1]} weights can meet one by one, got some that are not independent. "
            "Give fewer, or further apart.",
            ["via-points"],
            [f"{values[0]:.1e}"],
        )
    return inverse @ steps.T @ np.linalg.inv(gram)


def _points(value: ArrayLike, what: str, k: int, n: int) -> np.ndarray:
    points = numbers(value, what, ShapeError)
    points = points.reshape(k, n) if points.size == k * n and points.ndim < 2 else points
    if points.shape != (k, n) or not np.isfinite(points).all():
        raise ShapeError(f"Expected finite {what} of shape ({k}, {n}), one row per time, got shape {points.shape}.")
    return points
