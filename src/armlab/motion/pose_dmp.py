"""Movement primitive for poses: position and orientation share one phase."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import dist
from typing import Any, ClassVar, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._display import Shown
from armlab._numbers import check_name, make_read_only, numbers, still
from armlab.errors import ConfigError, NotConverged, ShapeError
from armlab.estimation import Fit
from armlab.kinematics import forward, inverse
from armlab.lie import quaternion, so3
from armlab.motion.arguments import vector
from armlab.motion.control import NEAR, Controller, JointLimits, Pace, own_steps
from armlab.motion.dmp import Dmp
from armlab.motion.primitive.demonstrations import read_demos
from armlab.motion.primitive.equation import SCALINGS, SCHEDULES
from armlab.motion.primitive.fit import fit_dmp
from armlab.motion.primitive.run import RunParameters, advance
from armlab.motion.primitive.weights import solve
from armlab.motion.storage import Saved
from armlab.robots import Robot
from armlab.state import State

FRAMES = ("base", "goal")
SHARED = ("centres", "widths", "tau_d", "duration", "alpha_z", "beta_z", "alpha_x", "schedule", "convention")

Sample = tuple[np.ndarray, np.ndarray, np.ndarray]

HALF_TURN = 1e-6  # rad: closer to half a turn, the shorter rotation is ambiguous
LENGTH = 1e-3  # largest error of a quaternion norm that normalisation corrects


class PoseRunOptions(TypedDict, total=False):
    """Options of a run of a `PoseDmp`; options that are omitted or None take the values of the demonstration."""

    duration: float | None
    tau_d: float | None
    start: ArrayLike | None
    twist0: ArrayLike | None
    goal: ArrayLike | None


@dataclass(frozen=True, eq=False, repr=False)
class PoseRollout(Shown):
    """Trajectory of poses at N times.

    Attributes
    ----------
    t : (N,) times [s].
    T : (N, 4, 4) poses.
    q : (N, 4) orientations as quaternions wxyz with continuous signs.
    twist : (N, 6) velocity and angular velocity, base axes [m/s, rad/s].
    twistd : (N, 6) time derivative of `twist`.
    x : (N,) phase.
    """

    t: np.ndarray
    T: np.ndarray
    q: np.ndarray
    twist: np.ndarray
    twistd: np.ndarray
    x: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, "t", "T", "q", "twist", "twistd", "x")


@dataclass(frozen=True, eq=False, repr=False)
class PoseDmp(Saved, kind="pose_dmp"):
    """Movement primitive of poses.

    The position is a `Dmp`. The orientation is driven by a spring along the shorter rotation to its goal, and by a
    forcing term with the same phase. The forcing is scaled by the rotation vector from start to goal
    (docs/theory/pose_dmp.md).

    Attributes
    ----------
    position : primitive of the three position coordinates [m].
    rotation : primitive of the rotation vector from the goal, in base axes [rad]. y0 rotates the goal to the start, and
        g is 0.
    goal : (4,) orientation wxyz at the end of the demonstration.
    frame : axes of the forcing, "base" or "goal". Goal axes rotate with the goal: moving start and goal together moves
        the whole path.

    Raises
    ------
    ShapeError : position and rotation with different phases, or a goal that is not a quaternion.
    UnknownName : unknown frame.

    References
    ----------
    Ude, Nemec, Petric and Morimoto, Orientation in Cartesian space dynamic movement primitives, ICRA 2014.
    """

    position: Dmp
    rotation: Dmp
    goal: np.ndarray
    frame: str = "base"

    UNITS: ClassVar[dict[str, str]] = {"goal": "1"}

    def __post_init__(self) -> None:
        check_name(self.frame, "frame of the forcing", FRAMES)
        for what, part in (("position", self.position), ("rotation", self.rotation)):
            if not isinstance(part, Dmp) or part.n != 3 or part.schedule == "position":
                raise ShapeError(
                    f"Expected the {what} to be a Dmp of three coordinates with a time-dependent phase, got "
                    f"{part!r:.50}. Use armlab.motion.fit_pose_dmp."
                )
        for name in SHARED:
            if not np.array_equal(getattr(self.position, name), getattr(self.rotation, name)):
                raise ShapeError(
                    f"Expected the same {name} for position and rotation, got different values. Use "
                    "armlab.motion.fit_pose_dmp."
                )
        if np.any(self.rotation.g != 0.0) or self.rotation.scaling not in ("goal", "none"):
            raise ShapeError(
                f"Expected a rotation with goal 0 and scaling 'goal' or 'none', got goal {self.rotation.g.tolist()} "
                f"and scaling {self.rotation.scaling!r}. Use armlab.motion.fit_pose_dmp."
            )
        object.__setattr__(self, "goal", still(orientation(self.goal, "goal"), "goal"))

    @property
    def duration(self) -> float:
        """Duration of the demonstration [s]."""
        return self.position.duration

    @cached_property
    def T_start(self) -> np.ndarray:
        """Pose (4, 4) at the start of the demonstration."""
        return matrix(self.position.y0, quaternion.multiply(exp(self.rotation.y0), self.goal))

    @cached_property
    def T_goal(self) -> np.ndarray:
        """Pose (4, 4) at the end of the demonstration."""
        return matrix(self.position.g, self.goal)

    def _run_of(
        self,
        duration: float | None = None,
        tau_d: float | None = None,
        start: ArrayLike | None = None,
        twist0: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> PoseRun:
        """Fill in omitted arguments from the demonstration."""
        p0, q0 = pose(self.T_start if start is None else start, "start")
        p1, q1 = pose(self.T_goal if goal is None else goal, "goal")
        A = np.eye(3)
        if self.frame == "goal":
            A = quaternion.to_matrix(quaternion.multiply(q1, quaternion.conjugate(self.goal)))
        v0 = w0 = None
        if twist0 is not None:
            v0, w0 = vector(twist0, "twist0", 6).reshape(2, 3) @ A
        position = RunParameters.of(self.position, duration=duration, tau_d=tau_d, y0=p0 @ A, v0=v0, g=p1 @ A)
        rotation = RunParameters.of(
            self.rotation, tau_d=position.tau, y0=-shorter_way(q0, q1) @ A, v0=w0, g=np.zeros(3)
        )
        return PoseRun(A, position, rotation, q0, q1)

    def rollout(self, t: ArrayLike, **run: Unpack[PoseRunOptions]) -> PoseRollout:
        """Run the primitive with one fourth-order step per interval for both position and orientation.

        Omitted arguments default to the values of the demonstration.

        Parameters
        ----------
        t : (N,) increasing times [s], relative to the first; or a time step [s] for a run to the end of the motion.
        **run : `PoseRunOptions`: ``duration`` or ``tau_d`` of the run [s]; ``start``, ``goal``: poses (4, 4), or (7,):
            position and quaternion wxyz of either sign; ``twist0`` (6,): velocity and angular velocity at the start,
            base axes.

        Raises
        ------
        ShapeError : times that do not increase, invalid poses, NaN, start and goal half a turn apart.
        ConfigError : both duration and tau_d given.
        """
        setting = self._run_of(**run)
        at, A = setting.position, setting.A
        times = at.times(t)
        y, yd, ydd, x, _ = at.primitive.rollout(times, at.tau, at.y0, at.v0, at.g, at.scale)
        q, w, wd = kernels.rotation_rollout(self.rotation._primitive, times, *setting.turning)
        twist, twistd = (np.concatenate([v @ A.T, turning], axis=1) for v, turning in ((yd, w), (ydd, wd)))
        return PoseRollout(np.array(times), matrix(y @ A.T, q), q, twist, twistd, x)

    def stepper(self, **run: Unpack[PoseRunOptions]) -> PoseStepper:
        """Return a stepper that runs the primitive sample by sample; the goal may change.

        The stepper's ``step(dt)`` and `state` return the pose (4, 4), the twist (6,) and its derivative (6,);
        ``change_goal(goal)`` sets a new goal pose, and ``reset()`` returns to the start.

        Parameters
        ----------
        **run : as in `rollout`.

        Raises
        ------
        ShapeError, ConfigError : as in `rollout`.
        """
        return PoseStepper(self, self._run_of(**run))

    def controller(
        self,
        robot: Robot,
        *,
        limits: JointLimits | None = None,
        duration: float | None = None,
        goal: ArrayLike | None = None,
    ) -> Controller:
        """Return a controller ``State -> Command`` for `armlab.bridge` that starts at rest at the measured pose.

        Parameters
        ----------
        robot : the arm; joint positions are computed by inverse kinematics, each starting from the previous solution.
        limits : object with q_min, q_max, qd_max and qdd_max (n,), such as `bridge.Limits`; default: from the
            robot.
        duration, goal : as in `rollout`, with tool poses in base axes.

        Raises
        ------
        ShapeError : an unreachable goal.
        ConfigError : as in `rollout`.
        """
        return PoseDmpController(robot, self, limits, duration, goal)


@dataclass(frozen=True)
class PoseRun:
    """One run of position and orientation in the axes of the forcing term, which A (3, 3) rotates into base axes."""

    A: np.ndarray
    position: RunParameters
    rotation: RunParameters
    q0: np.ndarray
    q1: np.ndarray

    @property
    def turning(self) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Arguments of the orientation kernel: time constant, q0, angular velocity, goal, forcing map."""
        return self.position.tau, self.q0, self.A @ self.rotation.v0, self.q1, self.A * self.rotation.scale


