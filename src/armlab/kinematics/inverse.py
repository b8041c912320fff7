"""Inverse kinematics for single poses or batches: solver, tasks, objectives and result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import flag
from armlab.errors import ConfigError, NotConverged, RobotError, UnknownName
from armlab.robots import Robot

REASONS = ("solved", "out of reach", "limits", "singular", "iterations", "bound")
_TEXTS = np.array(REASONS)
_EXPLANATIONS = {
    "out of reach": "no initial guess led to a smaller error, with or without the limits of revolute joints",
    "limits": "only postures outside the joint limits reach the goal",
    "singular": "the only start ended at a singular posture, where no joint motion reduces the error",
    "iterations": "the error was still falling at the iteration limit",
    "bound": "every joint has moved by its largest allowed step from the start",
}
Task = Literal["pose", "position", "axis", "direction"]
Objective = Literal["posture", "mid_range", "limits", "manipulability"]
ROWS = dict(zip(get_args(Task), (6, 3, 5, 2)))
MOST_STEPS = 10**6  # largest number of iterations per start; the history then takes 16 MB per goal
_KINDS = dict(zip(get_args(Objective), (1, 1, 2, 3)))
_INTEGER, _NUMBER = (int, np.integer), (int, float, np.integer, np.floating)


def inverse(
    robot: Robot,
    T_base_tool: ArrayLike,
    q0: ArrayLike | None = None,
    *,
    task: Task = "pose",
    axis: ArrayLike = (0.0, 0.0, 1.0),
    objective: Objective | None = None,
    posture: ArrayLike | None = None,
    tol: float | tuple[float, float] = 1e-9,
    maxiter: int = 100,
    starts: int = 100,
    damping: float = 0.1,
    seed: int = 0,
    threads: int = 1,
    history: bool = False,
    strict: bool = False,
) -> IkSolution:
    """Return joint positions within the limits that place the tool at given poses.

    The solver takes Levenberg-Marquardt steps ``dq = J^T (J J^T + lambda I)^-1 e`` with ``lambda = damping |e|^2`` and
    ``e = [p_goal - p; log(R_goal R^T)]``, where positions [m] are multiplied by 3 / (length of the arm). Joints that
    would exceed their limits stay at the limits, and the other joints compensate. If the search stalls, it restarts
    from a table of random postures, beginning with those that place the tool closest to the goal. The result is always
    within the limits.

    Parameters
    ----------
    robot : the arm.
    T_base_tool : (..., 4, 4) goals: tool poses in the base frame.
    q0 : (n,) or (..., n) initial posture [rad or m], for all goals or for each goal; clipped to the limits. Default:
        the home posture or a random posture, whichever places the tool closer to the goal.
    task : "pose", "position" (of the tool point), "axis" (position and direction of a tool axis) or "direction" (of
        a tool axis only).
    axis : (3,) tool axis for the tasks "axis" and "direction", in the tool frame.
    objective : function to minimise along the self-motion that the task leaves free. With m the middle and r half the
        range of a joint, and ``x = (q - m) / r``:
        "posture": ``sum of (q - posture)^2 / 2``;
        "mid_range": ``sum of x^2 / 2``;
        "limits": a smooth maximum of ``|x|``, ``log(sum of exp(s x) + exp(-s x)) / s`` with s = 1000, plus 0.001 times
        "mid_range";
        "manipulability": ``-log(det(J J^T)) / 2``, with the task rows J of the Jacobian.
    posture : (n,) or (..., n) target of the objective "posture"; default: `q0`, or the home posture without `q0`.
    tol : position tolerance [m] and rotation tolerance [rad]; one number for both, or a pair.
    maxiter : maximum number of iterations per start, 0 to 1 000 000; if all starts fail, the best start continues for
        the same number of additional iterations.
    starts : maximum number of starts; 1: only `q0`.
    damping : lambda divided by the squared error (ikinePOE's lambda); multiplied by 8 after a failed step.
    seed : seed of the random postures; results are reproducible, and identical for batches and single goals.
    threads : number of threads that share the goals, 1 to 256; the result does not depend on it.
    history : whether to record the errors during the search that produced the result.
    strict : whether to raise an exception if a goal is not solved.

    Returns
    -------
    IkSolution, whose arrays have the batch shape. For unsolved goals, the result contains the posture with the smallest
    error and the reason.

    Raises
    ------
    ShapeError : if a goal is not a finite pose (the message states its index), or if `q0`, `axis` or `posture` has the
        wrong shape.
    UnknownName : if `task` or `objective` is unknown.
    RobotError : if `robot` is not a `Robot`.
    ConfigError : if `tol`, `maxiter`, `starts`, `damping`, `seed` or `threads` is out of range, or `posture` is given
        without the objective "posture".
    NotConverged : with `strict`, if a goal is not solved; `best` is the `IkSolution`.

    References
    ----------
    Levenberg 1944; Marquardt 1963; Sugihara, Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
    method, IEEE Transactions on Robotics 27(5), 2011.
    """
    check_task(robot, task, objective)
    position_tolerance, rotation_tolerance = check_search(tol, maxiter, starts, damping)
    solver = robot.inverse_solver
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or not 0 <= seed < 2**64:
        raise ConfigError(f"Expected seed to be an integer from 0 to 2^64 - 1, got {seed!r}.")
    if seed:
        from armlab.kernels import InverseSolver

        solver = InverseSolver(robot.chain, robot.q_min, robot.q_max, robot.q_home, int(seed))
    wanted = kernel_objective(robot, objective, posture, q0)
    search = maxiter, starts, position_tolerance, rotation_tolerance, damping
    result = freeze(
        *solver.solve(T_base_tool, q0, ROWS[task], axis, *search, *wanted, flag(history, "history"), threads)
    )
    if strict and not np.all(result.success):
        raise NotConverged(result.report(), best=result)
    return result


@dataclass(frozen=True, eq=False)
class IkSolution:
    """Joint positions for one goal or a batch of goals; the arrays are read-only, and become scalars for a single goal.

    Attributes
    ----------
    q : (..., n) joint positions, always within the limits; if unsolved, the posture with the smallest error.
    success : (...) whether the errors are within the tolerance.
    position_error : (...) distance from tool point to goal [m]; NaN for the task "direction".
    rotation_error : (...) angle between the tool or its axis and the goal [rad]; NaN for the task "position".
    iterations : (...) total number of iterations over all starts.
    starts : (...) number of starts used.
    reason : (...) "solved", or the cause of failure:
        "out of reach": the distance from the first joint to the goal exceeds the total length of the links, or every
        start, even without the limits of revolute joints, ended at a posture where no joint motion reduces the error;
        "limits": only postures outside the limits reach the goal;
        "singular": an error below 1e-4 rad remains near a singular posture after second-order steps, or the only start
        ended at a singular posture; `position_error` and `rotation_error` give the remaining error;
        "iterations": the error was still falling at the iteration limit.
    slope : (...) norm of the objective gradient along the self-motion of the joints that are not at a limit; NaN
        without an objective or a solution.
    history : (..., maxiter + 1, 2) smallest errors so far [m, rad] after each step of the descent that produced `q`
        (the continued best start if all starts failed), then NaN; None if not recorded.
    """

    q: np.ndarray
    success: np.ndarray
    position_error: np.ndarray
    rotation_error: np.ndarray
    iterations: np.ndarray
    starts: np.ndarray
    reason: np.ndarray | str
    slope: np.ndarray
    history: np.ndarray | None

    def report(self) -> str:
        """Return a sentence with the number of solved goals, their errors and the causes of failures."""
        if np.ndim(self.success) == 0:
            return self._one()
        count, solved = np.size(self.success), int(np.sum(self.success))
        text = f"{solved} of {count} goals solved"
        if solved:
            text += f" to within {_errors(self.position_error[self.success], self.rotation_error[self.success])}"
        if solved < count:
            first = np.unravel_index(int(np.argmin(self.success)), np.shape(self.success))
            names, numbers = np.unique(np.asarray(self.reason)[~np.asarray(self.success)], return_counts=True)
            causes = ", ".join(f"{number} {name}" for name, number in zip(names, numbers))
            text += f"; not solved: {causes}, first at index {', '.join(map(str, first))}"
        return text + "."

    def _one(self) -> str:
        errors = _errors(np.asarray(self.position_error), np.asarray(self.rotation_error))
        spent = f"{self.iterations} iterations from {self.starts} start{'s' if self.starts > 1 else ''}"
        if self.success:
            return f"Solved to within {errors} in {spent}."
        reason = str(self.reason)
        return f"Not solved ({reason}: {_EXPLANATIONS[reason]}); the best posture has errors of {errors} after {spent}."

    def __repr__(self) -> str:
        return f"IkSolution({self.report()})"


def freeze(q: np.ndarray, errors: np.ndarray, counts: np.ndarray, history: np.ndarray | None) -> IkSolution:
    """Return kernel errors (..., 3) and counts (..., 3) as an `IkSolution`, with scalars for a single goal."""
    for array in (q, errors, counts, history):
        if array is not None:
            array.flags.writeable = False
    if counts.ndim == 1:
        steps, starts, status = counts
        return IkSolution(q, status == 0, errors[0], errors[1], steps, starts, REASONS[status], errors[2], history)
    success, reason = counts[..., 2] == 0, _TEXTS[counts[..., 2]]
    success.flags.writeable = reason.flags.writeable = False
    return IkSolution(
        q, success, errors[..., 0], errors[..., 1], counts[..., 0], counts[..., 1], reason, errors[..., 2], history
    )


def _errors(position: np.ndarray, rotation: np.ndarray) -> str:
    parts = [(position, "m"), (rotation, "rad")]
    return " and ".join(f"{np.max(values):.2g} {unit}" for values, unit in parts if not np.isnan(values).all())


def check_task(robot: object, task: str, objective: str | None) -> None:
    """Reject unknown names and a `robot` that is not a `Robot`."""
    if not isinstance(task, str) or task not in ROWS:
        raise UnknownName.among("task of inverse kinematics", task, ROWS)
    if objective is not None and (not isinstance(objective, str) or objective not in _KINDS):
        raise UnknownName.among("objective of inverse kinematics", objective, _KINDS)
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)


def check_search(tol: Any, maxiter: Any, starts: Any, damping: Any) -> tuple[float, float]:
    """Validate the search options and return the position and rotation tolerances."""
    if not (isinstance(maxiter, _INTEGER) and 0 <= maxiter <= MOST_STEPS):
        raise ConfigError(f"Expected maxiter to be an integer from 0 to {MOST_STEPS}, got {maxiter!r}.")
    if not (isinstance(starts, _INTEGER) and 1 <= starts < 2**31):
        raise ConfigError(f"Expected starts to be an integer of at least 1, got {starts!r}.")
    if not (isinstance(damping, _NUMBER) and 0 < damping < np.inf):
        raise ConfigError(f"Expected damping to be a number above 0, got {damping!r}.")
    position, rotation = tol if isinstance(tol, tuple) and len(tol) == 2 else (tol, tol)
    if not (isinstance(position, _NUMBER) and isinstance(rotation, _NUMBER) and position >= 0 and rotation >= 0):
        raise ConfigError(f"Expected tol to be a number of at least 0 or a pair (position, rotation), got {tol!r}.")
    return float(position), float(rotation)


def kernel_objective(
    robot: Robot, name: Objective | None, posture: ArrayLike | None, q0: ArrayLike | None
) -> tuple[int, ArrayLike | None, np.ndarray | None]:
    if posture is not None and name != "posture":
        raise ConfigError(f'Expected objective="posture" with a posture, got objective={name!r}. Omit the posture.')
    if name is None or name == "manipulability":
        return _KINDS.get(name or "", 0), None, None
    if name == "posture":
        wanted = next((given for given in (posture, q0) if given is not None), robot.q_home)
        return _KINDS[name], wanted, np.ones(robot.n)
    ranges = (robot.q_max - robot.q_min) / 2.0
    limited = np.isfinite(ranges)  # a joint without limits has no middle
    return _KINDS[name], np.where(limited, robot.q_max - ranges, 0.0), np.where(limited, 1.0 / ranges, 0.0)
