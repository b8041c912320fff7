"""Unit quaternions wxyz as arrays (..., 4).

q and -q represent the same rotation. All functions accept any leading axes and preserve them. NaN inputs give NaN
results.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab.errors import ShapeError
from armlab.lie import arguments

__all__ = ["conjugate", "continuous", "from_matrix", "multiply", "slerp", "to_matrix"]

UNIT_TOLERANCE = 1e-3
"""Largest norm error that normalisation removes; accepts quaternions rounded to three decimals."""


def from_matrix(R: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the unit quaternion (..., 4) of a rotation, with w ≥ 0.

    At a half turn, the first non-zero component is positive.

    Parameters
    ----------
    R : (..., 3, 3) rotation.
    out : (..., 4) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : R is not a rotation within `so3.ROTATION_TOLERANCE`.

    The algorithm divides by the largest component.

    Reference: S. W. Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1(3), 1978.
    """
    return kernels.quaternion_from_matrix(R, out)


def to_matrix(quaternion: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation (..., 3, 3) of a quaternion.

    Parameters
    ----------
    quaternion : (..., 4) wxyz, of norm 1 within `UNIT_TOLERANCE`; it is normalised.
    out : (..., 3, 3) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : the norm of a quaternion is not 1.
    """
    return kernels.quaternion_to_matrix(quaternion, out)


def multiply(p: ArrayLike, q: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the product (..., 4): ``to_matrix(multiply(p, q)) = to_matrix(p) to_matrix(q)``.

    Parameters
    ----------
    p, q : (..., 4) wxyz; leading axes broadcast.
    out : (..., 4) array for the result; default: newly allocated.
    """
    return kernels.quaternion_multiply(p, q, out)


def conjugate(quaternion: ArrayLike) -> np.ndarray:
    """Return (w, -x, -y, -z), the inverse (..., 4) of a unit quaternion.

    Parameters
    ----------
    quaternion : (..., 4) wxyz.
    """
    return arguments.array(quaternion, (4,), "quaternion") * (1.0, -1.0, -1.0, -1.0)


def slerp(a: ArrayLike, b: ArrayLike, s: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Interpolate from a to b along the shorter arc at constant speed: ``(a sin((1-s)Ω) ± b sin(sΩ)) / sin Ω``.

    The results are unit quaternions (..., 4) in the hemisphere of a.

    Parameters
    ----------
    a, b : (..., 4) wxyz, unit; leading axes broadcast with those of s.
    s : (...) path parameter, 0 at a and 1 at b; other values extrapolate.
    out : (..., 4) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : the norm of a quaternion is not 1.

    Reference: K. Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    return kernels.quaternion_slerp(a, b, s, out)


def continuous(quaternion: ArrayLike) -> np.ndarray:
    """Choose signs along axis 0 so that consecutive quaternions are in the same hemisphere: ``q[k] · q[k-1] ≥ 0``.

    The result has the shape of the input. The first quaternion keeps its sign. Missing samples (NaN) remain missing,
    and the next sample is compared with the last valid sample.

    Parameters
    ----------
    quaternion : (N, ..., 4) wxyz; axis 0 is time.

    Raises
    ------
    ShapeError : the time axis is missing.
    """
    q = arguments.array(quaternion, (4,), "quaternion")
    if q.ndim < 2:
        raise ShapeError(f"Expected quaternions of shape (N, ..., 4) with time along axis 0, got {q.shape}.")
    present = ~np.isnan(q).any(axis=-1, keepdims=True)
    time = np.arange(len(q)).reshape(-1, *[1] * (q.ndim - 1))
    latest = np.maximum.accumulate(np.where(present, time, 0), axis=0)
    previous = np.take_along_axis(q, latest[:-1], axis=0)
    turned = (q[1:] * previous).sum(axis=-1, keepdims=True) < 0
    result = q.copy()
    result[1:] *= np.cumprod(np.where(turned, -1.0, 1.0), axis=0)
    return result
