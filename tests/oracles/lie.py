"""Rotations, rigid motions and quaternions, in NumPy.

Every function takes any leading axes and keeps them; NaN gives NaN.
The axes of three angles come by number, in the order of the product:
``R = R_first(r) R_middle(p) R_last(y)``; neighbours differ.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

SERIES_BELOW = 0.5  # rad: above, the closed forms keep all digits; below, eight terms reach 1e-18
BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798)
# Powers of x^2 of (1 - cos x) / x^2, (x - sin x) / x^3 and (1 - x/2 cot(x/2)) / x^2.
VERSINE = tuple((-1) ** k / math.factorial(2 * k + 2) for k in range(9))
CUBIC = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(9))
COTANGENT = tuple(b / math.factorial(2 * k) for k, b in enumerate(BERNOULLI, start=1))

_Coefficients = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _broadcast(**arguments: tuple[np.ndarray, int]) -> list[np.ndarray]:
    """Return arrays with the same leading axes; each comes with the number of its own last axes."""
    batch = np.broadcast_shapes(*(array.shape[: array.ndim - tail] for array, tail in arguments.values()))
    return [np.broadcast_to(array, batch + array.shape[array.ndim - tail :]) for array, tail in arguments.values()]


def _unit(q: Any) -> np.ndarray:
    return np.asarray(q, dtype=float) / np.linalg.norm(q, axis=-1, keepdims=True)


def so3_exp(w: Any) -> np.ndarray:
    """``I + sin θ/θ hat(w) + 2 sin²(θ/2)/θ² hat(w)²``."""
    w = np.asarray(w, dtype=float)
    theta = _norm(w)
    return _polynomial(w, _sinc(theta), _sinc(theta / 2) ** 2 / 2)


def so3_log(R: Any) -> np.ndarray:
    """``2 atan2(abs(v), w) v/abs(v)`` of the quaternion (w, v)."""
    q = quaternion_from_matrix(R)
    length = _norm(q[..., 1:])
    theta = 2 * np.arctan2(length, q[..., 0])
    return q[..., 1:] * _ratio(theta, length, 2.0)[..., None]


def so3_angle(R_a: Any, R_b: Any) -> np.ndarray:
    """``2 atan2(abs(v), w)`` of the quaternion of ``R_aᵀ R_b``."""
    R_a, R_b = np.asarray(R_a, dtype=float), np.asarray(R_b, dtype=float)
    R_a, R_b = _broadcast(R_a=(R_a, 2), R_b=(R_b, 2))
    q = _from_matrix(np.swapaxes(np.asarray(R_a, dtype=float), -1, -2) @ np.asarray(R_b, dtype=float))
    return np.asarray(2 * np.arctan2(_norm(q[..., 1:]), q[..., 0]))


def so3_interpolate(R_a: Any, R_b: Any, s: Any) -> np.ndarray:
    """``R_a exp(s log(R_aᵀ R_b))``, from the nearer end, which is exact that way."""
    R_a, R_b, s = np.asarray(R_a, dtype=float), np.asarray(R_b, dtype=float), np.asarray(s, dtype=float)
    R_a, R_b, s = _broadcast(R_a=(R_a, 2), R_b=(R_b, 2), s=(s, 0))
    w = so3_log(np.swapaxes(np.asarray(R_a, dtype=float), -1, -2) @ np.asarray(R_b, dtype=float))
    nearer, rest = _nearer(R_a, R_b, s)
    return nearer @ so3_exp(rest * w)


def so3_left_jacobian(w: Any) -> np.ndarray:
    """``I + (1 - cos θ)/θ² hat(w) + (θ - sin θ)/θ³ hat(w)²``."""
    w = np.asarray(w, dtype=float)
    a, b, _, _ = _left_jacobian(_norm(w))
    return _polynomial(w, a, b)


def so3_left_jacobian_inv(w: Any) -> np.ndarray:
    """``I - hat(w)/2 + (1 - θ/2 cot(θ/2))/θ² hat(w)²``."""
    w = np.asarray(w, dtype=float)
    a, b, _, _ = _left_jacobian_inv(_norm(w))
    return _polynomial(w, a, b)


def se3_exp(xi: Any) -> np.ndarray:
    """``[[exp(w), V v], [0, 1]]`` with V the left Jacobian of w."""
    xi = np.asarray(xi, dtype=float)
    v, w = xi[..., :3], xi[..., 3:]
    return _pose(so3_exp(w), _apply(so3_left_jacobian(w), v))


def se3_log(T: Any) -> np.ndarray:
    """``[V⁻¹ p; w]`` with V the left Jacobian of w."""
    T = np.asarray(T, dtype=float)
    w = so3_log(T[..., :3, :3])
    v = _apply(so3_left_jacobian_inv(w), T[..., :3, 3])
    return np.concatenate([v, w], axis=-1)


def se3_inv(T: Any) -> np.ndarray:
    """``[[Rᵀ, -Rᵀ p], [0, 1]]``."""
    T = np.asarray(T, dtype=float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return _pose(Rt, -_apply(Rt, T[..., :3, 3]))


def se3_adjoint(T_a_b: Any) -> np.ndarray:
    """``[[R, hat(p) R], [0, R]]``."""
    T = np.asarray(T_a_b, dtype=float)
    R = T[..., :3, :3]
    return _blocks(R, _hat(T[..., :3, 3]) @ R)


def se3_transform_wrench(T_a_b: Any, wrench_b: Any) -> np.ndarray:
    """``f_a = R f_b``, ``m_a = R m_b + p × f_a``."""
    T, wrench = np.asarray(T_a_b, dtype=float), np.asarray(wrench_b, dtype=float)
    T, wrench = _broadcast(T_a_b=(T, 2), wrench_b=(wrench, 1))
    R, p = np.asarray(T, dtype=float)[..., :3, :3], T[..., :3, 3]
    f = _apply(R, wrench[..., :3])
    return np.concatenate([f, _apply(R, wrench[..., 3:]) + np.cross(p, f)], axis=-1)


def se3_interpolate(T_a: Any, T_b: Any, s: Any, screw: bool = False) -> np.ndarray:
    """``T_a exp(s log(T_a⁻¹ T_b))`` when `screw`, otherwise the position along a line and the rotation as above."""
    T_a, T_b, s = np.asarray(T_a, dtype=float), np.asarray(T_b, dtype=float), np.asarray(s, dtype=float)
    T_a, T_b, s = _broadcast(T_a=(T_a, 2), T_b=(T_b, 2), s=(s, 0))
    np.asarray(T_a, dtype=float)
    np.asarray(T_b, dtype=float)
    nearer, rest = _nearer(T_a, T_b, s)
    if screw:
        return nearer @ se3_exp(rest * se3_log(se3_inv(T_a) @ T_b))
    p = nearer[..., :3, 3] + rest * (T_b[..., :3, 3] - T_a[..., :3, 3])
    return _pose(so3_interpolate(T_a[..., :3, :3], T_b[..., :3, :3], s), p)


def se3_left_jacobian(xi: Any) -> np.ndarray:
    """``[[J, Q], [0, J]]``: J of w, and Q its derivative in the direction v."""
    xi = np.asarray(xi, dtype=float)
    v, w = xi[..., :3], xi[..., 3:]
    return _with_derivative(w, v, _left_jacobian(_norm(w)))


def se3_left_jacobian_inv(xi: Any) -> np.ndarray:
    """The same of the inverse of J."""
    xi = np.asarray(xi, dtype=float)
    v, w = xi[..., :3], xi[..., 3:]
    return _with_derivative(w, v, _left_jacobian_inv(_norm(w)))


def quaternion_from_matrix(R: Any) -> np.ndarray:
    """Divide the row of 4 q qᵀ with the largest diagonal by its length (Shepperd 1978)."""
    return _from_matrix(np.asarray(R, dtype=float))


def quaternion_to_matrix(quaternion: Any) -> np.ndarray:
    """``I + 2 w hat(v) + 2 hat(v)²`` of the unit quaternion (w, v)."""
    q = _unit(quaternion)
    return _polynomial(q[..., 1:], 2 * q[..., 0], np.full(q.shape[:-1], 2.0))


def quaternion_multiply(p: Any, q: Any) -> np.ndarray:
    """``(p_w q_w - p_v · q_v, p_w q_v + q_w p_v + p_v × q_v)``."""
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    p, q = _broadcast(p=(p, 1), q=(q, 1))
    (pw, pv), (qw, qv) = ((x[..., :1], x[..., 1:]) for x in (p, q))
    w = pw * qw - (pv * qv).sum(axis=-1, keepdims=True)
    return np.concatenate([w, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def quaternion_slerp(a: Any, b: Any, s: Any) -> np.ndarray:
    """``(a sin((1-s)Ω) ± b sin(sΩ)) / sin Ω``, Ω at most a quarter turn of the unit sphere."""
    a, b, s = np.asarray(a, dtype=float), np.asarray(b, dtype=float), np.asarray(s, dtype=float)
    a, b, s = _broadcast(a=(a, 1), b=(b, 1), s=(s, 0))
    one, other, share = _unit(a), _unit(b), s[..., None]
    other = np.where((one * other).sum(axis=-1, keepdims=True) < 0, -other, other)
    chord = [np.linalg.norm(v, axis=-1, keepdims=True) for v in (other - one, other + one)]
    omega = 2 * np.arctan2(*chord) / np.pi  # in half turns of the unit sphere, as np.sinc wants it
    q = (1 - share) * np.sinc((1 - share) * omega) * one + share * np.sinc(share * omega) * other
    q = q / np.sinc(omega)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def _from_matrix(R: np.ndarray) -> np.ndarray:
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


def _nearer(a: np.ndarray, b: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The end that is nearer, and (..., 1) how far it is to go from there."""
    late = s > 0.5
    return np.where(late[..., None, None], b, a), np.where(late, s - 1, s)[..., None]


