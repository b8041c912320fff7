"""One start of the inverse kinematics: residual, damped steps inside limits, and when to give up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armlab.kernels._reference.objective import Objective

if TYPE_CHECKING:
    from armlab.kernels._reference.chain import Chain

__all__ = ["HASTY", "PATIENT", "Box", "Descent", "Goal", "Iterate", "Search"]

LEAST_DAMPING = 1e-12
GRACE = 3  # steps in a row that may fail to be the best before they are taken back
STATIONARY_COSINE = 1e-2  # between the residual and what free joints can do about it
Box = tuple[np.ndarray, np.ndarray]


class Patience(NamedTuple):
    """A start is given up when the last `window` steps together left more than `rate` of |e|^2."""

    window: int
    rate: float


HASTY, PATIENT = Patience(4, 0.5), Patience(24, 1.0 - 1e-6)


class Search(NamedTuple):
    """What a search may take: steps per start, starts, tolerances [m], [rad], damping; and an objective."""

    steps: int
    starts: int
    position_tolerance: float
    rotation_tolerance: float
    damping: float
    objective: Objective


class Goal:
    """What is asked for, by the number of rows of the task.

    6 the pose; 3 the position; 5 the position, and the direction of an axis of the tool as in the goal; 2 that
    direction alone.
    """

    def __init__(self, task: int, T: np.ndarray, axis: np.ndarray) -> None:
        self.task, self.T = task, T
        self.has_position, self.has_axis = task != 2, task in (5, 2)
        axis = axis / np.abs(axis).max()  # its square may overflow
        self.axis = axis / np.sqrt(axis @ axis)
        far = np.eye(3)[np.argmin(np.abs(self.axis))]
        across = np.cross(self.axis, far)
        across /= np.sqrt(across @ across)
        self.across = np.stack([across, np.cross(self.axis, across)])


@dataclass
class Iterate:
    """Residual e and Jacobian J about the same point: a small step dq changes e by -J dq. Rows in radians."""

    q: np.ndarray
    J: np.ndarray
    e: np.ndarray
    square: float
    position_error: float
    rotation_error: float


class Descent:
    """Levenberg-Marquardt steps towards one goal, from one start after the other.

    The residual is ``e = [weight (p_goal - p); log(R_goal R^T)]`` in base axes, the step
    ``dq = J^T (J J^T + lambda I)^-1 e`` with ``lambda = damping |e|^2``: quadratic convergence at the goal.
    """

    def __init__(self, chain: Chain, goal: Goal, search: Search, weight: float) -> None:
        self.chain, self.goal, self.search, self.weight = chain, goal, search, weight
        self.steps = 0  # of all runs

    def run(self, q: np.ndarray, box: Box, patience: Patience, history: np.ndarray | None) -> bool:
        """Descend from `q` inside the box; True when that gets to the goal. `best` is where it ends.

        A step that does not reduce the error may still lead on, as along a curved valley near a singular posture:
        `GRACE` of them are tried before the damping is raised.
        """
        here = self.best = self.evaluate(np.clip(q, *box))
        damping, left, squares = self.search.damping, GRACE, [self.best.square]
        if history is not None:
            history[...] = np.nan
        for k in range(self.search.steps + 1):
            if history is not None:
                history[k] = self.best.position_error, self.best.rotation_error
            if self.is_there(self.best):
                return True
            long_ago = squares[k - patience.window] if k >= patience.window else np.inf
            if k == self.search.steps or not self.best.square <= patience.rate * long_ago:
                return False
            self.steps += 1
            moved = step(here, box, damping * here.square + LEAST_DAMPING)
            trial = None if moved is None else self.evaluate(moved)
            left -= 1
            if trial is not None and trial.square < self.best.square:
                here = self.best = trial
                damping, left = max(damping / 4.0, self.search.damping), GRACE
            elif trial is not None and left > 0:
                here = trial
            else:
                here, damping, left = self.best, 8.0 * damping, GRACE
            squares.append(self.best.square)
        return False

    def evaluate(self, q: np.ndarray) -> Iterate:
        """Return residual and Jacobian at `q`."""
        goal = self.goal
        T, J = self.chain.forward_jacobian(q)
        rows, e, position_error, rotation_error = [], [], np.nan, np.nan
        if goal.has_position:
            d = goal.T[:3, 3] - T[:3, 3]
            position_error = np.sqrt(d @ d)
            rows.append(self.weight * J[:3])
            e.append(self.weight * d)
        if goal.task == 6:
            w = _log(goal.T[:3, :3] @ T[:3, :3].T)
            rotation_error = np.sqrt(w @ w)
            rows.append(J[3:])
            e.append(w)
        if goal.has_axis:
            w, across = _axis_residual(goal, T[:3, :3])
            rotation_error = np.sqrt(w @ w)
            rows.append(across @ J[3:])
            e.append(w)
        residual = np.concatenate(e)
        square = float(residual @ residual)
        return Iterate(q, np.concatenate(rows), residual, square, float(position_error), float(rotation_error))

    def blocked(self, box: Box) -> np.ndarray:
        """(n,) whether the residual pulls a joint against its end of the box."""
        slope = self.best.J.T @ self.best.e
        return ((self.best.q >= box[1]) & (slope > 0.0)) | ((self.best.q <= box[0]) & (slope < 0.0))

    def is_stationary(self, box: Box) -> bool:
        """Whether no joint that is free to move reduces the error: ``|J^T e|`` is small against ``|J| |e|``."""
        J = self.best.J[:, ~self.blocked(box)]
        slope = J.T @ self.best.e
        return bool(slope @ slope <= STATIONARY_COSINE**2 * np.sum(J * J) * self.best.square)

    def is_singular(self) -> bool:
        """Whether joints could do more elsewhere than at the best posture.

        Where there are joints enough for the task, a stationary residual says so; otherwise, that columns of J depend
        on those before them.
        """
        J = self.best.J
        if J.shape[1] >= J.shape[0]:
            return True
        before = np.linalg.norm(J, axis=0)
        return bool(np.any(np.abs(np.diag(np.linalg.qr(J, mode="r"))) <= STATIONARY_COSINE * before))

    def is_there(self, here: Iterate) -> bool:
        """Return whether the errors are within the tolerances."""
        position = not self.goal.has_position or here.position_error <= self.search.position_tolerance
        return position and (self.goal.task == 3 or here.rotation_error <= self.search.rotation_tolerance)


def step(here: Iterate, box: Box, damping: float) -> np.ndarray | None:
    """Return ``q + J^T (J J^T + lambda I)^-1 e`` inside the box, or None when the equations cannot be solved.

    A joint that would leave the box goes to its end; the others make up for what it does not do.
    """
    q, e, moves = here.q.copy(), here.e.copy(), np.ones(len(here.q), dtype=bool)
    while True:
        J = here.J[:, moves]
        try:
            np.linalg.cholesky(normal := J @ J.T + damping * np.eye(len(e)))
        except np.linalg.LinAlgError:
            return None
        wanted = here.q[moves] + J.T @ np.linalg.solve(normal, e)
        q[moves] = np.clip(wanted, box[0][moves], box[1][moves])
        stopped = moves.copy()
        stopped[moves] = q[moves] != wanted
        if not stopped.any():
            return q
        e -= here.J[:, stopped] @ (q - here.q)[stopped]
        moves &= ~stopped


def _axis_residual(goal: Goal, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shortest rotation vector from the tool's axis to the goal's, in two directions across; and those."""
    now, wanted, across = R @ goal.axis, goal.T[:3, :3] @ goal.axis, goal.across @ R.T
    turn = np.cross(now, wanted)
    sine, cosine = np.sqrt(turn @ turn), now @ wanted
    angle = np.arctan2(sine, cosine)
    if sine == 0.0:  # along, or against: then any direction across is as short
        return np.array([angle, 0.0]), across
    return across @ turn * (angle / sine), across


def _log(R: np.ndarray) -> np.ndarray:
    """Return the rotation vector, from the quaternion whose largest component is found first."""
    product = np.array(  # 4 q q^T
        [
            [1 + R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], 1 + R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], 1 - R[0, 0] + R[1, 1] - R[2, 2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1 - R[0, 0] - R[1, 1] + R[2, 2]],
        ]
    )
    row = product[np.argmax(np.diag(product))]
    quaternion = row / np.sqrt(row @ row) * (np.sign(row[np.flatnonzero(row)[0]]))
    w, v = quaternion[0], quaternion[1:]
    length = np.sqrt(v @ v)
    return (2.0 * np.arctan2(length, w) / length if length > 0.0 else 2.0) * v
