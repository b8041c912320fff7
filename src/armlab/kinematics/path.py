"""Inverse kinematics along a path of poses on one branch, with detours around breaks for redundant arms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from reprlib import repr as shortened
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import make_read_only, numbers
from armlab.errors import NotConverged, ShapeError
from armlab.kinematics.inverse import REASONS, ROWS, Objective, Task, check_search, check_task, kernel_objective
from armlab.robots import Robot

_TEXTS = np.array(["jump" if reason == "bound" else reason for reason in REASONS])
ATTEMPTS = 10  # maximum number of breaks per path for which detours are tried
CANDIDATES = 32  # starts at a break: half near the previous row, half anywhere
SPREAD = 0.6  # standard deviation of the starts near the previous row [rad]
LOOK_BACK, LOOK_AHEAD = 1000, 1000  # maximum number of rows before and after a break
NEAR = 1  # kernel objective "posture"
TOGETHER = 1e-6  # distance below which postures are considered equal [rad]


@dataclass(frozen=True, eq=False)
class IkPath:
    """Joint positions along a path of N poses; arrays are read-only.

    Attributes
    ----------
    q : (N, n) joint positions, always within the limits.
    success : (N,) whether the pose is reached with a step of at most `max_step`. A path is executable if all rows are
        successful.
    position_error : (N,) distance from tool point to goal [m]; NaN for the task "direction".
    rotation_error : (N,) angle between the tool or its axis and the goal [rad]; NaN for the task "position".
    reason : (N,) "solved", or the reason why the path breaks at this row. If the errors are within the tolerance, the
        path continues from `q`; otherwise, `q` is the posture with the smallest error.
        "out of reach": the distance from the first joint to the pose exceeds the total length of the links;
        "limits": a joint is at its limit;
        "singular": no joint motion reduces the error;
        "jump": the pose is reached on this branch, but the step from the previous row exceeds `max_step`;
        "iterations": the error was still falling at the iteration limit.
    branch_changes : (k,) indices of the rows at which the path breaks and continues on a different branch.
    iterations : (N,) number of descent iterations.
    """

    q: np.ndarray
    success: np.ndarray
    position_error: np.ndarray
    rotation_error: np.ndarray
    reason: np.ndarray
    branch_changes: np.ndarray
    iterations: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, *vars(self))

    def report(self) -> str:
        """Return a sentence that states how much of the path is reached and why it breaks."""
        count, breaks = len(self.q), np.flatnonzero(~self.success)
        if not len(breaks):
            return f"All {count} poses reached on one branch."
        names, numbers = np.unique(self.reason[breaks], return_counts=True)
        causes = ", ".join(f"{number} {name}" for name, number in zip(names, numbers))
        text = f"{count - len(breaks)} of {count} poses reached; the path breaks at index {breaks[0]} "
        text += f"({self.reason[breaks[0]]}; in total: {causes})"
        if len(self.branch_changes):
            text += f"; it continues on another branch at index {', '.join(map(str, self.branch_changes[:10]))}"
            text += " and later" if len(self.branch_changes) > 10 else ""
        return text + "."

    def __repr__(self) -> str:
        return f"IkPath({self.report()})"


def inverse_path(
    robot: Robot,
    T_base_tool: ArrayLike,
    q0: ArrayLike | None = None,
    *,
    max_step: float | ArrayLike | None = None,
    task: Task = "pose",
    axis: ArrayLike = (0.0, 0.0, 1.0),
    objective: Objective | None = None,
    posture: ArrayLike | None = None,
    tol: float | tuple[float, float] = 1e-9,
    maxiter: int = 100,
    starts: int = 100,
    damping: float = 0.1,
    strict: bool = False,
) -> IkPath:
    """Return joint positions that move the tool through a sequence of poses on one branch.

    Each pose is solved as in `inverse`, starting from the previous row plus the last step. The arm therefore stays on
    its branch, and keeps its direction of motion through singular postures. Near singular postures, damping and the
    step limit bound the joint motion; if the descent stalls, it restarts from random postures around the previous row.
    If the path breaks, `reason` states the cause. The path then continues on the same branch, or on a different branch
    from the rows listed in `IkPath.branch_changes`.

    Parameters
    ----------
    robot : the arm.
    T_base_tool : (N, 4, 4) consecutive tool poses in the base frame.
    q0 : (n,) posture near the first row [rad or m]; default: the home posture or a random posture.
    max_step : largest joint step between rows [rad or m], one number or (n,), for example speed limit times period.
        Default: 0.05 rad plus five times the length of the pose step [rad], with positions scaled as in `inverse`.
    objective, posture : as in `inverse`, for every row. Default: minimise the motion between rows; a closed path may
        then end in a posture that differs from the start. With an objective, each row depends only on its pose unless
        the minimum jumps, so a closed path is also closed in joint space.
    task, axis, tol, maxiter, starts, damping : as in `inverse`; `starts` applies to the search for a new branch.
    strict : whether to raise an exception if the path breaks.

    Returns
    -------
    IkPath, with `success` per row.

    Raises
    ------
    ShapeError : if the poses are not valid, finite and of shape (N, 4, 4), or if an argument has the wrong shape.
    UnknownName, RobotError, ConfigError : as in `inverse`.
    NotConverged : with `strict`, if the path breaks; `best` is the `IkPath`.
    """
    from armlab.kernels import follow_path

    check_task(robot, task, objective)
    position_tolerance, rotation_tolerance = check_search(tol, maxiter, starts, damping)
    settings: dict[str, Any] = {
        "task": ROWS[task],
        "axis": axis,
        "steps": maxiter,
        "position_tolerance": position_tolerance,
        "rotation_tolerance": rotation_tolerance,
        "damping": damping,
    }
    solver, change = robot.inverse_solver, _change(robot, max_step)
    kind, reference, scale = kernel_objective(robot, objective, posture, q0)

    def follow(T: ArrayLike, start: ArrayLike | None, kind: int, reference: ArrayLike | None, scale: Any) -> Rows:
        wanted = {"objective": kind, "reference": reference, "scale": scale}
        return Rows(*follow_path(solver, T, start, change, starts=starts, **wanted, **settings))

    def solve(T: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, _, counts, _ = solver.solve(np.broadcast_to(T, (len(q), 4, 4)), q, starts=1, **settings)
        return found, counts[:, 2] == 0

    rows = follow(T_base_tool, q0, kind, reference, scale)
    if objective is None and robot.n > ROWS[task]:
        rows = with_detours(robot, np.asarray(T_base_tool, dtype=np.float64), rows, follow, solve)
    q, errors, counts = rows
    steps, status, other_branch = counts.T.copy()
    path = IkPath(q, status == 0, errors[:, 0], errors[:, 1], _TEXTS[status], np.flatnonzero(other_branch), steps)
    if strict and not path.success.all():
        raise NotConverged(path.report(), best=path)
    return path


def _change(robot: Robot, max_step: float | ArrayLike | None) -> np.ndarray | None:
    if max_step is None:
        return None
    change = numbers(max_step, "max_step", ShapeError)
    if change.shape not in ((robot.n,), ()) or not (change >= 0.0).all():
        raise ShapeError(
            f"Expected max_step to be one number or {robot.n} numbers (one per joint) of at least 0, got "
            f"{shortened(max_step)}."
        )
    return np.broadcast_to(change, robot.n)


class Rows(NamedTuple):
    """Kernel result: postures (N, n), errors (N, 3), and integers (N, 3): steps, status, and whether the branch
    changed."""

    q: np.ndarray
    errors: np.ndarray
    counts: np.ndarray


Follow = Callable[[np.ndarray, np.ndarray, int, np.ndarray | None, np.ndarray | None], Rows]
"""Function ``(T, q0, objective, reference, scale) -> rows``."""
Solve = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function ``(T (4, 4), q0 (k, n)) -> solutions (k, n), success (k,)``."""