def _left_jacobian(theta: np.ndarray) -> _Coefficients:
    """a, b of ``I + a hat(w) + b hat(w)²``, and their derivatives over θ."""
    small = theta < SERIES_BELOW
    x = np.where(small, 1.0, theta)
    versine = 2 * np.sin(x / 2) ** 2
    b = np.where(small, _series(CUBIC, theta), (x - np.sin(x)) / x**3)
    a1 = np.where(small, _derivative(VERSINE, theta), (x * np.sin(x) - 2 * versine) / x**4)
    b1 = np.where(small, _derivative(CUBIC, theta), (3 * (np.sin(x) - x) + x * versine) / x**5)
    return _sinc(theta / 2) ** 2 / 2, b, a1, b1


def _left_jacobian_inv(theta: np.ndarray) -> _Coefficients:
    """The same of the inverse."""
    small = theta < SERIES_BELOW
    x = np.where(small, 1.0, theta)
    h_cot_h = x / 2 * np.cos(x / 2) / np.sin(x / 2)
    b = np.where(small, _series(COTANGENT, theta), (1 - h_cot_h) / x**2)
    b1 = np.where(small, _derivative(COTANGENT, theta), ((x / 2 / np.sin(x / 2)) ** 2 + h_cot_h - 2) / x**4)
    return np.full_like(theta, -0.5), b, np.zeros_like(theta), b1


