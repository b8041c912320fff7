"""`Inverse`: what the inverse kinematics found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["REASONS", "Inverse", "freeze"]

REASONS = ("solved", "out of reach", "limits", "singular", "iterations", "bound")
_TEXTS = np.array(REASONS)
_EXPLANATIONS = {
    "out of reach": "no posture that was tried comes nearer, with or without limits of revolute joints",
    "limits": "a posture outside the joint limits gets there, none was found inside",
    "singular": "from the start only a singular posture is reached, where no joint reduces the error",
    "iterations": "the steps ended while the error was still falling",
    "bound": "no joint may move further from the start",
}


@dataclass(frozen=True, eq=False)
class Inverse:
    """Joint positions for one goal or a batch of goals; arrays are read-only, and scalars for one goal.

    Attributes
    ----------
    q : (..., n) joint positions, always within the limits; without success the posture with the least error.
    success : (...) whether the errors are within the tolerance.
    position_error : (...) distance from tool point to goal [m]; NaN when the task is a direction.
    rotation_error : (...) angle to the goal, of the tool or of its axis [rad]; NaN when the task is a position.
    iterations : (...) steps of all starts together.
    starts : (...) starts that were tried.
    reason : (...) "solved", or why not:
        "out of reach" further from the first joint than the links are long, or all starts, also without the limits of
        revolute joints, ended where no joint reduces the error;
        "limits" a posture outside the limits gets there, none was found inside;
        "singular" the only start ended at a singular posture, where no joint reduces the error;
        "iterations" the error was still falling when the steps ended.
    slope : (...) length of the gradient of the objective that is left along the self-motion of the joints that are not
        at a limit; NaN without an objective or a solution.
    history : (..., maxiter + 1, 2) least errors so far [m, rad] after each step of the descent that gave `q` (of the
        best start going on, where all have failed), NaN after its end; None unless asked for.
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
        """Return one sentence: how many goals are solved and how well, or what is in the way."""
        if np.ndim(self.success) == 0:
            return self._one()
        count, solved = np.size(self.success), int(np.sum(self.success))
        text = f"{solved} of {count} goals solved"
        if solved:
            text += f", to {_errors(self.position_error[self.success], self.rotation_error[self.success])}"
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
            return f"Solved to {errors} in {spent}."
        reason = str(self.reason)
        return f"Not solved ({reason}: {_EXPLANATIONS[reason]}); the best posture is off by {errors} after {spent}."

    def __repr__(self) -> str:
        return f"Inverse({self.report()})"


def freeze(q: np.ndarray, errors: np.ndarray, counts: np.ndarray, history: np.ndarray | None) -> Inverse:
    """Return what a kernel gave as an `Inverse`; single goals get scalars.

    Parameters
    ----------
    q : (..., n). errors : (..., 3) [m], [rad], slope. counts : (..., 3) steps, starts, status. history : or None.
    """
    for array in (q, errors, counts, history):
        if array is not None:
            array.flags.writeable = False
    if counts.ndim == 1:
        steps, starts, status = counts
        return Inverse(q, status == 0, errors[0], errors[1], steps, starts, REASONS[status], errors[2], history)
    success, reason = counts[..., 2] == 0, _TEXTS[counts[..., 2]]
    success.flags.writeable = reason.flags.writeable = False
    return Inverse(
        q, success, errors[..., 0], errors[..., 1], counts[..., 0], counts[..., 1], reason, errors[..., 2], history
    )


def _errors(position: np.ndarray, rotation: np.ndarray) -> str:
    told = [(position, "m"), (rotation, "rad")]
    return " and ".join(f"{np.max(values):.2g} {unit}" for values, unit in told if not np.isnan(values).all())
