"""Inverse kinematics of a chain within joint limits, of single poses and along a path."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .chain import Chain
from .descent import HASTY, PATIENT, Box, Descent, Goal, Objective, Search, SelfMotion

SOLVED, OUT_OF_REACH, LIMITS, SINGULAR, ITERATIONS, BOUND = range(6)
BLOCK, BLOCKS = 128, 16
POSTURES = BLOCK * BLOCKS
OVER_LIMITS = 0.5  # how far postures of the second half reach over them, in ranges, to be moved back
FEW_STARTS = 10  # beyond reach, or to learn whether it is the limits that are in the way


class InverseSolver:
    """Inverse kinematics of a chain within joint limits, immutable.

    Levenberg-Marquardt from one start after the other (see `descent.Descent`). Starts that stall are given up early;
    the next is taken from a table of random postures, in each block of it the one whose tool is nearest to the goal. In
    the second half of the table every other joint is at a limit, for the poses that are reached only so.
    The table depends on the robot and the seed alone: a goal has the same answer in a batch and alone.

    Tasks are told by their number of rows: 6 pose, 5 position and direction of a tool axis, 3 position, 2 direction.
    Statuses: 0 solved; 1 out of reach; 2 limits; 3 singular; 4 iterations; 5 bound (`follow` only).
    """

    def __init__(self, chain: Chain, q_min: Any, q_max: Any, q_home: Any, seed: int = 0) -> None:
        low, high = np.array(q_min, dtype=float), np.array(q_max, dtype=float)
        home = np.asarray(q_home, dtype=float)
        self._chain, self._limits = chain, (low, high)
        prismatic = chain.prismatic
        self._unlimited = np.where(prismatic, low, -np.inf), np.where(prismatic, high, np.inf)
        slides = np.where(prismatic, np.maximum(np.abs(low), np.abs(high)), 0.0)
        links = np.linalg.norm(chain.frames[1:, :3, 3], axis=1)
        lengths = float(np.sum(links + np.where(np.isfinite(slides), slides, 0.0))) or 1.0
        self._weight = 3.0 / lengths  # of a metre in radians
        self._wrist_reach = float(np.sum(slides) + np.sum(links[:-1]))
        self._tool_reach = self._wrist_reach + float(links[-1])
        # Without an end on one side: a turn, or twice the length of the arm, from the other or about zero.
        ranges = np.where(prismatic, 2.0 * lengths, 2.0 * np.pi)
        first = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - ranges, -0.5 * ranges))
        last = np.where(np.isfinite(high), high, first + ranges)
        over = np.where(np.arange(POSTURES) < POSTURES // 2, 0.0, OVER_LIMITS)[:, None]
        parts = (1.0 + 2.0 * over) * uniform(seed, (POSTURES, chain.n)) - over
        self._angles = np.clip(first + (last - first) * parts, low, high)
        self._angles[0] = home
        self._poses = chain.forward(self._angles)[:, :3]

    def solve(
        self,
        T_base_tool: Any,
        q0: Any = None,
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
        history: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Return q (..., n), errors (..., 3), counts (..., 3) and the history (..., steps + 1, 2) or None.

        Counts are steps of all starts, starts, status. Without a solution `q` is the posture with the least error. It
        is always within the limits. Errors are those of position [m] and rotation [rad], NaN where the task does not
        ask for them, and the slope of the objective that is left, NaN without one.
        """
        search = Search(
            steps,
            starts,
            position_tolerance,
            rotation_tolerance,
            damping,
            Objective(objective, np.zeros(0), np.zeros(0)),
        )
        return self._run(self._solve, T_base_tool, q0, task, axis, search, (reference, scale), history)

    def follow(
        self,
        T_base_tool: Any,
        q0: Any,
        change: float = np.inf,
        task: int = 6,
        axis: Any = (0.0, 0.0, 1.0),
        steps: int = 100,
        position_tolerance: float = 1e-9,
        rotation_tolerance: float = 1e-9,
        damping: float = 0.1,
        objective: int = 0,
        reference: Any = None,
        scale: Any = None,
        history: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Solve from `q0` alone, and move no joint further than `change` from it; parameters and results as in `solve`.

        For paths, where the start is the previous posture: the result is near it or status 5 says that the bound stops
        it; damping bounds the steps near singular postures. `q` is the posture with the least error within the bound.
        """

        def solve(goal: Goal, search: Search, q0: np.ndarray | None, path: np.ndarray | None) -> tuple[Any, ...]:
            start = np.asarray(q0)
            return self._follow(goal, search, start, self._around(start, change), path)

        search = Search(
            steps, 1, position_tolerance, rotation_tolerance, damping, Objective(objective, np.zeros(0), np.zeros(0))
        )
        return self._run(solve, T_base_tool, np.asarray(q0), task, axis, search, (reference, scale), history)

    def _run(
        self,
        solve: Any,
        T: Any,
        q0: Any,
        task: int,
        axis: Any,
        search: Search,
        wanted: tuple[Any, Any],
        history: bool,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        goals = np.asarray(T, dtype=float)
        batch, n = goals.shape[:-2], self._chain.n
        starts = None if q0 is None else np.broadcast_to(np.asarray(q0, dtype=float), (*goals.shape[:-2], n))
        reference, scale = (np.zeros(n) if vector is None else vector for vector in wanted)
        references, scales = (
            np.broadcast_to(np.asarray(reference, dtype=float), (*goals.shape[:-2], n)),
            np.asarray(scale, dtype=float),
        )
        direction = np.asarray(axis, dtype=float)
        q, errors, counts = np.empty((*batch, n)), np.empty((*batch, 3)), np.empty((*batch, 3), dtype=np.int64)
        path = np.empty((*batch, search.steps + 1, 2)) if history else None
        for k in np.ndindex(batch):
            start = None if starts is None else starts[k]
            goal = Goal(task, goals[k], direction)
            own = search._replace(objective=search.objective._replace(reference=references[k], scale=scales))
            q[k], errors[k], counts[k] = solve(goal, own, start, None if path is None else path[k])
        return q, errors, counts, path

    def _solve(self, goal: Goal, search: Search, start: np.ndarray | None, path: np.ndarray | None) -> tuple[Any, ...]:
        descent, ends = Descent(self._chain, goal, search, self._weight), []
        beyond = self._is_beyond_reach(goal, search.position_tolerance)
        starts = min(search.starts, FEW_STARTS) if beyond else search.starts
        for number in range(starts):
            if start is not None and number == 0:
                found = descent.run(start, self._limits, PATIENT, path)
            else:
                found = descent.run(self._start(goal, number - (start is not None)), self._limits, HASTY, path)
            if found:
                return self._finish(descent, self._limits, number + 1)
            ends.append(descent.best)
        best = min(ends, key=lambda end: end.square)
        if descent.run(best.q, self._limits, PATIENT, path):  # the best of them to its end
            return self._finish(descent, self._limits, starts)
        if beyond:
            return _outcome(descent, OUT_OF_REACH, starts)
        return self._explain(descent, goal, search, path)

    def _finish(self, descent: Descent, box: Box, starts: int) -> tuple[Any, ...]:
        """Return the solution, moved along the self-motion where there is an objective."""
        if descent.search.objective.kind == 0:
            return _outcome(descent, SOLVED, starts)
        motion = SelfMotion(descent, box)
        descent.best, slope = motion.descend(descent.best)
        descent.steps += motion.steps
        return _outcome(descent, SOLVED, starts, slope)

    def _explain(self, descent: Descent, goal: Goal, search: Search, path: np.ndarray | None) -> tuple[Any, ...]:
        """Return the outcome of a search without success, and why."""
        best = descent.best
        stationary, blocked = descent.is_stationary(self._limits), bool(descent.blocked(self._limits).any())
        singular = descent.is_singular()
        without_limits = False
        for number in range(min(search.starts, FEW_STARTS)):
            start = self._start(goal, number - 1) if number else best.q
            without_limits = descent.run(start, self._unlimited, HASTY if number else PATIENT, None)
            if without_limits:
                wrapped = self._wrap(descent.best.q)
                if wrapped is not None and descent.run(wrapped, self._limits, PATIENT, path):
                    return self._finish(descent, self._limits, search.starts)
                break
        status = ITERATIONS
        if without_limits or (stationary and blocked and search.starts == 1):
            status = LIMITS
        elif stationary:
            status = OUT_OF_REACH if search.starts > 1 or not singular else SINGULAR
        descent.best = best
        return _outcome(descent, status, search.starts)

    def _around(self, q: np.ndarray, change: float) -> Box:
        """Return the part of the limits that is no further than `change` from `q`, which is moved to them first."""
        (low, high), q = self._limits, np.clip(q, *self._limits)
        return np.maximum(low, q - change), np.minimum(high, q + change)

    def _follow(
        self, goal: Goal, search: Search, start: np.ndarray, box: Box, path: np.ndarray | None = None
    ) -> tuple[Any, ...]:
        descent = Descent(self._chain, goal, search, self._weight)
        if descent.run(start, box, PATIENT, path):
            return self._finish(descent, box, 1)
        status = ITERATIONS
        if self._is_beyond_reach(goal, search.position_tolerance):
            status = OUT_OF_REACH
        elif descent.blocked(self._limits).any():
            status = LIMITS
        elif descent.blocked(box).any():
            status = BOUND
        elif descent.is_stationary(box):
            status = SINGULAR if descent.is_singular() else OUT_OF_REACH
        return _outcome(descent, status, 1)

    def _start(self, goal: Goal, number: int) -> np.ndarray:
        """Return start `number` of the table.

        Of block `number` mod `BLOCKS`, the posture that is next in the order of ``|e|^2`` with rotations by
        ``2 (1 - cos)``; then that of the next block.
        """
        rows = slice(BLOCK * (number % BLOCKS), BLOCK * (number % BLOCKS + 1))
        R, p = self._poses[rows, :, :3], self._poses[rows, :, 3]
        distance = np.zeros(BLOCK)
        if goal.has_position:
            distance += self._weight**2 * np.sum((p - goal.T[:3, 3]) ** 2, axis=1)
        if goal.task == 6:
            distance -= np.sum(R * goal.T[:3, :3], axis=(1, 2))
        if goal.has_axis:
            distance -= 2.0 * (R @ goal.axis) @ (goal.T[:3, :3] @ goal.axis)
        order = np.argsort(distance, kind="stable")
        return self._angles[rows][order[number // BLOCKS % BLOCK]]

    def _is_beyond_reach(self, goal: Goal, tolerance: float) -> bool:
        """Return whether the goal is further from the first joint than the links are long, whatever joints turn."""
        if not goal.has_position:
            return False
        frames, p, reach = self._chain.frames, goal.T[:3, 3], self._tool_reach
        if goal.task == 6:
            p, reach = p - goal.T[:3, :3] @ frames[-1, :3, :3].T @ frames[-1, :3, 3], self._wrist_reach
        return bool(np.linalg.norm(p - frames[0, :3, 3]) > (1.0 + 1e-9) * reach + tolerance)

    def _wrap(self, q: np.ndarray) -> np.ndarray | None:
        """Return `q` with revolute joints moved by whole turns into their limits; None where none fits."""
        (low, high), turn = self._limits, 2.0 * np.pi
        up = np.where(q < low, np.ceil((low - q) / turn), 0.0)
        q = np.where(self._chain.prismatic, q, q + turn * up)
        down = np.where(q > high, np.ceil((q - high) / turn), 0.0)
        q = np.where(self._chain.prismatic, q, q - turn * down)
        return q if np.all((low <= q) & (q <= high)) else None


def _outcome(descent: Descent, status: int, starts: int, slope: float = np.nan) -> tuple[Any, ...]:
    best = descent.best
    return best.q, (best.position_error, best.rotation_error, slope), (descent.steps, starts, status)


def uniform(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Return the first numbers of the sequence SplitMix64 of `seed`, uniform in [0, 1)."""
    with np.errstate(over="ignore"):
        counter = np.arange(1, shape[0] * shape[1] + 1, dtype=np.uint64)
        z = np.uint64(seed) + counter * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((z ^ (z >> np.uint64(31))) >> np.uint64(11)).astype(np.float64).reshape(shape) * 2.0**-53


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
    """
    search = Search(
        steps, starts, position_tolerance, rotation_tolerance, damping, Objective(objective, np.zeros(0), np.zeros(0))
    )
    goals = np.asarray(T_base_tool, dtype=float)
    n = solver._chain.n
    reference, scale = (np.zeros(n) if vector is None else vector for vector in (reference, scale))
    references, scales = (
        np.broadcast_to(np.asarray(reference, dtype=float), (*goals.shape[:-2], n)),
        np.asarray(scale, dtype=float),
    )
    direction = np.asarray(axis, dtype=float)
    start = None if q0 is None else np.asarray(q0, dtype=float)
    bound = None if change is None else np.asarray(change, dtype=float)
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