def _with_derivative(w: np.ndarray, v: np.ndarray, coefficients: _Coefficients) -> np.ndarray:
    """f([[hat(w), hat(v)], [0, hat(w)]]) of the f with ``f(hat(w)) = I + a hat(w) + b hat(w)²``."""
    a, b, a1, b1 = (c[..., None, None] for c in coefficients)
    W, V, along = _hat(w), _hat(v), (w * v).sum(axis=-1)[..., None, None]
    Q = a * V + b * (W @ V + V @ W) + along * (a1 * W + b1 * (W @ W))
    return _blocks(_polynomial(w, *coefficients[:2]), Q)


def _polynomial(w: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``I + a hat(w) + b hat(w)²``."""
    W = _hat(w)
    return np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W)


def _hat(w: np.ndarray) -> np.ndarray:
    W = np.zeros((*w.shape, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = x, y, z = np.moveaxis(w, -1, 0)
    W[..., 1, 2], W[..., 2, 0], W[..., 0, 1] = -x, -y, -z
    return W


def _pose(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1.0
    return T


def _blocks(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    M = np.zeros((*A.shape[:-2], 6, 6))
    M[..., :3, :3] = M[..., 3:, 3:] = A
    M[..., :3, 3:] = B
    return M


def _apply(M: np.ndarray, v: np.ndarray) -> np.ndarray:
    return (M @ v[..., None])[..., 0]


def _norm(v: np.ndarray) -> np.ndarray:
    """Length that neither underflows at 1e-300 nor overflows."""
    return np.hypot(np.hypot(v[..., 0], v[..., 1]), v[..., 2])


def _ratio(x: np.ndarray, y: np.ndarray, at_zero: float) -> np.ndarray:
    """x / y, and its limit where y is 0."""
    zero = y == 0
    return np.where(zero, at_zero, x / np.where(zero, 1.0, y))


def _sinc(x: np.ndarray) -> np.ndarray:
    """sin(x) / x."""
    return _ratio(np.sin(x), x, 1.0)


def _series(coefficients: tuple[float, ...], theta: np.ndarray) -> np.ndarray:
    """Power series in θ², used below `SERIES_BELOW`: eight terms."""
    x = np.minimum(theta, SERIES_BELOW) ** 2
    total = np.zeros_like(x)
    for coefficient in reversed(coefficients[:8]):
        total = total * x + coefficient
    return total


def _derivative(coefficients: tuple[float, ...], theta: np.ndarray) -> np.ndarray:
    """Derivative of that series over θ, divided by θ."""
    return _series(tuple(2 * k * c for k, c in enumerate(coefficients) if k), theta)


LOCK = 1e-13  # below, the first and the last axis are parallel to the last digit


def euler_from_rpy(rpy: Any, first: int, middle: int, last: int) -> np.ndarray:
    """The product of the three turns."""
    rpy = np.asarray(rpy, dtype=float)
    a, b, c = (_turn(rpy[..., k], axis) for k, axis in enumerate((first, middle, last)))
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


def _turn(angle: np.ndarray, axis: int) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    R = np.zeros((*angle.shape, 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R[..., axis, axis] = 1.0
    R[..., j, j], R[..., k, k], R[..., j, k], R[..., k, j] = c, c, -s, s
    return R
