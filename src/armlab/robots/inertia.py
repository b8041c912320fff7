"""Inertial parameters of bodies: ten numbers that add up where bodies are rigidly joined.

``pi = [m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]``: mass, first moments and inertia about the origin of the
frame in which they are given. ``Ixy`` is the entry of the matrix, so ``-m x y`` for a point mass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.lie import se3

__all__ = ["from_body", "transform"]

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
    ShapeError : when the shapes do not fit or something is no number.
    """
    m, c = numbers(mass, "mass", ShapeError), numbers(centre, "centre", ShapeError)
    inertia = numbers(inertia, "inertia", ShapeError)
    if c.shape[-1:] != (3,) or inertia.shape[-2:] != (3, 3):
        raise ShapeError(
            f"Expected a centre of shape (..., 3) and an inertia of shape (..., 3, 3), got {c.shape}, {inertia.shape}."
        )
    _check_batches(mass=m.shape, centre=c.shape[:-1], inertia=inertia.shape[:-2])
    first = m[..., None] * c
    return _assemble(m, first, inertia + _squares(c, first))


def to_body(pi: ArrayLike) -> Body:
    """Return mass, centre of mass and inertia about it of parameters (..., 10): the inverse of `from_body`."""
    pi = _parameters(pi)
    mass, first = pi[..., 0], pi[..., 1:4]
    centre = np.divide(first, mass[..., None], out=np.zeros_like(first), where=mass[..., None] != 0)
    return Body(mass, centre, _matrix(pi) - _squares(centre, first))


def transform(T_a_b: ArrayLike, pi: ArrayLike) -> np.ndarray:
    """Return the parameters in frame a of a body whose parameters are given in frame b.

    With R and p of T_a_b and ``h = R m c``: ``m c_a = h + m p`` and
    ``I_a = R I_b Rᵀ + (2 p·h + m p·p) 1 - (p hᵀ + h pᵀ + m p pᵀ)``.

    Parameters
    ----------
    T_a_b : (..., 4, 4) pose of b in a.
    pi : (..., 10) in frame b.

    Returns
    -------
    (..., 10) in frame a.

    Raises
    ------
    ShapeError : when T_a_b is no pose or pi has no ten finite numbers.
    """
    pi, T = _parameters(pi), numbers(T_a_b, "T_a_b", ShapeError)
    if T.shape[-2:] != (4, 4) or not se3.is_pose(T).all():
        raise ShapeError(f"Expected poses T_a_b of shape (..., 4, 4), got shape {T.shape} or no rotation.")
    _check_batches(T_a_b=T.shape[:-2], pi=pi.shape[:-1])
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


def _check_batches(**axes: tuple[int, ...]) -> None:
    try:
        np.broadcast_shapes(*axes.values())
    except ValueError:
        got = ", ".join(f"{name} {shape}" for name, shape in axes.items())
        raise ShapeError(f"Expected leading axes that broadcast, got {got}.") from None


def _matrix(pi: np.ndarray) -> np.ndarray:
    inertia = np.empty((*pi.shape[:-1], 3, 3))
    inertia[..., _ROWS, _COLUMNS] = inertia[..., _COLUMNS, _ROWS] = pi[..., 4:]
    return inertia


def _squares(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """``x·y 1`` less the symmetric part of ``x yᵀ``: the moments of masses at x whose first moments are y."""
    product = x[..., :, None] * y[..., None, :]
    return (x * y).sum(axis=-1)[..., None, None] * np.eye(3) - (product + np.swapaxes(product, -1, -2)) / 2


def _assemble(mass: np.ndarray, first: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Return (..., 10) from mass, first moments and inertia about the origin."""
    pi = np.empty((*np.broadcast_shapes(mass.shape, first.shape[:-1], about.shape[:-2]), 10))
    pi[..., 0] = mass
    pi[..., 1:4] = first
    pi[..., 4:] = about[..., _ROWS, _COLUMNS]
    return pi
