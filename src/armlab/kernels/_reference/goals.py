"""Arguments of the inverse kinematics: the checks of `native/bind_inverse.cpp`, with the same sentences."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import read
from armlab.kernels._reference.descent import Search
from armlab.kernels._reference.lie_arguments import ROTATION_TOLERANCE, departure
from armlab.kernels._reference.objective import Objective

__all__ = ["read_goals", "read_search", "read_task", "read_vectors"]


def read_goals(value: Any) -> np.ndarray:
    """Return goals (..., 4, 4).

    Raises
    ------
    ShapeError
        When one of them is not a finite pose, or the shape is another.
    """
    T = read(value, "T_base_tool", ())
    if T.shape[-2:] != (4, 4):
        raise ShapeError(f"Expected T_base_tool of shape (..., 4, 4), got {T.shape}.")
    with np.errstate(invalid="ignore", over="ignore"):
        off, det = departure(T[..., :3, :3])
    good = np.isfinite(T).all(axis=(-1, -2)) & (off <= ROTATION_TOLERANCE) & (det > 0.0)
    good &= (T[..., 3, :] == [0.0, 0.0, 0.0, 1.0]).all(axis=-1)
    if not good.all():
        raise ShapeError(
            "Expected finite poses with a rotation orthonormal to 1e-6 and last row 0 0 0 1, got "
            f"{_place('T_base_tool', good)} that is not. Project it if it is nearly one (lie.se3.project)."
        )
    return T


def read_vectors(value: Any, name: str, goals: np.ndarray, n: int) -> np.ndarray:
    """Return one joint vector (..., n) per goal.

    Raises
    ------
    ShapeError
        When the shape is neither (n,) nor that, or one is not finite.
    """
    q = read(value, name, ())
    batch = goals.shape[:-2]
    if q.shape not in ((n,), (*batch, n)):
        raise ShapeError(
            f"Expected {name} of shape ({n},) or one posture per goal of T_base_tool {goals.shape}, got {q.shape}."
        )
    good = np.asarray(np.isfinite(q).all(axis=-1))
    if not good.all():
        raise ShapeError(f"Expected finite joint positions, got others in {_place(name, good)}.")
    return np.broadcast_to(q, (*batch, n))


def read_task(task: int, axis: Any) -> np.ndarray:
    """Return the direction (3,) of the tool that a task asks for.

    Raises
    ------
    ShapeError
        When there is no task of so many rows, or the direction has no length.
    """
    if task not in (6, 5, 3, 2):
        raise ShapeError(f"Expected a task of 6, 5, 3 or 2 rows, got {task}.")
    direction = read(axis, "axis", (3,), exact=True)
    if not (np.isfinite(direction).all() and np.abs(direction).max() > 1e-9):
        raise ShapeError("Expected axis to be a direction in tool axes, got one that is not finite or has no length.")
    return direction


def read_search(steps: int, starts: int, position: float, rotation: float, damping: float, objective: int) -> Search:
    """Return what a search may take.

    Raises
    ------
    ShapeError
        When one of the numbers makes no sense.
    """
    if objective not in range(4):
        raise ShapeError(f"Expected an objective from 0 to 3, got {objective}.")
    if not (steps >= 0 and starts >= 1 and position >= 0.0 and rotation >= 0.0 and damping > 0.0):
        raise ShapeError("Expected steps >= 0, starts >= 1, tolerances >= 0 and damping > 0, got others.")
    return Search(steps, starts, position, rotation, damping, Objective(objective, np.zeros(0), np.zeros(0)))


def _place(name: str, good: np.ndarray) -> str:
    """Return ``name[i, j]`` for the first sample of the batch that is not good."""
    if good.ndim == 0:
        return name
    return f"{name}[{', '.join(map(str, np.unravel_index(int(np.argmin(good)), good.shape)))}]"
