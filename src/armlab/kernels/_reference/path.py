"""Inverse kinematics along a path of poses (specification; the compiled twin is native/path.h)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import read
from armlab.kernels._reference.descent import Box, Descent, Goal, Search
from armlab.kernels._reference.goals import read_goals, read_search, read_task
from armlab.kernels._reference.inverse import BOUND, OUT_OF_REACH, SOLVED, InverseSolver, uniform

__all__ = ["follow_path"]

LEAST_CHANGE = 0.05  # rad: what a joint may move from row to row, at least
MOST_CHANGE = 5.0  # and this times the length of the pose step
SETTLED = 1e-9  # rad: what is not worth another round
WIDEST_ROUND = 0.1  # rad: along the null space
ROUNDS, FIRST_ROUNDS = 12, 500
TRIES, ENOUGH_FOUND = 24, 4
LEAST = 1e-14  # keeps J J^T invertible in singular postures


def follow_path(
    solver: InverseSolver,
    T_base_tool: Any,
    q0: Any = None,
    task: int = 6,
    axis: Any = (0.0, 0.0, 1.0),
    change: Any = None,
    posture: Any = None,
    weights: Any = None,
    steps: int = 100,
    starts: int = 100,
    position_tolerance: float = 1e-9,
    rotation_tolerance: float = 1e-9,
    damping: float = 0.1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q (N, n), errors (N, 2) [m, rad] and counts (N, 3) along a path.

    Every row is descended to from the row before plus its last step (without what the tool did not feel of that),
    within `change`. Where that fails: from random starts about the row before; then further away; then, on another
    branch, from the solver's table. Counts are steps, status, whether the row is on another branch. A row whose status
    is not 0 breaks the path: with errors within the tolerances `q` is a solution beyond the break, otherwise the
    posture with the least error.

    Parameters
    ----------
    solver : the arm and its limits.
    T_base_tool : (N, 4, 4) goals, one after the other.
    q0 : (n,) where the first row starts from; None: the solver's table.
    task, axis, steps, starts, position_tolerance, rotation_tolerance, damping : as in `InverseSolver.solve`.
    change : (n,) how far a joint may move from row to row; None: 0.05 rad and five times the length of the pose step.
    posture : (n,) or (N, n), with `weights`: with joints to spare each row minimises the sum of
        ``weights (q - posture)^2``. None: it stays near the row before.
    weights : (n,), with `posture`.
    """
    goals = read_goals(T_base_tool)
    if goals.ndim != 3:
        raise ShapeError(f"Expected T_base_tool of shape (N, 4, 4), one pose after the other, got {goals.shape}.")
    direction = read_task(task, axis)
    search = read_search(steps, starts, position_tolerance, rotation_tolerance, damping)
    if (posture is None) != (weights is None):
        raise ShapeError("Expected posture and weights together, got one of them alone.")
    n = solver._chain.n
    wishes = (
        _wish(change, "change", n, finite=False, least=0.0),
        _wish(posture, "posture", n, rows=len(goals)),
        _wish(weights, "weights", n, least=0.0),
    )
    follower = _Follower(solver, search, *wishes)
    q, errors, counts = np.empty((len(goals), n)), np.empty((len(goals), 2)), np.empty((len(goals), 3), dtype=np.int64)
    start = _wish(q0, "q0", n)
    for k, T in enumerate(goals):
        goal = Goal(task, T, direction)
        row = follower.first(goal, start) if k == 0 else follower.next(goal)
        q[k], errors[k], counts[k] = follower.q, row.errors, (row.steps, row.status, row.other_branch)
    return q, errors, counts


class _Row(NamedTuple):
    status: int
    errors: tuple[float, float]
    steps: int
    other_branch: bool = False


