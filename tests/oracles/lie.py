"""Rotations, rigid motions and quaternions: matrix exponentials and their integrals, by SciPy and by quadrature.

Every function takes any leading axes and keeps them; NaN gives NaN. The axes of three angles come by number, in the
order of the product: ``R = R_first(r) R_middle(p) R_last(y)``; neighbours differ.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)  # from -1 to 1; to rounding for turns up to pi


def _arrays(*values: Any) -> list[np.ndarray]:
    return [np.asarray(value, dtype=float) for value in values]


def _unit(q: Any) -> np.ndarray:
    return np.asarray(q, dtype=float) / np.linalg.norm(q, axis=-1, keepdims=True)


def _hat(w: np.ndarray) -> np.ndarray:
    return np.cross(w[..., None, :], np.eye(3)).swapaxes(-1, -2)


def _apply(M: np.ndarray, v: np.ndarray) -> np.ndarray:
    return (M @ v[..., None])[..., 0]


def _transposed(M: np.ndarray) -> np.ndarray:
    return np.swapaxes(M, -1, -2)


def _pose(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1.0
    return T


def _mean(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """The integral of ``f(s x)`` over s from 0 to 1, by Gauss and Legendre."""
    return np.tensordot(0.5 * WEIGHTS, f(np.multiply.outer(0.5 * (NODES + 1.0), x)), 1)


def so3_exp(w: Any) -> np.ndarray:
    w = np.asarray(w, dtype=float)
    return Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape, 3)


def so3_log(R: Any) -> np.ndarray:
    """``2 atan2(|v|, w) v/|v|`` of the quaternion (w, v)."""
    q = quaternion_from_matrix(R)
    length = np.linalg.norm(q[..., 1:], axis=-1)
    ratio = np.where(length == 0.0, 2.0, 2 * np.arctan2(length, q[..., 0]) / np.where(length == 0.0, 1.0, length))
    return q[..., 1:] * ratio[..., None]


def so3_angle(R_a: Any, R_b: Any) -> np.ndarray:
    R_a, R_b = _arrays(R_a, R_b)
    return np.asarray(np.linalg.norm(so3_log(_transposed(R_a) @ R_b), axis=-1))


def so3_interpolate(R_a: Any, R_b: Any, s: Any) -> np.ndarray:
    """``R_a exp(s log(R_aᵀ R_b))``."""
    R_a, R_b, s = _arrays(R_a, R_b, s)
    return R_a @ so3_exp(s[..., None] * so3_log(_transposed(R_a) @ R_b))


def so3_left_jacobian(w: Any) -> np.ndarray:
    """The integral of ``exp(s w)`` over s from 0 to 1."""
    return _mean(so3_exp, np.asarray(w, dtype=float))


def so3_left_jacobian_inv(w: Any) -> np.ndarray:
    return np.linalg.inv(so3_left_jacobian(w))


def se3_exp(xi: Any) -> np.ndarray:
    """``[[exp(w), J v], [0, 1]]`` with J the left Jacobian of w."""
    v, w = np.split(np.asarray(xi, dtype=float), 2, axis=-1)
    return _pose(so3_exp(w), _apply(so3_left_jacobian(w), v))


def se3_log(T: Any) -> np.ndarray:
    T = np.asarray(T, dtype=float)
    w = so3_log(T[..., :3, :3])
    return np.concatenate([_apply(so3_left_jacobian_inv(w), T[..., :3, 3]), w], axis=-1)


def se3_inv(T: Any) -> np.ndarray:
    T = np.asarray(T, dtype=float)
    Rt = _transposed(T[..., :3, :3])
    return _pose(Rt, -_apply(Rt, T[..., :3, 3]))


def se3_adjoint(T_a_b: Any) -> np.ndarray:
    """``[[R, hat(p) R], [0, R]]``."""
    T = np.asarray(T_a_b, dtype=float)
    R, A = T[..., :3, :3], np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = _hat(T[..., :3, 3]) @ R
    return A


def se3_transform_wrench(T_a_b: Any, wrench_b: Any) -> np.ndarray:
    """``f_a = R f_b``, ``m_a = R m_b + p × f_a``."""
    T, wrench = _arrays(T_a_b, wrench_b)
    f, m = (_apply(T[..., :3, :3], part) for part in np.split(wrench, 2, axis=-1))
    return np.concatenate([f, m + np.cross(T[..., :3, 3], f)], axis=-1)


def se3_interpolate(T_a: Any, T_b: Any, s: Any, screw: bool = False) -> np.ndarray:
    """``T_a exp(s log(T_a⁻¹ T_b))`` when `screw`, otherwise the position along a line and the rotation by itself."""
    T_a, T_b, s = _arrays(T_a, T_b, s)
    if screw:
        return T_a @ se3_exp(s[..., None] * se3_log(se3_inv(T_a) @ T_b))
    p = T_a[..., :3, 3] + s[..., None] * (T_b[..., :3, 3] - T_a[..., :3, 3])
    return _pose(so3_interpolate(T_a[..., :3, :3], T_b[..., :3, :3], s), p)


def se3_left_jacobian(xi: Any) -> np.ndarray:
    """The integral of the adjoints of ``exp(s xi)`` over s from 0 to 1."""
    return _mean(lambda x: se3_adjoint(se3_exp(x)), np.asarray(xi, dtype=float))


def se3_left_jacobian_inv(xi: Any) -> np.ndarray:
    return np.linalg.inv(se3_left_jacobian(xi))


def quaternion_from_matrix(R: Any) -> np.ndarray:
    """Divide the row of 4 q qᵀ with the largest diagonal by its length (Shepperd 1978)."""
    R = np.asarray(R, dtype=float)
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
    q = _unit(np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :])
    first = np.argmax(q != 0, axis=-1)
    return np.where(np.take_along_axis(q, first[..., None], axis=-1) < 0, -q, q)


def quaternion_to_matrix(quaternion: Any) -> np.ndarray:
    """``I + 2 w hat(v) + 2 hat(v)²`` of the unit quaternion (w, v)."""
    q = _unit(quaternion)
    V = _hat(q[..., 1:])
    return np.eye(3) + 2.0 * q[..., :1, None] * V + 2.0 * V @ V


def quaternion_multiply(p: Any, q: Any) -> np.ndarray:
    """``(p_w q_w - p_v · q_v, p_w q_v + q_w p_v + p_v × q_v)``."""
    (pw, pv), (qw, qv) = ((x[..., :1], x[..., 1:]) for x in _arrays(p, q))
    w = pw * qw - (pv * qv).sum(axis=-1, keepdims=True)
    return np.concatenate([w, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def quaternion_slerp(a: Any, b: Any, s: Any) -> np.ndarray:
    """``(a sin((1-s)Ω) ± b sin(sΩ)) / sin Ω``, Ω at most a quarter turn of the unit sphere."""
    one, other, share = _unit(a), _unit(b), np.asarray(s, dtype=float)[..., None]
    other = np.where((one * other).sum(axis=-1, keepdims=True) < 0, -other, other)
    chord = [np.linalg.norm(v, axis=-1, keepdims=True) for v in (other - one, other + one)]
    omega = 2 * np.arctan2(*chord) / np.pi  # in half turns of the unit sphere, as np.sinc wants it
    return _unit((1 - share) * np.sinc((1 - share) * omega) * one + share * np.sinc(share * omega) * other)


LOCK = 1e-13  # below, the first and the last axis are parallel to the last digit


def euler_from_rpy(rpy: Any, first: int, middle: int, last: int) -> np.ndarray:
    rpy = np.asarray(rpy, dtype=float)
    a, b, c = (so3_exp(rpy[..., k, None] * np.eye(3)[axis]) for k, axis in enumerate((first, middle, last)))
    return a @ b @ c


def euler_to_rpy(R: Any, first: int, middle: int, last: int) -> np.ndarray:
    """The angles, by what the first two turns make of the last axis; then the first is undone to see the last alone."""
    R = np.asarray(R, dtype=float)
    i, j, k = first, middle, 3 - first - middle
    e = 1.0 if (j - i) % 3 == 1 else -1.0  # e_i × e_j = e e_k
    proper = last == i
    sine, cosine = (R[..., j, i], -e * R[..., k, i]) if proper else (-e * R[..., j, k], R[..., k, k])
    length = np.hypot(sine, cosine)
    r = np.where(length < LOCK, 0.0, _angle(sine, cosine))
    p = _angle(length, R[..., i, i]) if proper else _angle(e * R[..., i, k], length)
    row = np.cos(r)[..., None] * R[..., j, :] + e * np.sin(r)[..., None] * R[..., k, :]  # lock does not touch it
    y = _angle(-e * row[..., k] if proper else e * row[..., i], row[..., j])
    return np.stack([r, p, y], axis=-1)


def _angle(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """atan2, whatever the signs of zeros: a half turn is +π, and (0, 0) has the angle 0."""
    return np.arctan2(y + 0.0, x + 0.0)
