"""Dynamic movement primitive: a spring towards the goal with a learned forcing term."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import generator, number, numbers
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation.fit import Fit, value_of
from armlab.motion.arguments import clock
from armlab.motion.control import Arms, Controller, JointLimits, Pace, at_pace, check_joints, own_steps
from armlab.motion.primitive.equation import Equation
from armlab.motion.primitive.run import Rollout, RunOptions, RunParameters, Stepper, progress, solved
from armlab.motion.storage import Saved
from armlab.state import State


@dataclass(frozen=True, eq=False, repr=False)
class Dmp(Equation, Saved, kind="dmp"):
    """Movement primitive of n coordinates that share one phase.

    ``tau_d^2 ydd = alpha_z (beta_z (g - y) - tau_d yd) + s (psi(x) w) x``, ``tau_d x' = -alpha_x x``: a critically
    damped spring towards the goal, and a decaying forcing term. The weights have the unit of the demonstration; s
    scales the forcing with the goal (`scaling`). With `schedule` "time", the phase is time / duration, and after the
    end, the forcing fades out over a tenth of the duration. With "position", each coordinate has its own phase, namely
    its progress towards the goal.

    Attributes
    ----------
    weights : (n_basis, n) kernel weights, in the unit of y.
    centres, widths : (n_basis,) kernel centres and widths (standard deviations) in the phase.
    tau_d, duration : time constant and duration of the demonstration [s].
    y0, v0, g : (n,) start, start velocity and goal of the demonstration.
    extent : (n,) range of the demonstration.
    peak_acceleration : (n,) largest acceleration of the demonstration.
    monotone : (n,) whether each coordinate moves in one direction only.
    alpha_z, beta_z, alpha_x : spring and phase constants.
    schedule : "canonical", "time" or "position".
    scaling : scaling of the forcing: "goal", "none", "amplitude" or "rotate".
    convention : choice of alpha_x and tau_d: "lund" (1, a third of the duration) or "ijspeert" (alpha_z / 3, the
        duration).
    demo_weights : (M, n_basis, n) weights of M >= 3 individual demonstrations; None for fewer demonstrations.
    limits : (2, n) lowest and highest accepted goal; None: no limits.

    References
    ----------
    Ijspeert, Nakanishi, Hoffmann, Pastor and Schaal (2013), Neural Computation 25(2), 328-373. Derivations:
    docs/theory/dmp.md.
    """

    @property
    def weight_covariance(self) -> np.ndarray:
        """Covariance (n_basis n, n_basis n) of the weights across demonstrations, with the weights in C order.

        Raises
        ------
        ConfigError : the primitive was fitted to fewer than three demonstrations.
        """
        apart = self._covariance_root().reshape(len(self._covariance_root()), -1)
        return apart.T @ apart

    def sample(self, rng: np.random.Generator) -> Dmp:
        """Return the primitive with weights drawn from ``N(mean, weight_covariance)`` of its demonstrations.

        Parameters
        ----------
        rng : random number generator.

        Raises
        ------
        ConfigError : the primitive was fitted to fewer than three demonstrations.
        """
        apart = self._covariance_root()
        drawn = np.tensordot(generator(rng).standard_normal(len(apart)), apart, 1)
        return replace(self, weights=self._mean_weights + drawn)

    @property
    def _mean_weights(self) -> np.ndarray:
        """Mean (n_basis, n) of the demonstrations' weights; for fewer than three, the fitted weights."""
        return self.weights if self.demo_weights is None else self.demo_weights.mean(axis=0)

    def _covariance_root(self) -> np.ndarray:
        """Return a square root of the covariance: the deviations of the demonstrations divided by sqrt(M - 1)."""
        if self.demo_weights is None:
            raise ConfigError(
                "Expected a primitive fitted to at least 3 demonstrations, got a primitive without demo_weights. Fit "
                "it to more demonstrations."
            )
        return (self.demo_weights - self._mean_weights) / np.sqrt(len(self.demo_weights) - 1)

    def times(self, dt: float, duration: float | None = None) -> np.ndarray:
        """Return times from 0 in steps of `dt` to the end of a motion [s].

        Parameters
        ----------
        dt : step [s].
        duration : duration of the motion [s]; default: from the demonstration.

        Raises
        ------
        ShapeError : the step is not finite and positive.
        """
        return clock(number(dt, "dt [s]"), self.duration if duration is None else duration)

    def rollout(self, t: ArrayLike, **run: Unpack[RunOptions]) -> Rollout:
        """Run the primitive with one step per interval; steps are exact for the spring and of fourth order in the
        forcing term.

        Omitted arguments default to the values of the demonstration. Use `solve` if the times are far apart compared
        with the kernel widths.

        Parameters
        ----------
        t : (N,) increasing times [s], relative to the first; or a time step [s] for a run to the end of the motion.
        **run : `RunOptions`: ``duration`` or ``tau_d`` of the run [s]; ``y0``, ``v0``, ``g`` (n,): start, start
            velocity, goal; ``amplitude`` (n,): factors on the forcing, with scaling "amplitude".

        Raises
        ------
        ShapeError : non-increasing times, wrong shapes, or NaN.
        ConfigError : both duration and tau_d are given.
        """
        return self._run(RunParameters.of(self, **run), t)

    def rollout_batch(self, t: ArrayLike, *, weights: ArrayLike | None = None, **run: Unpack[RunOptions]) -> Rollout:
        """Run the primitive K times on a common clock; the arrays (N, K, n) equal those of K rollouts.

        Parameters
        ----------
        t : as in `rollout`.
        weights : (K, n_basis, n) weights of each run; default: the fitted weights.
        **run : as in `rollout`; ``y0``, ``v0``, ``g``, ``amplitude`` (K, n) or (n,).

        Raises
        ------
        ShapeError, ConfigError : as in `rollout`, or if the scaling is "rotate".
        """
        own = None if weights is None else numbers(weights, "weights", ShapeError)
        if own is not None and own.shape[1:] != self.weights.shape:
            raise ShapeError(
                f"Expected weights of shape (K, {self.n_basis}, {self.n}), got {own.shape}. Keep the number of "
                "kernels and coordinates of the primitive."
            )
        return self._run(RunParameters.of(self, 1 if own is None else len(own), **run), t, own)

    def _run(self, run: RunParameters, t: ArrayLike, weights: np.ndarray | None = None) -> Rollout:
        times = run.times(t)
        y, yd, ydd, x, f = run.primitive.rollout(times, run.tau, run.y0, run.v0, run.g, run.scale, weights)
        if self.schedule == "position":
            x = progress(y, run.y0, run.g)
        return Rollout(times, y, yd, ydd, x, f)

    def solve(self, t: ArrayLike, *, rtol: float = 1e-10, atol: float = 1e-12, **run: Unpack[RunOptions]) -> Rollout:
        """Integrate the primitive adaptively (Dormand-Prince, order 8): slow, but an accurate reference for `rollout`.

        Parameters
        ----------
        t : as in `rollout`.
        rtol, atol : tolerances.
        **run : as in `rollout`.

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
        """Return a stepper that runs the primitive sample by sample; the goal and duration may change.

        Parameters
        ----------
        goal_forcing : effect of a goal change on the forcing: "shift" leaves the forcing unchanged, "scale" scales the
            forcing with the displacement. Default: "scale" with scaling "goal", otherwise "shift".
        goal_rate : product of tau_d and the rate of a first-order goal filter; 0: no filter.
        brake : keep ``v^2 <= 2 a |g - y|`` in monotone coordinates after a goal change, where a is 1.05 times the
            peak acceleration of the demonstration.
        **run : as in `rollout`.

        Raises
        ------
        ShapeError, ConfigError : as in `rollout`.
        UnknownName : unknown goal_forcing.
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
        """Return a controller ``State -> Command`` for `armlab.bridge` that starts at rest at the measured position.

        The controller sends the path in open loop; `TwoDofDmp.controller` makes the path wait for an arm that is held
        back.

        Parameters
        ----------
        robot : the arm whose joints are the coordinates, or several arms with stacked joints.
        limits : object with q_min, q_max, qd_max and qdd_max (n,), such as `bridge.Limits`, one per arm; default:
            from the robots.
        duration, g, amplitude : as in `rollout`.

        Raises
        ------
        ShapeError : wrong number of joints, or a goal outside the limits.
        ConfigError : as in `rollout`.
        """
        return DmpController(robot, self, {"duration": duration, "g": g, "amplitude": amplitude}, limits)


