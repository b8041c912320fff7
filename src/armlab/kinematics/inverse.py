"""Inverse kinematics: joint positions that put the tool where it is wanted."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import flag
from armlab.errors import ConfigError, NotConverged
from armlab.kinematics._inverse_result import Inverse, freeze
from armlab.kinematics._tasks import ROWS, Objective, Task, check, check_search, kernel_objective
from armlab.robots import Robot

__all__ = ["Inverse", "inverse"]


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
) -> Inverse:
    """Return joint positions within the limits that put the tool at given poses.

    Levenberg-Marquardt steps ``dq = J^T (J J^T + lambda I)^-1 e`` with ``lambda = damping |e|^2`` and
    ``e = [p_goal - p; log(R_goal R^T)]``, metres weighted by three over the length of the arm; joints that would leave
    their limits stop there and the others make up for them. A start that stalls is given up, and the next comes from a
    table of random postures: those whose tool is nearest to the goal first. No result is ever outside the limits.

    Parameters
    ----------
    robot : the arm.
    T_base_tool : (..., 4, 4) goals: poses of the tool in the base.
    q0 : (n,) or (..., n) where to start [rad or m], one posture or one per goal; moved to the limits if outside. None:
        from the home posture or a random one, whichever has its tool nearer to the goal.
    task : what is asked for: the "pose"; the "position" of the tool point; the position and the direction of an "axis"
        of the tool; or the "direction" of that axis alone.
    axis : (3,) that axis, in tool axes.
    objective : what is made least, from the solution on along its self-motion, with the joints that the task leaves
        free. With r half the range of a joint about its middle m:
        "posture" ``sum of (q - posture)^2 / 2``;
        "mid_range" ``sum of ((q - m) / r)^2 / 2``;
        "limits" the largest ``|q - m| / r``, made smooth: ``log(sum of exp(s x) + exp(-s x)) / s`` with s = 1000, and a
        thousandth of "mid_range";
        "manipulability" ``-log(det(J J^T)) / 2`` of the rows of the task.
    posture : (n,) or (..., n) that posture, with the objective "posture" only; None: `q0`, or the home posture.
    tol : largest errors of a solution: of position [m] and of rotation [rad], one number for both or a pair.
    maxiter : most steps from one start, 0 to 1 000 000; where all starts fail, the best goes on for as many again.
    starts : most starts; 1 keeps to `q0`.
    damping : lambda over the squared error (ikinePOE's lambda); it grows by 8 when steps fail.
    seed : of the random postures; the same seed gives the same answers, in a batch and one by one.
    threads : 1 to 256, over the goals; any number gives the same result.
    history : keep the errors along the descent that gave the result.
    strict : raise instead of returning a result that is not a solution.

    Returns
    -------
    Inverse with arrays of the shape of the batch; where there is no solution, the posture with the least error and why.

    Raises
    ------
    ShapeError
        When a goal is not a pose or not finite (its index is told), or `q0`, `axis` or `posture` does not fit.
    UnknownName
        When there is no such task or objective.
    RobotError
        When something else comes in place of a robot, such as its name.
    ConfigError
        When `tol`, `maxiter`, `starts`, `damping`, `seed` or `threads` is out of its range, or a
        posture comes without its objective.
    NotConverged
        With `strict`, when a goal is not solved; `best` is the `Inverse`.

    References
    ----------
    Levenberg 1944; Marquardt 1963; Sugihara, Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
    method, IEEE Transactions on Robotics 27(5), 2011.
    """
    check(robot, task, objective)
    position_tolerance, rotation_tolerance = check_search(tol, maxiter, starts, damping)
    solver = robot.inverse_solver
    if _checked(seed):
        from armlab.kernels import InverseSolver

        solver = InverseSolver(robot.chain, robot.q_min, robot.q_max, robot.q_home, int(seed))
    result = freeze(
        *solver.solve(
            T_base_tool,
            q0,
            ROWS[task],
            axis,
            maxiter,
            starts,
            position_tolerance,
            rotation_tolerance,
            damping,
            *kernel_objective(robot, objective, posture, q0),
            flag(history, "history"),
            threads,
        )
    )
    if strict and not np.all(result.success):
        raise NotConverged(result.report(), best=result)
    return result


def _checked(seed: int) -> int:
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or not 0 <= seed < 2**64:
        raise ConfigError(f"Expected seed to be an integer from 0 to 2^64 - 1, got {seed!r}.")
    return int(seed)
