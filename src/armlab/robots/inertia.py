"""Inertial parameters: ten numbers per body, additive over rigidly attached bodies.

``pi = [m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]``: mass, first moments and inertia about the origin of the
frame in which they are expressed. ``Ixy`` is the matrix entry: ``-m x y`` for a point mass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.lie.arguments import broadcasts

__all__ = ["from_body", "transform"]

_ROWS, _COLUMNS = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])  # xx xy yy xz yz zz


class Body(NamedTuple):
    """Rigid body described by data-sheet parameters, in the axes of its frame."""

    mass: np.ndarray  # (...) [kg]
    centre: np.ndarray  # (..., 3) centre of mass [m]; zero for a massless body
    inertia: np.ndarray  # (..., 3, 3) about the centre of mass [kg m^2]


def from_body(mass: ArrayLike, centre: ArrayLike, inertia: ArrayLike) -> np.ndarray:
    """Return the parameters (..., 10) of a body: ``I_origin = I_centre + m (c·c 1 - c cᵀ)``.

    Parameters
    ----------
    mass : (...) mass [kg].
    centre : (..., 3) centre of mass [m].
    inertia : (..., 3, 3) about the centre of mass [kg m^2].

    Raises
    ------
    ShapeError : if shapes do not match or a value is not a number.
    """
    m, c = numbers(mass, "mass", ShapeError), numbers(centre, "centre", ShapeError)
    inertia = numbers(inertia, "inertia", ShapeError)
    if c.shape[-1:] != (3,) or inertia.shape[-2:] != (3, 3):
        raise ShapeError(
            f"Expected a centre of shape (..., 3) and an inertia of shape (..., 3, 3), got {c.shape}, {inertia.shape}."
        )
    broadcasts(mass=(m, 0), centre=(c, 1), inertia=(inertia, 2))
    first = m[..., None] * c
    return _assemble(m, first, inertia + _squares(c, first))


def to_body(pi: ArrayLike) -> Body:
    """Return the mass, centre of mass and central inertia of parameters (..., 10); inverse of `from_body`."""
    pi = _parameters(pi)
    mass, first = pi[..., 0], pi[..., 1:4]
    centre = np.divide(first, mass[..., None], out=np.zeros_like(first), where=mass[..., None] != 0)
    return Body(mass, centre, _matrix(pi) - _squares(centre, first))


def transform(T_a_b: ArrayLike, pi: ArrayLike) -> np.ndarray:
    """Return the parameters (..., 10) of a body in frame a, given its parameters in frame b.

    With R and p of T_a_b and ``h = R m c``: ``m c_a = h + m p`` and
    ``I_a = R I_b Rᵀ + (2 p·h + m p·p) 1 - (p hᵀ + h pᵀ + m p pᵀ)``.

    Parameters
    ----------
    T_a_b : (..., 4, 4) pose of b in a.
    pi : (..., 10) parameters in frame b.

    Raises
    ------
    ShapeError : if T_a_b is not a pose or pi is not ten finite numbers.
    """
    pi, T = _parameters(pi), kernels.poses(numbers(T_a_b, "T_a_b", ShapeError), "T_a_b")
    if not np.isfinite(T).all():
        raise ShapeError("Expected finite poses T_a_b, got NaN or Inf.")
    broadcasts(T_a_b=(T, 2), pi=(pi, 1))
    R, p, m = T[..., :3, :3], T[..., :3, 3], pi[..., 0, None]
    h = (R @ pi[..., 1:4, None])[..., 0]
    about = R @ _matrix(pi) @ np.swapaxes(R, -1, -2) + _squares(p, 2 * h + m * p)
    return _assemble(pi[..., 0], h + m * p, about)


def principal_moments(pi: ArrayLike) -> np.ndarray:
    """Return the principal moments (..., 3) about the centre of mass [kg m^2], smallest first."""
    return np.linalg.eigvalsh(to_body(pi).inertia)


def _parameters(pi: ArrayLike) -> np.ndarray:
    pi = numbers(pi, "inertial parameters", ShapeError)
    if pi.shape[-1:] != (10,) or not np.isfinite(pi).all():
        raise ShapeError(f"Expected finite inertial parameters of shape (..., 10), got shape {pi.shape}: {pi}.")
    return pi


def _matrix(pi: np.ndarray) -> np.ndarray:
    inertia = np.empty((*pi.shape[:-1], 3, 3))
    inertia[..., _ROWS, _COLUMNS] = inertia[..., _COLUMNS, _ROWS] = pi[..., 4:]
    return inertia


def _squares(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return ``x·y 1`` minus the symmetric part of ``x yᵀ``: the inertia of masses at x with first moments y."""
    product = x[..., :, None] * y[..., None, :]
    return (x * y).sum(axis=-1)[..., None, None] * np.eye(3) - (product + np.swapaxes(product, -1, -2)) / 2


def _assemble(mass: np.ndarray, first: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Return (..., 10) from mass, first moments and inertia about the origin."""
    pi = np.empty((*np.broadcast_shapes(mass.shape, first.shape[:-1], about.shape[:-2]), 10))
    pi[..., 0] = mass
    pi[..., 1:4] = first
    pi[..., 4:] = about[..., _ROWS, _COLUMNS]
    return pi
