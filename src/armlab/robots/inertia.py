"""Inertial parameters of bodies: ten numbers that add up where bodies are rigidly joined.

``pi = [m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]``: mass, first moments and inertia about the origin of the
frame in which they are given. ``Ixy`` is the entry of the matrix, so ``-m x y`` for a point mass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError
from armlab.lie import se3

__all__ = ["Body", "from_body", "principal_moments", "to_body", "transform"]

_ROWS, _COLUMNS = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])  # xx xy yy xz yz zz


class Body(NamedTuple):
    """A rigid body as data sheets describe it.

    Attributes
    ----------
    mass : (...) [kg].
    centre : (..., 3) centre of mass [m]; zero where there is no mass.
    inertia : (..., 3, 3) about the centre of mass, axes of the frame [kg m^2].
    """

    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray


def from_body(mass: ArrayLike, centre: ArrayLike, inertia: ArrayLike) -> np.ndarray:
    """Return the parameters of a body: ``I_origin = I_centre + m (c·c 1 - c cᵀ)``.

    Parameters
    ----------
    mass : (...) [kg].
    centre : (..., 3) centre of mass [m].
    inertia : (..., 3, 3) about the centre of mass [kg m^2].

    Returns
    -------
    pi : (..., 10).

    Raises
    ------
    ShapeError : when the shapes do not fit.
    """
    m, c, inertia = (np.asarray(value, dtype=np.float64) for value in (mass, centre, inertia))
    if c.shape[-1:] != (3,) or inertia.shape[-2:] != (3, 3):
        raise ShapeError(
            f"Expected a centre of shape (..., 3) and an inertia of shape (..., 3, 3), got {c.shape}, {inertia.shape}."
        )
    squares = (c * c).sum(axis=-1)[..., None, None] * np.eye(3) - c[..., :, None] * c[..., None, :]
    about = inertia + m[..., None, None] * squares
    pi = np.empty((*about.shape[:-2], 10))
    pi[..., 0] = m
    pi[..., 1:4] = m[..., None] * c
    pi[..., 4:] = about[..., _ROWS, _COLUMNS]
    return pi


def to_body(pi: ArrayLike) -> Body:
    """Return mass, centre of mass and inertia about it: the inverse of `from_body`.

    Parameters
    ----------
    pi : (..., 10).
    """
    pi = _parameters(pi)
    mass, first = pi[..., 0], pi[..., 1:4]
    centre = np.divide(first, mass[..., None], out=np.zeros_like(first), where=mass[..., None] != 0)
    squares = (first * centre).sum(axis=-1)[..., None, None] * np.eye(3) - first[..., :, None] * centre[..., None, :]
    return Body(mass, centre, _matrix(pi) - squares)


def transform(T_a_b: ArrayLike, pi: ArrayLike) -> np.ndarray:
    """Return the parameters in frame a of a body whose parameters are given in frame b.

    ``P_a = T_a_b P_b T_a_bᵀ`` with the pseudo-inertia ``P = [[S, m c], [m cᵀ, m]]``, ``S = ∫ x xᵀ dm``.

    Parameters
    ----------
    T_a_b : (..., 4, 4) pose of b in a.
    pi : (..., 10) in frame b.

    Returns
    -------
    (..., 10) in frame a.

    References
    ----------
    Wensing, Kim, Slotine: Linear matrix inequalities for physically consistent inertial parameter identification,
    RA-L 3(1), 2018.
    """
    pi, T = _parameters(pi), np.asarray(T_a_b, dtype=np.float64)
    if T.shape[-2:] != (4, 4) or not se3.is_pose(T).all():
        raise ShapeError(f"Expected poses T_a_b of shape (..., 4, 4), got {T.shape} or no rotation.")
    inertia = _matrix(pi)
    P = np.empty((*pi.shape[:-1], 4, 4))
    P[..., :3, :3] = _second_moments(inertia)
    P[..., :3, 3] = P[..., 3, :3] = pi[..., 1:4]
    P[..., 3, 3] = pi[..., 0]
    P = T @ P @ np.swapaxes(T, -1, -2)
    result = np.empty((*P.shape[:-2], 10))
    result[..., 0] = P[..., 3, 3]
    result[..., 1:4] = P[..., :3, 3]
    result[..., 4:] = _inertia(P[..., :3, :3])[..., _ROWS, _COLUMNS]
    return result


def principal_moments(pi: ArrayLike) -> np.ndarray:
    """Return the principal moments of inertia about the centre of mass, smallest first.

    None is negative and the first two add up to at least the third: in a body whose density is nowhere negative.

    Parameters
    ----------
    pi : (..., 10).

    Returns
    -------
    (..., 3) [kg m^2].
    """
    return np.linalg.eigvalsh(to_body(pi).inertia)


def _parameters(pi: ArrayLike) -> np.ndarray:
    pi = np.asarray(pi, dtype=np.float64)
    if pi.shape[-1:] != (10,) or not np.isfinite(pi).all():
        raise ShapeError(f"Expected finite inertial parameters of shape (..., 10), got shape {pi.shape}: {pi}.")
    return pi


def _matrix(pi: np.ndarray) -> np.ndarray:
    """Inertia about the origin, (..., 3, 3)."""
    inertia = np.empty((*pi.shape[:-1], 3, 3))
    inertia[..., _ROWS, _COLUMNS] = inertia[..., _COLUMNS, _ROWS] = pi[..., 4:]
    return inertia


def _second_moments(inertia: np.ndarray) -> np.ndarray:
    """Second moments S = tr(I)/2 1 - I."""
    return np.trace(inertia, axis1=-2, axis2=-1)[..., None, None] / 2 * np.eye(3) - inertia


def _inertia(moments: np.ndarray) -> np.ndarray:
    """I = tr(S) 1 - S."""
    return np.trace(moments, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - moments
