"""One start of the inverse kinematics: residual, damped steps inside limits, when to give up; then the descent of an
objective along the self-motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .chain import Chain

NONE, POSTURE, LIMITS, MANIPULABILITY = range(4)
TIE = 1e-3  # of the sum of squares in the objective LIMITS
_Value = tuple[float, np.ndarray]


class Objective(NamedTuple):
    """What is made least: 0 nothing, 1 posture, 2 limits, 3 manipulability; reference and scale (n,) of 1 and 2."""

    kind: int
    reference: np.ndarray
    scale: np.ndarray


def value_and_gradient(
    chain: Chain, goal: Goal, weight: float, objective: Objective, sharpness: float, at: Iterate
) -> _Value:
    """Return an objective and its gradient (n,) at a posture.

    With ``x = scale (q - reference)``: posture is ``sum of x^2 / 2``; limits is the largest ``|x|`` made smooth,
    ``log(sum of exp(s x) + exp(-s x)) / s`` with the sharpness s, and a little of the sum of squares for the joints
    that are not the nearest to their limits; manipulability is ``-log(det(J J^T)) / 2`` of the rows of the task.
    """
    if objective.kind == MANIPULABILITY:
        return _manipulability(chain, goal, weight, at)
    x = objective.scale * (at.q - objective.reference)
    squares = float(x @ x) / 2.0
    if objective.kind == POSTURE:
        return squares, objective.scale * x
    largest = np.abs(x).max()
    up, down = np.exp(sharpness * (x - largest)), np.exp(sharpness * (-x - largest))
    total = np.sum(up + down)
    gradient = objective.scale * ((up - down) / total + TIE * x)
    return float(largest + np.log(total) / sharpness + TIE * squares), gradient


def _manipulability(chain: Chain, goal: Goal, weight: float, at: Iterate) -> _Value:
    """``d/dq_k = -tr((J J^T)^-1 dJ/dq_k J^T)``; rows across the tool's axis turn with the tool."""
    T, J = chain.forward_jacobian(at.q)
    dJ = chain.jacobian_derivative(np.broadcast_to(at.q, (chain.n, chain.n)), np.eye(chain.n))  # by joint
    rows = []
    if goal.has_position:
        rows.append(weight * dJ[:, :3])
    if goal.task == 6:
        rows.append(dJ[:, 3:])
    if goal.has_axis:
        across = goal.across @ T[:3, :3].T
        turning = np.cross(J[3:].T[:, None], across)  # w_k x u
        rows.append(across @ dJ[:, 3:] + turning @ J[3:])
    normal = at.J @ at.J.T
    sign, logarithm = np.linalg.slogdet(normal)
    if sign <= 0:
        return np.inf, np.zeros(chain.n)
    G = np.linalg.solve(normal, at.J)
    return -float(logarithm) / 2.0, -np.einsum("kaj,aj->k", np.concatenate(rows, axis=1), G)


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


MOST_STEPS = 100
LEAST_SLOPE = 1e-10  # where the descent ends
NO_SLOPE = 1e-6  # along a direction without curvature, of the slope
LONGEST_STEP = 0.3  # of a joint
DIFFERENCE = 1e-6  # of joints, for second derivatives
SHARPNESSES = (30.0, 300.0, 1000.0)  # of the objective LIMITS, one after the other


class NullSpace(NamedTuple):
    """A basis (n, d) of the null space, 0 in fixed joints, and ``gradient = J^T mu + N reduced`` in the others."""

    basis: np.ndarray
    mu: np.ndarray
    reduced: np.ndarray

    @property
    def slope(self) -> float:
        """Length of the projected gradient."""
        return float(np.sqrt(self.reduced @ self.reduced))