class PoseStepper:
    """Sample-by-sample run of a `PoseDmp`, equivalent to a rollout; created by `PoseDmp.stepper`."""

    def __init__(self, dmp: PoseDmp, run: PoseRun) -> None:
        self._dmp, self._first = dmp, run
        self._position = kernels.PrimitiveStepper(run.position.primitive)
        self._rotation = kernels.RotationStepper(dmp.rotation._primitive)
        self.reset()

    def reset(self) -> None:
        """Return to the start and restore the initial goal."""
        at = self._first.position
        self._position.start(at.y0, at.v0, at.g, at.scale, at.tau)
        self._rotation.start(*self._first.turning[1:], at.tau)

    def change_goal(self, goal: ArrayLike) -> None:
        """Change the goal pose; both forcing terms are scaled as if the goal had been set from the start."""
        if self._dmp.frame == "goal":
            raise ConfigError(
                "Expected a forcing term in base axes for a goal change, got a forcing term in goal axes. Start again "
                "from the current pose, or use frame='base'."
            )
        first = self._first
        start = matrix(first.position.y0, first.q0)
        run = self._dmp._run_of(tau_d=first.position.tau, start=start, twist0=np.zeros(6), goal=goal)
        if run.position.primitive is not self._first.position.primitive:
            raise ConfigError(
                "Expected scaling 'goal' or 'none' for a goal change, got 'rotate'. Fit with 'goal' or 'none'."
            )
        self._position.change_goal(run.position.g, run.position.scale)
        self._rotation.change_goal(run.q1, run.turning[4])

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return the pose (4, 4), the twist (6,) and its derivative (6,)."""
        return self._joined(*advance(dt, self._position, self._rotation))

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Current pose (4, 4), twist (6,) and its derivative (6,)."""
        return self._joined(self._position.outputs(), self._rotation.outputs())

    def _joined(self, position: Sample, rotation: Sample) -> Sample:
        p, v, a = position if self._dmp.frame == "base" else np.array(position) @ self._first.A.T
        q, w, wd = rotation
        return matrix(p, q), np.concatenate((v, w)), np.concatenate((a, wd))


