"""Unit quaternions wxyz as arrays (..., 4).

q and -q are one rotation. Every function takes any leading axes and keeps them. NaN gives NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError
from armlab.lie import _check

__all__ = ["UNIT_TOLERANCE", "conjugate", "continuous", "from_matrix", "multiply", "slerp", "to_matrix"]

UNIT_TOLERANCE = 1e-3
"""Largest error of a quaternion's length that is normalised away; data with three decimals pass."""


def from_matrix(R: ArrayLike) -> np.ndarray:
    """Return the quaternion of a rotation with w ≥ 0; at a half turn the first component that is not zero is positive.

    Parameters
    ----------
    R : (..., 3, 3).

    Returns
    -------
    (..., 4) wxyz, unit.

    Raises
    ------
    ShapeError : when R is not a rotation within `so3.ROTATION_TOLERANCE`.

    Reference: S. W. Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1(3), 1978: divide by the
    largest component, never by a small one.
    """
    R = _check.rotation(R)
    x, y, z = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 1, 0] + R[..., 0, 1], R[..., 2, 0] + R[..., 0, 2], R[..., 2, 1] + R[..., 1, 2]
    rows = (  # 4 q qᵀ
        (1 + x + y + z, wx, wy, wz),
        (wx, 1 + x - y - z, xy, xz),
        (wy, xy, 1 - x + y - z, yz),
        (wz, xz, yz, 1 - x - y + z),
    )
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    first = np.argmax(q != 0, axis=-1)
    return np.where(np.take_along_axis(q, first[..., None], axis=-1) < 0, -q, q)


def to_matrix(quaternion: ArrayLike) -> np.ndarray:
    """Return the rotation of a quaternion.

    Parameters
    ----------
    quaternion : (..., 4) wxyz, unit to `UNIT_TOLERANCE`; it is normalised.

    Returns
    -------
    (..., 3, 3).

    Raises
    ------
    ShapeError : when its length is not 1.
    """
    w, x, y, z = np.moveaxis(_unit(quaternion, "quaternion"), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def multiply(p: ArrayLike, q: ArrayLike) -> np.ndarray:
    """Return the product: ``to_matrix(multiply(p, q)) = to_matrix(p) to_matrix(q)``.

    Parameters
    ----------
    p, q : (..., 4) wxyz, leading axes broadcast.

    Returns
    -------
    (..., 4).
    """
    pw, px, py, pz = np.moveaxis(_check.array(p, (4,), "p"), -1, 0)
    qw, qx, qy, qz = np.moveaxis(_check.array(q, (4,), "q"), -1, 0)
    product = (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )
    return np.stack(product, axis=-1)


def conjugate(quaternion: ArrayLike) -> np.ndarray:
    """Return (w, -x, -y, -z), the inverse of a unit quaternion.

    Parameters
    ----------
    quaternion : (..., 4) wxyz.

    Returns
    -------
    (..., 4).
    """
    return _check.array(quaternion, (4,), "quaternion") * (1.0, -1.0, -1.0, -1.0)


def slerp(a: ArrayLike, b: ArrayLike, s: ArrayLike) -> np.ndarray:
    """Turn from a to b along the shorter arc at constant speed: ``(a sin((1-s)Ω) ± b sin(sΩ)) / sin Ω``.

    Parameters
    ----------
    a, b : (..., 4) wxyz, unit; leading axes broadcast with those of s.
    s : (...) 0 at a, 1 at b.

    Returns
    -------
    (..., 4) unit, on the side of a.

    Raises
    ------
    ShapeError : when a length is not 1.

    Reference: K. Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    a, b = _unit(a, "a"), _unit(b, "b")
    s = np.asarray(s, dtype=np.float64)[..., None]
    b = np.where((a * b).sum(axis=-1, keepdims=True) < 0, -b, b)
    chord = [np.linalg.norm(v, axis=-1, keepdims=True) for v in (b - a, b + a)]
    omega = 2 * np.arctan2(*chord) / np.pi  # in half turns of the unit sphere, as np.sinc wants it
    q = ((1 - s) * np.sinc((1 - s) * omega) * a + s * np.sinc(s * omega) * b) / np.sinc(omega)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def continuous(quaternion: ArrayLike) -> np.ndarray:
    """Choose the signs along axis 0 so that neighbours are on one side: ``q[k] · q[k-1] ≥ 0``.

    The first keeps its sign. Missing samples (NaN) stay missing and the next one follows the last that was there.

    Parameters
    ----------
    quaternion : (N, ..., 4) wxyz, axis 0 is time.

    Returns
    -------
    (N, ..., 4).

    Raises
    ------
    ShapeError : when there is no time axis.
    """
    q = _check.array(quaternion, (4,), "quaternion")
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


def _unit(quaternion: ArrayLike, name: str) -> np.ndarray:
    q = _check.array(quaternion, (4,), name)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if (np.abs(length - 1) > UNIT_TOLERANCE).any():
        worst = length.flat[np.nanargmax(np.abs(length - 1))]
        raise ShapeError(f"Expected {name} of length 1 within {UNIT_TOLERANCE:g} (wxyz), got length {worst:.6g}.")
    return q / length