class _Follower:
    """The state between two rows."""

    def __init__(
        self,
        solver: InverseSolver,
        search: Search,
        change: np.ndarray | None,
        posture: np.ndarray | None,
        weights: np.ndarray | None,
    ) -> None:
        self.solver, self.search = solver, search
        self.change = change
        self.wish = None if posture is None or weights is None else (np.atleast_2d(posture), weights)
        self.row = self.failures = 0
        self.q = self.moved = np.zeros(solver._chain.n)

    def first(self, goal: Goal, q0: np.ndarray | None) -> _Row:
        self.goal = goal
        row = self.reach(q0, self.solver._limits) if q0 is not None else None
        if row is None or row.status != SOLVED:
            row = self.solve(q0)
        if row.status == SOLVED:
            row = self.settle(self.solver._limits, FIRST_ROUNDS, row)
        self.failures = int(row.status != SOLVED)
        return row

    def next(self, goal: Goal) -> _Row:
        self.row += 1
        self.goal, before = goal, self.q
        start, bound = self.predict()
        row = self.reach(start, bound)
        if row.status == SOLVED:
            row = self.settle(bound, ROUNDS, row)
        else:
            row = self.reach(before, bound)
            if row.status not in (SOLVED, OUT_OF_REACH):
                row = self.recover(before, bound, row)
        solved = row.status == SOLVED
        self.failures = 0 if solved else self.failures + 1
        self.moved = self.q - before if solved else np.zeros_like(before)
        return row

    def predict(self) -> tuple[np.ndarray, Box]:
        """Return where to start from and what the joints may reach."""
        here = self.descent().evaluate(self.q)
        start = self.q + self.moved
        if len(start) > self.goal.task:
            start = start - _project(here.J, self.moved)
        unit = np.where(self.solver._chain.prismatic, 1.0 / self.solver._weight, 1.0)
        change = (LEAST_CHANGE + MOST_CHANGE * np.sqrt(here.square)) * unit if self.change is None else self.change
        low, high = self.solver._limits
        return start, (np.maximum(self.q - change, low), np.minimum(self.q + change, high))

    def settle(self, bound: Box, rounds: int, row: _Row) -> _Row:
        """Move along the null space towards the posture: gradient steps, their length by the secant rule."""
        if self.wish is None or len(self.q) <= self.goal.task or not self.wish[1].any():
            return row
        largest = self.wish[1].max()
        rate, slope = 0.5 / largest, self.slope(*self.wish)
        for _ in range(rounds):
            size = np.sqrt(slope @ slope) * rate
            if size <= SETTLED:
                break
            before, slope_before = self.q, slope
            there = self.reach(before - rate * min(1.0, WIDEST_ROUND / size) * slope, bound)
            if there.status != SOLVED:
                self.q = before
                return row._replace(steps=row.steps + there.steps)
            row = there._replace(steps=row.steps + there.steps)
            slope = self.slope(*self.wish)
            s, y = self.q - before, slope - slope_before
            if s @ s <= SETTLED**2:
                break
            rate = float(np.clip(s @ s / (s @ y), 0.1 / largest, 10.0 / largest)) if s @ y > 0.0 else 1.0 / largest
        return row

    def slope(self, postures: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the gradient of half the weighted square, in the null space."""
        posture = postures[self.row if len(postures) > 1 else 0]
        return _project(self.descent().evaluate(self.q).J, weights * (self.q - posture))

    def recover(self, before: np.ndarray, bound: Box, row: _Row) -> _Row:
        """Return the row where the descent from the one before ends within the bound without a solution."""
        thorough = self.failures & (self.failures - 1) == 0  # after 0, 1, 2, 4, 8 ... failures without a gap
        stuck, steps, found = self.q, row.steps, []
        if thorough:
            for k in range(TRIES):
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

    def descent(self) -> Descent:
        return Descent(self.solver._chain, self.goal, self.search, self.solver._weight)


def _project(J: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the part of `v` that leaves the tool where it is."""
    return v - J.T @ np.linalg.solve(J @ J.T + LEAST * np.eye(len(J)), J @ v)


def _wish(
    value: Any, name: str, n: int, finite: bool = True, least: float = -np.inf, rows: int = 0
) -> np.ndarray | None:
    """Return a vector (n,), or where there are `rows` maybe (rows, n); None for None."""
    if value is None:
        return None
    vector = read(value, name, (rows, n) if rows and np.ndim(value) == 2 else (n,), exact=True)
    if np.isnan(vector).any() or (finite and np.isinf(vector).any()):
        raise ShapeError(f"Expected {'finite numbers' if finite else 'numbers'} in {name}, got others.")
    if (vector < least).any():
        raise ShapeError(f"Expected no negative number in {name}, got one.")
    return vector