class PoseDmpController(Controller):
    """Controller of a `PoseDmp`: the tool follows the path of poses by continuous inverse kinematics."""

    def __init__(
        self, robot: Robot, dmp: PoseDmp, limits: JointLimits | None, duration: float | None, goal: ArrayLike | None
    ) -> None:
        self._robot, self._dmp, self._duration = robot, dmp, duration
        dmp.stepper(duration=duration, goal=goal)
        super().__init__(robot, limits, dmp.T_goal if goal is None else np.asarray(goal))

    def _checked(self, g: ArrayLike) -> np.ndarray:
        goal = matrix(*pose(g, "goal"))
        if not inverse(self._robot, goal).success:
            raise ShapeError(
                f"Expected a goal that {self._robot.name} can reach within its limits, got an unreachable pose."
            )
        return goal

    def _begin(self, state: State) -> None:
        start = forward(self._robot, state.q)
        self._stepper = self._dmp.stepper(duration=self._duration, start=start, twist0=np.zeros(6), goal=self._goal)
        self._T_base_tool, self._elapsed = start, 0.0
        self._q, self._qd = state.q, np.zeros_like(state.q)

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        for h in own_steps(dt, pace):
            self._T_base_tool = self._stepper.step(h)[0]
            self._elapsed += h
        if dt == 0.0:
            return self._q, self._qd, np.zeros_like(self._q), self._q
        found = inverse(self._robot, self._T_base_tool, self._q, starts=1)
        if not found.success:
            raise ShapeError(
                f"Expected a path within the reach of {self._robot.name}, got a pose outside it: {found.reason}."
            )
        qd = (found.q - self._q) / dt
        qdd = (qd - self._qd) / dt
        self._q, self._qd = found.q, qd
        return found.q, qd, qdd, found.q

    def _change_goal(self, g: np.ndarray) -> None:
        self._stepper.change_goal(g)

    def _is_near(self, state: State) -> bool:
        T_base_tool = forward(self._robot, state.q)
        turned = so3.angle(T_base_tool[:3, :3], self._goal[:3, :3])
        return bool(turned < NEAR) and dist(T_base_tool[:3, 3], self._goal[:3, 3]) < NEAR

    @property
    def _is_over(self) -> bool:
        return self._elapsed >= (self._dmp.duration if self._duration is None else self._duration)


