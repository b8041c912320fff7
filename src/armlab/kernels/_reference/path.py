"""Inverse kinematics along a path of poses (specification; the compiled twin is native/path.h)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import read
from armlab.kernels._reference.descent import Box, Descent, Goal, Search
from armlab.kernels._reference.goals import read_goals, read_search, read_task, read_vectors
from armlab.kernels._reference.inverse import BOUND, OUT_OF_REACH, SOLVED, InverseSolver, uniform

__all__ = ["follow_path"]

LEAST_CHANGE = 0.05  # rad: without `change`, how far a joint may move from row to row at least
MOST_CHANGE = 5.0  # and of the length of the pose step
TRIES, ENOUGH_FOUND = 24, 4


def follow_path(
    solver: InverseSolver,
    T_base_tool: Any,
    q0: Any = None,
    change: Any = None,
    task: int = 6,
    axis: Any = (0.0, 0.0, 1.0),
    steps: int = 100,
    starts: int = 100,
    position_tolerance: float = 1e-9,
    rotation_tolerance: float = 1e-9,
    damping: float = 0.1,
    objective: int = 0,
    reference: Any = None,
    scale: Any = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q (N, n), errors (N, 3) and counts (N, 3) along a path.

    Every row is descended to from the row before plus its last step (without what the tool did not feel of that),
    within `change`. Where that fails: from random starts about the row before; then further away; then, on another
    branch, from the solver's table. Errors are as in `InverseSolver.solve`. Counts are steps, status, whether the row
    is on another branch. A row whose status is not 0 breaks the path: with errors within the tolerances `q` is a
    solution beyond the break, otherwise the posture with the least error.

    Parameters
    ----------
    solver : the arm and its limits.
    T_base_tool : (N, 4, 4) goals, one after the other.
    q0 : (n,) where the first row starts from; None: the solver's table.
    change : (n,) how far a joint may move from row to row, maybe infinite; None: 0.05 rad and five times the length of
        the pose step.
    task, axis, steps, starts, position_tolerance, rotation_tolerance, damping, objective, scale : as in
        `InverseSolver.solve`; the starts are those of a search for another branch.
    reference : (n,) or (N, n), as there.
    """
    search = read_search(steps, starts, position_tolerance, rotation_tolerance, damping, objective)
    goals = read_goals(T_base_tool)
    n = solver._chain.n
    reference, scale = (np.zeros(n) if vector is None else vector for vector in (reference, scale))
    references, scales = read_vectors(reference, "posture", goals, n), read(scale, "scale", (n,), exact=True)
    direction = read_task(task, axis)
    if goals.ndim != 3:
        raise ShapeError(f"Expected T_base_tool of shape (N, 4, 4), one pose after the other, got {goals.shape}.")
    start = None if q0 is None else read(q0, "q0", (n,), exact=True)
    bound = None if change is None else read(change, "change", (n,), exact=True)
    if start is not None and not np.isfinite(start).all():
        raise ShapeError("Expected finite joint positions, got others in q0.")
    if bound is not None and not (bound >= 0.0).all():
        raise ShapeError("Expected change >= 0, got others.")
    follower = _Follower(solver, bound)
    q, errors, counts = np.empty((len(goals), n)), np.empty((len(goals), 3)), np.empty((len(goals), 3), dtype=np.int64)
    for k, T in enumerate(goals):
        own = search._replace(objective=search.objective._replace(reference=references[k], scale=scales))
        follower.goal, follower.search = Goal(task, T, direction), own
        row = follower.first(start) if k == 0 else follower.next()
        q[k], errors[k], counts[k] = follower.q, row.errors, (row.steps, row.status, row.other_branch)
    return q, errors, counts


class _Row(NamedTuple):
    status: int
    errors: tuple[float, float, float]
    steps: int
    other_branch: bool = False


class _Follower:
    """The state between two rows."""

    goal: Goal
    search: Search

    def __init__(self, solver: InverseSolver, change: np.ndarray | None) -> None:
        self.solver, self.change = solver, change
        self.row = self.failures = 0
        self.q = self.moved = np.zeros(solver._chain.n)

    def first(self, q0: np.ndarray | None) -> _Row:
        row = None if q0 is None else self.reach(q0, self.solver._limits)
        if row is None or row.status != SOLVED:
            row = self.solve(q0)
        self.failures = int(row.status != SOLVED)
        return row

    def next(self) -> _Row:
        self.row += 1
        before = self.q
        start, bound = self.predict()
        row = self.reach(start, bound)
        if row.status != SOLVED:
            row = self.reach(before, bound)
        if row.status not in (SOLVED, OUT_OF_REACH):
            row = self.recover(before, bound, row)
        solved = row.status == SOLVED
        self.failures = 0 if solved else self.failures + 1
        self.moved = self.q - before if solved else np.zeros_like(before)
        return row

    def predict(self) -> tuple[np.ndarray, Box]:
        """Return where to start from and what the joints may reach."""
        solver = self.solver
        here = Descent(solver._chain, self.goal, self.search, solver._weight).evaluate(self.q)
        start = self.q + self.moved
        if len(start) > self.goal.task:
            along = np.linalg.qr(here.J.T, mode="complete")[0][:, self.goal.task :]  # the null space
            start = start - along @ (along.T @ self.moved)
        unit = np.where(solver._chain.prismatic, 1.0 / solver._weight, 1.0)
        change = (LEAST_CHANGE + MOST_CHANGE * np.sqrt(here.square)) * unit if self.change is None else self.change
        low, high = solver._limits
        return start, (np.maximum(self.q - change, low), np.minimum(self.q + change, high))

    def recover(self, before: np.ndarray, bound: Box, row: _Row) -> _Row:
        """Return the row where the descent from the one before ends within the bound without a solution."""
        thorough = self.failures & (self.failures - 1) == 0  # after 0, 1, 2, 4, 8 ... failures without a gap
        stuck, steps, found = self.q, row.steps, []
        for k in range(TRIES if thorough else 0):
            shares = uniform(self.row, (k + 1, len(before)))[k]
            other = self.reach(before + (2.0 * shares - 1.0) * LEAST_CHANGE, bound)
            steps += other.steps
            if other.status == SOLVED:
                found.append((float(np.sum((self.q - before) ** 2)), len(found), self.q, other))
            if len(found) == ENOUGH_FOUND:
                break
        if found:
            self.q, row = min(found)[2:]
            return row._replace(steps=steps)
        far = self.reach(before, self.solver._limits)
        this_branch = far.status == SOLVED
        if not this_branch and thorough:
            steps += far.steps
            far = self.solve(None)
        solved = far.status == SOLVED
        if not solved:
            self.q = stuck
        status = BOUND if this_branch else row.status
        return _Row(status, far.errors if solved else row.errors, steps + far.steps, solved and not this_branch)

    def reach(self, start: np.ndarray, bound: Box) -> _Row:
        """Go to the posture with the least error inside the bound, from `start`."""
        self.q, errors, (steps, _, status) = self.solver._follow(self.goal, self.search, start, bound)
        return _Row(status, errors, steps)

    def solve(self, start: np.ndarray | None) -> _Row:
        """Go to a solution on any branch."""
        self.q, errors, (steps, _, status) = self.solver._solve(self.goal, self.search, start, None)
        return _Row(status, errors, steps)