class SelfMotion:
    """With the tool at its goal, joints move to where an objective is least.

    Newton steps in the null space of the task, with the curvature of the task in the Hessian. Joints at a limit that a
    step would press against it stay there. After each step the tool is brought back to the goal.
    """

    def __init__(self, descent: Descent, box: Box) -> None:
        self._descent, self._box = descent, box
        self._sharpness = SHARPNESSES[0]
        self.steps = 0

    def descend(self, at: Iterate) -> tuple[Iterate, float]:
        """Return the posture where the objective is least and the slope that is left along the free self-motion."""
        at, slope = self._restore(at.q, self._box) or at, 0.0
        for self._sharpness in SHARPNESSES:
            at, slope = self._descend_once(at)
            if self._descent.search.objective.kind != LIMITS:
                break
        return at, slope

    def _descend_once(self, at: Iterate) -> tuple[Iterate, float]:
        most = self.steps + MOST_STEPS
        while True:
            value, gradient = self._value(at)
            fixed, space = self._downhill(at, gradient, np.zeros(len(at.q), dtype=bool))
            if space.slope <= LEAST_SLOPE or self.steps == most:
                return at, space.slope
            fixed, direction, fall = self._direction(at, gradient, fixed, space)
            there = self._advance(at, value, fixed, direction, fall)
            if there is None:
                return at, space.slope
            at, self.steps = there, self.steps + 1

    def _value(self, at: Iterate) -> tuple[float, np.ndarray]:
        descent = self._descent
        objective = descent.search.objective
        return value_and_gradient(descent.chain, descent.goal, descent.weight, objective, self._sharpness, at)

    def _downhill(self, at: Iterate, gradient: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, NullSpace]:
        """Return the null space of the joints that can go downhill: those that would leave the box are fixed."""
        while True:
            space = _null_space(at.J, gradient, fixed)
            pressed = self._pressed(at, -space.basis @ space.reduced)
            if not pressed.any():
                return fixed, space
            fixed = fixed | pressed

    def _pressed(self, at: Iterate, direction: np.ndarray) -> np.ndarray:
        low, high = self._box
        return ((at.q >= high) & (direction > 0.0)) | ((at.q <= low) & (direction < 0.0))

    def _direction(
        self, at: Iterate, gradient: np.ndarray, fixed: np.ndarray, space: NullSpace
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return fixed joints, the step and what the slope promises of it.

        The Newton step, with the joints that it presses against a limit fixed as well; where that leaves nothing, the
        step goes straight downhill.
        """
        fewer, part = fixed, space
        while part.slope > LEAST_SLOPE:
            direction, fall = _along(part, self._newton(at, gradient, part))
            pressed = self._pressed(at, direction)
            if not pressed.any():
                return fewer, direction, fall
            fewer, part = self._downhill(at, gradient, fewer | pressed)
        return fixed, *_along(space, -space.reduced)

    def _newton(self, at: Iterate, gradient: np.ndarray, space: NullSpace) -> np.ndarray:
        """Return ``-|H|^-1 reduced`` with H of objective - mu^T task in the null space, by differences.

        The absolute values of the eigenvalues lead downhill also where the curvature is negative; along directions
        without slope and curvature the step is 0.
        """
        columns = []
        for direction in space.basis.T:
            there = self._descent.evaluate(at.q + DIFFERENCE * direction)
            change = self._value(there)[1] - gradient - (there.J - at.J).T @ space.mu
            columns.append(space.basis.T @ change / DIFFERENCE)
        H = np.stack(columns, axis=1)
        curvatures, V = np.linalg.eigh((H + H.T) / 2.0)
        sizes, slopes = np.abs(curvatures), V.T @ space.reduced
        flat = 1e-9 * sizes.max()
        known = (sizes > flat) | (np.abs(slopes) > NO_SLOPE * space.slope)
        return -V @ np.divide(slopes, np.maximum(sizes, flat), out=np.zeros(len(slopes)), where=known)

    def _advance(
        self, at: Iterate, value: float, fixed: np.ndarray, direction: np.ndarray, fall: float
    ) -> Iterate | None:
        """Return where the step ends, as far as the limits and the objective allow; None where nothing is gained."""
        end = np.where(direction > 0.0, self._box[1], self._box[0])
        room, rounding = end - at.q, 1e-13 * max(1.0, abs(value))
        short = np.abs(direction) > np.abs(room)
        part = float(np.min(room[short] / direction[short], initial=1.0))
        shortest = 1e-6 * part
        while part > shortest:
            moved = part * direction
            arrives = (moved != 0.0) & (np.abs(moved) >= (1.0 - 1e-12) * np.abs(room))
            there = np.where(arrives, end, np.clip(at.q + moved, *self._box))
            kept = (
                arrives | fixed
            )  # they do not leave the limit on the way back to the goal, unless there is no other way
            pinned = np.where(kept, there, self._box[0]), np.where(kept, there, self._box[1])
            restored = self._restore(there, pinned) or self._restore(there, self._box)
            if restored and self._value(restored)[0] <= value - 1e-4 * part * fall + rounding:
                return restored
            part *= 0.5
        return None

    def _restore(self, q: np.ndarray, box: Box) -> Iterate | None:
        """Return `q` brought back to the goal, or None where that fails."""
        here = self._descent.evaluate(q)
        for _ in range(8):
            if here.square <= 1e-30 or (moved := step(here, box, 1e-12)) is None:
                break
            there = self._descent.evaluate(moved)
            if not there.square < here.square:
                break
            here = there
        return here if self._descent.is_there(here) else None


def _along(space: NullSpace, z: np.ndarray) -> tuple[np.ndarray, float]:
    """Return N z shortened to `LONGEST_STEP`, and what the slope promises of it."""
    direction = space.basis @ z
    factor = LONGEST_STEP / max(LONGEST_STEP, np.abs(direction).max(initial=0.0))
    return factor * direction, -factor * float(z @ space.reduced)


def _null_space(J: np.ndarray, gradient: np.ndarray, fixed: np.ndarray) -> NullSpace:
    """By Householder reflections of J^T; where the task is singular its multiplier is 0."""
    m, n = J.shape
    moving = np.flatnonzero(~fixed)
    size = max(len(moving) - m, 0)
    basis, mu = np.zeros((n, size)), np.zeros(m)
    if size == 0:
        return NullSpace(basis, mu, np.zeros(0))
    A, y, reflections = J[:, moving].T.copy(), gradient[moving].copy(), []
    for a in range(m):
        v = np.zeros(len(moving))
        v[a:] = A[a:, a]
        v[a] += np.copysign(np.sqrt(v @ v), v[a] if v[a] > 0.0 else -1.0)
        length = v @ v
        v *= np.sqrt(2.0 / length) if length > 0.0 else 0.0
        A -= np.outer(v, v @ A)
        y -= (v @ y) * v
        reflections.append(v)
    for a in reversed(range(m)):
        mu[a] = (y[a] - A[a, a + 1 :] @ mu[a + 1 :]) / A[a, a] if abs(A[a, a]) > 1e-12 else 0.0
    N = np.eye(len(moving))[:, m:]
    for v in reversed(reflections):
        N = N - np.outer(v, v @ N)
    basis[moving] = N
    return NullSpace(basis, mu, y[m:])