def pose(value: ArrayLike, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the position (3,) and quaternion (4,) of a pose (4, 4) or (7,)."""
    array = numbers(value, what, ShapeError)
    if array.shape not in ((4, 4), (7,)):
        raise ShapeError(
            f"Expected {what} to be a pose (4, 4), or (7,): position, quaternion wxyz, got shape {array.shape}."
        )
    p, q = poses(array[None], what)
    return p[0], q[0]


def poses(value: ArrayLike, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3) and sign-continuous quaternions (N, 4) of poses (N, 4, 4) or (N, 7)."""
    array = numbers(value, what, ShapeError)
    if array.shape[1:] not in ((4, 4), (7,)):
        raise ShapeError(
            f"Expected {what} of shape (N, 4, 4), or (N, 7): position, quaternion wxyz, got {array.shape}. "
            "Put time on axis 0."
        )
    rows = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
    if len(rows):
        raise ShapeError(
            f"Expected finite {what}, got NaN or Inf in row {rows[0]} ({len(rows)} rows in total). Remove these rows."
        )
    if array.ndim == 2:
        return array[:, :3], quaternion.continuous(orientation(array[:, 3:], what))
    bottom = np.abs(array[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() if len(array) else 0.0
    if bottom > 1e-9:
        raise ShapeError(
            f"Expected {what} with last rows 0, 0, 0, 1, got an error of {bottom:.2g}. Pass poses (N, 4, 4)."
        )
    return array[:, :3, 3], quaternion.continuous(quaternion.from_matrix(array[:, :3, :3]))


def orientation(value: ArrayLike, what: str) -> np.ndarray:
    """Return unit quaternions (..., 4), with the sign for which the first non-zero component of the first
    quaternion is positive."""
    q = numbers(value, what, ShapeError)
    if q.shape[-1:] != (4,):
        raise ShapeError(f"Expected {what} to be quaternions wxyz (..., 4), got shape {q.shape}.")
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.abs(length - 1.0) <= LENGTH):
        off = float(length.flat[np.argmax(np.abs(length - 1.0))])
        raise ShapeError(f"Expected quaternions of norm 1 in {what}, got norm {off:.4g}. The quaternion order is wxyz.")
    first = q.reshape(-1, 4)[:1].ravel()
    leading = first[np.flatnonzero(first)[:1]] if first.size and first[0] == 0.0 else first[:1]
    return q / np.where(leading.sum() < 0.0, -length, length)


def shorter_way(q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) of the shorter rotation from q0 to q1 in base axes; raise an error for a rotation
    by π."""
    way = log(quaternion.multiply(q1, quaternion.conjugate(q0)))
    if np.linalg.norm(way) > np.pi - HALF_TURN:
        raise ShapeError(
            "Expected start and goal less than half a turn apart, got half a turn, "
            "for which neither direction is shorter. Use an intermediate orientation."
        )
    return way


def log(q: np.ndarray) -> np.ndarray:
    """Return the shortest rotation vectors (..., 3) of quaternions."""
    q = np.where(q[..., :1] < 0.0, -q, q)
    length = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(length, q[..., :1])
    return np.where(length > 0.0, angle / np.where(length > 0.0, length, 1.0), 2.0) * q[..., 1:]


def exp(w: np.ndarray) -> np.ndarray:
    """Return quaternions (..., 4) of rotation vectors."""
    half = 0.5 * np.linalg.norm(w, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * w], axis=-1)


def matrix(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4) from positions (..., 3) and quaternions (..., 4)."""
    T = np.zeros((*p.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = quaternion.to_matrix(q), p, 1.0
    return T


MAX_ANGLE = 3.0  # rad from the goal: beyond half a turn, the shorter rotation reverses

FINE = 1000  # minimum number of sensitivity steps over a duration
MAX_ITERATIONS = 30
TOLERANCE = 1e-9  # rad: minimum change, and minimum relative decrease of the sum of squares, for another iteration
PARTS = (1.0, 0.5, 0.2, 0.05)  # fractions of a step in the line search


def fit_pose_dmp(
    t: ArrayLike,
    T: ArrayLike,
    *,
    n_basis: int = 50,
    schedule: str = "canonical",
    scaling: str = "goal",
    convention: str = "lund",
    frame: str = "base",
    hold: float = 0.3,
) -> Fit[PoseDmp]:
    """Fit a pose movement primitive to one demonstration by minimising the squared motion error.

    The position is fitted by `fit_dmp`. The orientation is fitted by Gauss-Newton steps that minimise ``sum |log(q_demo
    q^-1)|^2``, starting from a fit to the rotation vector relative to the goal.

    Parameters
    ----------
    t : (N,) increasing times [s].
    T : (N, 4, 4) poses, or (N, 7): position and quaternion wxyz of either sign.
    n_basis, schedule, convention, hold : as in `fit_dmp`; schedule "position" is not supported.
    scaling : scaling of the forcing with start and goal: "goal", "none" or, for the position, "rotate".
    frame : axes of the forcing, "base" or "goal"; goal axes rotate with the goal.

    Returns
    -------
    Fit of a `PoseDmp`. `residuals` (N, 6) [m, rad]; in the covariance, the start and goal of the orientation are
    rotation vectors of the quaternions (4,) in base axes.

    Raises
    ------
    ShapeError : invalid poses, NaN (with row numbers), times that do not increase, or an orientation more than 3 rad
        from the previous one.
    UnknownName : unknown options.
    ConfigError : schedule "position".
    NotConverged : Gauss-Newton did not converge.
    """
    check_name(schedule, "schedule", SCHEDULES)
    check_name(scaling, "scaling", SCALINGS)
    check_name(frame, "frame of the forcing", FRAMES)
    if schedule == "position":
        raise ConfigError(
            "Expected a time-dependent phase for poses, got schedule 'position'. Use 'canonical' or 'time'."
        )
    p, q = poses(T, "T")
    demo = read_demos(t, np.concatenate([p, q], axis=1), None)[0]
    way = log(quaternion.multiply(q, quaternion.conjugate(q[-1])))  # rotation vectors from the goal
    far = np.flatnonzero(np.linalg.norm(way, axis=1) > MAX_ANGLE)
    if len(far):
        angle = np.linalg.norm(way[far[0]])
        raise ShapeError(
            f"Expected orientations within {MAX_ANGLE:g} rad of the last sample, got {angle:.3g} rad "
            f"in row {far[0]}: at half a turn, the shorter rotation reverses direction. Fit the motion in two parts."
        )
    options: dict[str, Any] = {"n_basis": n_basis, "schedule": schedule, "convention": convention, "hold": hold}
    position = fit_dmp(demo.t, p, scaling=scaling, **options)
    turning = "goal" if scaling == "goal" else "none"
    linear = fit_dmp(demo.t, way, scaling=turning, **options)
    dmp, residuals, spread = fit_turning(linear.value, demo.t, q, hold)
    value = PoseDmp(position.value, dmp, q[-1], frame)
    return _fit(value, position, linear, residuals, spread)


def _fit(
    value: PoseDmp, position: Fit[Dmp], linear: Fit[Dmp], residuals: np.ndarray, spread: np.ndarray
) -> Fit[PoseDmp]:
    dof = len(residuals) * (linear.sigma**2).clip(min=1e-300) / (linear.residuals**2).sum(axis=0).clip(min=1e-300)
    sigma = np.sqrt((residuals**2).mean(axis=0) * dof)
    a, b = len(position.parameters), len(linear.parameters)
    cov = np.zeros((a + b, a + b))
    cov[:a, :a], cov[a:, a:] = position.cov, np.tensordot(sigma**2, spread, 1)
    dmp = value.rotation
    parameters = np.concatenate([dmp.weights, [dmp.y0], [dmp.v0], [dmp.g]]).T.ravel()
    both = (("position", "m", position), ("rotation", "rad", linear))
    return Fit(
        value=value,
        names=tuple(f"{part}: {name}" for part, _, fit in both for name in fit.names),
        units=tuple(name.replace("unit of y", unit) for _, unit, fit in both for name in fit.units),
        parameters=np.concatenate([position.parameters, parameters]),
        cov=cov,
        sigma=np.concatenate([position.sigma, sigma]),
        residuals=np.concatenate([position.residuals, residuals], axis=1),
        n=position.n,
        excitation=position.excitation,
        summary=_report,
        classes=tuple(f"{part} {axis} [{unit}]" for part, unit, _ in both for axis in "xyz"),
    )


def _report(fit: Fit[PoseDmp]) -> str:
    value, squares = fit.value, fit.residuals.reshape(-1, 2, 3) ** 2
    rmse = np.sqrt(squares.sum(axis=2).mean(axis=0))
    head = (
        f"Movement primitive of poses with {value.position.n_basis} kernels, schedule {value.position.schedule!r}, "
        f"scaling {value.position.scaling!r}, forcing in {value.frame} axes."
    )
    return "\n".join([head, f"RMSE of the motion: {rmse[0]:.3g} m, {rmse[1]:.3g} rad", fit.table()])


def fit_turning(dmp: Dmp, t: np.ndarray, q: np.ndarray, hold: float) -> tuple[Dmp, np.ndarray, np.ndarray]:
    """Refine the weights and start velocity by minimising the squared motion error at orientations q (N, 4).

    Gauss-Newton steps on the rotation group use the linearised equation of docs/theory/pose_dmp.md. `hold` is the
    standstill time at the goal divided by the duration. Return the primitive, residuals (N, 3) [rad] and covariances
    (3, d, d) of weights, start rotation, velocity and goal rotation, for samples with unit variance about each base
    axis.
    """
    step = dmp.duration / (len(t) - 1)
    rest = dmp.duration + step * np.arange(1, round(hold * dmp.duration / step) + 1)
    times = np.concatenate([t, rest])
    wanted = np.concatenate([q, np.broadcast_to(q[-1], (len(rest), 4))])
    p, error = dmp.weights.size + 3, _error(dmp, times, wanted)
    for _ in range(MAX_ITERATIONS):
        slopes = _slopes(dmp, times, q[-1])
        A = slopes[..., :p].reshape(-1, p)
        found = solve(A, error.reshape(-1, 1))
        square = (error**2).sum()
        for part in PARTS:
            change = part * found.x.reshape(-1, 3)
            moved = replace(dmp, weights=dmp.weights + change[:-1], v0=dmp.v0 + change[-1])
            left = _error(moved, times, wanted)
            if (left**2).sum() < square:
                break
        else:
            break
        dmp, error = moved, left
        if np.abs(A @ found.x).max() < TOLERANCE or (left**2).sum() > (1.0 - TOLERANCE) * square:
            break
    else:
        raise NotConverged(
            f"Expected the fit of the orientations to converge within {MAX_ITERATIONS} iterations, but it did not. Use "
            "fewer kernels, or fit the motion in two parts.",
            dmp,
        )
    gain = (found.G @ A.T).reshape(p, -1, 3)
    return dmp, -error[: len(t)], _spread(gain, slopes, len(t))


def _error(dmp: Dmp, times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (R, 3) from the motion to the demonstration, base axes [rad]."""
    goal = wanted[-1]
    start = quaternion.multiply(exp(dmp.y0), goal)
    run = kernels.rotation_rollout(dmp._primitive, times, dmp.tau_d, start, dmp.v0, goal, np.eye(3))[0]
    return log(quaternion.multiply(wanted, quaternion.conjugate(run)))


def _slopes(dmp: Dmp, times: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the sensitivities (R, 3, 3 m + 9) of the rotation to weights (m, 3), start velocity, start and goal.

    The sensitivities are integrated by the implicit midpoint rule, with steps of at most a thousandth of the duration.
    """
    parts = np.ceil(np.diff(times) / (dmp.duration / FINE) * (1 - 1e-9)).astype(int)
    rows = np.concatenate([[0], np.cumsum(parts)])
    grid = np.interp(np.arange(rows[-1] + 1), rows, times)
    h = (np.diff(grid) / dmp.tau_d)[:, None, None]
    start = quaternion.multiply(exp(dmp.y0), goal)
    q, w, _ = kernels.rotation_rollout(dmp._primitive, grid, dmp.tau_d, start, dmp.v0, goal, np.eye(3))
    inverse = so3.left_jacobian_inv(log(quaternion.multiply(goal, quaternion.conjugate(q))))
    stiffness = dmp.alpha_z * dmp.beta_z
    A = np.zeros((len(grid), 6, 6))
    A[:, :3, :3], A[:, :3, 3:] = so3.hat(dmp.tau_d * w), np.eye(3)
    A[:, 3:, :3], A[:, 3:, 3:] = -stiffness * np.swapaxes(inverse, 1, 2), -dmp.alpha_z * np.eye(3)
    half = 0.25 * h * (A[1:] + A[:-1])
    ahead = np.linalg.inv(np.eye(6) - half)
    onward, push = ahead @ (np.eye(6) + half), h * ahead[:, :, 3:]
    pull = push @ (0.5 * stiffness * (inverse[1:] + inverse[:-1]))
    forcing = dmp._primitive_of(np.eye(dmp.n_basis)).forcing(dmp.phase(grid))
    forcing = 0.5 * (forcing[1:] + forcing[:-1])
    m = dmp.weights.size
    state = np.zeros((6, m + 9))
    state[3:, m : m + 3], state[:3, m + 3 : m + 6] = dmp.tau_d * np.eye(3), np.eye(3)
    found = np.empty((len(times), 3, m + 9))
    found[0], at = state[:3], 0
    for k in range(1, len(times)):
        for at in range(rows[k - 1], rows[k]):
            state = onward[at] @ state
            state[:, :m] += (forcing[at, None, :, None] * push[at, :, None, :]).reshape(6, m)
            state[:, m + 6 :] += pull[at]
        found[k] = state[:3]
    return found


def _spread(gain: np.ndarray, slopes: np.ndarray, N: int) -> np.ndarray:
    """Return the covariances of the unknowns and of the pinned start and goal for unit noise about each axis.

    Start and goal are noisy samples that shift every row; the arm rests at the goal.
    """
    p, R = gain.shape[:2]
    m = p // 3 - 1
    effect = np.zeros((p + 6, N, 3))
    effect[:p] = gain[:, :N]
    effect[:p, -1] += gain[:, N:].sum(axis=1)
    whole = gain.reshape(p, -1) @ slopes[..., p:].reshape(3 * R, 6)
    effect[:p, 0] -= whole[:, :3]
    effect[:p, -1] -= whole[:, 3:]
    effect[p : p + 3, 0] = effect[p + 3 :, -1] = np.eye(3)
    order = [[*range(i, 3 * m, 3), p + i, 3 * m + i, p + 3 + i] for i in range(3)]
    effect = effect[np.concatenate(order)]
    return np.einsum("aki,bki->iab", effect, effect, optimize=True)