class DmpController(Controller):
    """Open-loop controller of a `Dmp`: sends the path and its velocity regardless of the measured state."""

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


FINE = 4000  # minimum number of response steps over a duration
GRID = 401  # number of time points at which the path change is evaluated
RIDGE = 1e-7  # relative to the largest singular value; keeps weight directions without effect on the path unchanged
SAME = 1e-10  # minimum eigenvalue of the correlation matrix of linearly independent via-points
MAX_ITERATIONS = 3  # iterative refinement of the last digits


def with_via_points(dmp: Dmp | Fit[Dmp], t: ArrayLike, y: ArrayLike | None = None, yd: ArrayLike | None = None) -> Dmp:
    """Return a copy of the primitive, modified as little as possible to reach given positions or velocities at given
    times.

    The motion is linear in the weights, so via-points are linear constraints ``C dw = c``. Among all solutions, the
    change with the smallest ``sum |dy|^2`` over the duration is selected. A run with the start, goal and duration of
    the demonstration passes through the via-points; other runs are scaled versions of this motion.

    If a velocity is prescribed at the end of the motion, the primitive does not end at rest: continue with
    `profiles.quintic` or another primitive. Without a continuation, the motion returns to the goal and settles
    there.

    Parameters
    ----------
    dmp : primitive with a time-based phase.
    t : (k,) times since the start of the demonstration [s], above 0.
    y : (k, n) positions.
    yd : (k, n) velocities.

    Raises
    ------
    ShapeError : neither positions nor velocities, wrong shapes, NaN, repeated times or times outside the duration.
    ConfigError : schedule "position".
    NotExcited : more points than the weights can satisfy.
    """
    dmp = value_of(dmp)
    if dmp.schedule == "position":
        raise ConfigError(
            "Expected a time-dependent phase for via-points, got schedule 'position'. Use 'canonical' or 'time'."
        )
    times = np.atleast_1d(numbers(t, "t", ShapeError))
    inside = (
        times.ndim == 1 and np.isfinite(times).all() and np.all((times > 0.0) & (times <= dmp.duration * (1 + 1e-12)))
    )
    if not inside or len(np.unique(times)) != len(times):
        raise ShapeError(
            f"Expected distinct times (k,) above 0 and up to the duration, {dmp.duration:g} s, got {times.tolist()}."
        )
    wanted = [_points(values, what, len(times), dmp.n) for values, what in ((y, "y"), (yd, "yd")) if values is not None]
    if not wanted:
        raise ShapeError("Expected via-point positions or velocities, got neither y nor yd. Pass at least one of them.")
    kinds = [k for k, values in enumerate((y, yd)) if values is not None]
    grid = np.unique(np.concatenate([np.linspace(0.0, dmp.duration, GRID), times]))
    responses = dmp._primitive.response(grid, dmp.tau_d, dmp.duration / FINE)
    rows = np.searchsorted(grid, times)
    C = np.concatenate([responses[k][rows, :-3] for k in kinds])
    change = _least_change(responses[0][:, :-3], C)
    ends = np.stack([dmp.y0, dmp.v0, dmp.g])
    constant = np.concatenate([responses[k][rows, -3:] for k in kinds]) @ ends
    weights = dmp.weights
    for _ in range(MAX_ITERATIONS):
        weights = weights + change @ (np.concatenate(wanted) - constant - C @ weights)
    return replace(dmp, weights=weights)


def _least_change(Y: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the matrix (m, r) that maps residuals c to the weight change with the least ``|Y dw|`` for ``C dw =
    c``."""
    s, V = np.linalg.svd(Y, full_matrices=False)[1:]
    inverse = V.T / np.sqrt(s**2 + (RIDGE * s[0]) ** 2)  # inverse of a square root of the quadratic form
    steps = C @ inverse
    gram = steps @ steps.T
    values = np.linalg.eigvalsh(gram / np.sqrt(np.outer(gram.diagonal(), gram.diagonal())))
    if not values[0] > SAME:
        raise NotExcited(
            f"Expected via-points that {Y.shape[1]} weights can satisfy independently, got linearly dependent "
            "via-points. Use fewer via-points, or increase their spacing.",
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