def with_detours(robot: Robot, T: np.ndarray, rows: Rows, follow: Follow, solve: Solve) -> Rows:
    """Return `rows` with detours around breaks if these reduce the number of broken rows."""
    rng = np.random.default_rng(0)
    given_up = 0  # no detours are tried for breaks up to this row
    best = rows
    for _ in range(ATTEMPTS):
        broken = rows.counts[:, 1] != 0
        first = np.flatnonzero(broken[1:] & ~broken[:-1]) + 1
        first = first[first > given_up]
        if not len(first):
            break
        given_up = k = int(first[0])
        low, high = robot.q_min, robot.q_max
        before = rows.q[k - 1]
        near = before + SPREAD * rng.standard_normal((CANDIDATES // 2, robot.n))
        anywhere = rng.uniform(np.maximum(low, before - np.pi), np.minimum(high, before + np.pi), near.shape)
        detour = _best(T, rows, k, follow, solve(T[k], np.clip(np.concatenate([near, anywhere]), low, high)))
        if detour is not None:
            rows = _replaced(rows, k, detour, follow(T[k:], detour.q[-1], 0, None, None))
            best = min(best, rows, key=lambda found: np.count_nonzero(found.counts[:, 1]))
    return best


def _best(T: np.ndarray, rows: Rows, k: int, follow: Follow, solutions: tuple[np.ndarray, np.ndarray]) -> Rows | None:
    """Return the detour to row k that can be continued furthest beyond row k; the detour begins at the row where it
    leaves the path."""
    best, furthest, seen = None, -1, []
    before = slice(k - 1, max(0, k - LOOK_BACK) - 1 if k > LOOK_BACK else None, -1)
    for q in solutions[0][solutions[1]]:
        if any(np.abs(q - other).max() < 1e-3 for other in seen):
            continue
        seen.append(q)
        wishes = np.concatenate([q[None], rows.q[before]])
        back = follow(np.concatenate([T[k : k + 1], T[before]]), q, NEAR, wishes, np.ones(len(q)))
        whole = np.logical_and.accumulate(back.counts[:, 1] == 0)
        meets = np.flatnonzero(whole & (np.abs(back.q - wishes).max(axis=1) < TOGETHER))
        if len(meets) < 2:  # the first row always matches itself
            continue
        ahead = follow(T[k : k + LOOK_AHEAD], q, 0, None, None).counts[:, 1]
        goes = int(np.argmax(ahead != 0)) if ahead.any() else len(ahead)
        if goes > furthest:
            best, furthest = Rows(*(part[meets[1] :: -1] for part in back)), goes
    return best


def _replaced(rows: Rows, k: int, detour: Rows, ahead: Rows) -> Rows:
    """Return the rows with the detour spliced in up to row k, followed by its continuation."""
    start = k - len(detour.q) + 1
    return Rows(*(np.concatenate([old[:start], new, rest[1:]]) for old, new, rest in zip(rows, detour, ahead)))
