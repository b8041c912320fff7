"""Descent of an objective along the self-motion (specification; the compiled twin is native/self_motion.h)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armlab.kernels._reference.descent import Box, Descent, Iterate, step
from armlab.kernels._reference.objective import LIMITS, value_and_gradient

__all__ = ["SelfMotion"]

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
        """Return the posture where the objective is least and the slope that is left along the free self-motion.

        Parameters
        ----------
        at : a posture at the goal.
        """
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
