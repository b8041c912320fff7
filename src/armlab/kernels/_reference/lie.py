"""Rotations, rigid motions and quaternions, in NumPy.

Every function takes any leading axes and keeps them, accepts read-only input, leaves it unchanged, and writes into
`out` when that is given. NaN gives NaN. Argument errors are `ShapeError`. `armlab.lie` documents them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from armlab.kernels._reference.arrays import elements, result
from armlab.kernels._reference.lie_arguments import broadcast, poses, rotations, unit

__all__ = [
    "quaternion_from_matrix",
    "quaternion_multiply",
    "quaternion_slerp",
    "quaternion_to_matrix",
    "se3_adjoint",
    "se3_exp",
    "se3_interpolate",
    "se3_inv",
    "se3_left_jacobian",
    "se3_left_jacobian_inv",
    "se3_log",
    "se3_transform_wrench",
    "so3_angle",
    "so3_exp",
    "so3_interpolate",
    "so3_left_jacobian",
    "so3_left_jacobian_inv",
    "so3_log",
]

SERIES_BELOW = 0.5  # rad: above, the closed forms keep all digits; below, eight terms reach 1e-18
BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798)
# Powers of x^2 of (1 - cos x) / x^2, (x - sin x) / x^3 and (1 - x/2 cot(x/2)) / x^2.
VERSINE = tuple((-1) ** k / math.factorial(2 * k + 2) for k in range(9))
CUBIC = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(9))
COTANGENT = tuple(b / math.factorial(2 * k) for k, b in enumerate(BERNOULLI, start=1))

_Coefficients = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def so3_exp(w: Any, out: Any = None) -> np.ndarray:
    """``I + sin θ/θ hat(w) + 2 sin²(θ/2)/θ² hat(w)²``."""
    w = elements(w, "w", (3,))
    theta = _norm(w)
    return result(_polynomial(w, _sinc(theta), _sinc(theta / 2) ** 2 / 2), out, w=w)


def so3_log(R: Any, out: Any = None) -> np.ndarray:
    """``2 atan2(abs(v), w) v/abs(v)`` of the quaternion (w, v)."""
    q = quaternion_from_matrix(R)
    length = _norm(q[..., 1:])
    theta = 2 * np.arctan2(length, q[..., 0])
    return result(q[..., 1:] * _ratio(theta, length, 2.0)[..., None], out, R=R)


def so3_angle(R_a: Any, R_b: Any, out: Any = None) -> np.ndarray:
    """``2 atan2(abs(v), w)`` of the quaternion of ``R_aᵀ R_b``."""
    R_a, R_b = elements(R_a, "R_a", (3, 3)), elements(R_b, "R_b", (3, 3))
    R_a, R_b = broadcast(R_a=(R_a, 2), R_b=(R_b, 2))
    q = _from_matrix(np.swapaxes(rotations(R_a, "R_a"), -1, -2) @ rotations(R_b, "R_b"))
    return result(np.asarray(2 * np.arctan2(_norm(q[..., 1:]), q[..., 0])), out, R_a=R_a, R_b=R_b)


def so3_interpolate(R_a: Any, R_b: Any, s: Any, out: Any = None) -> np.ndarray:
    """``R_a exp(s log(R_aᵀ R_b))``, from the nearer end, which is exact that way."""
    R_a, R_b, s = elements(R_a, "R_a", (3, 3)), elements(R_b, "R_b", (3, 3)), elements(s, "s", ())
    R_a, R_b, s = broadcast(R_a=(R_a, 2), R_b=(R_b, 2), s=(s, 0))
    w = so3_log(np.swapaxes(rotations(R_a, "R_a"), -1, -2) @ rotations(R_b, "R_b"))
    nearer, rest = _nearer(R_a, R_b, s)
    return result(nearer @ so3_exp(rest * w), out, R_a=R_a, R_b=R_b, s=s)


def so3_left_jacobian(w: Any, out: Any = None) -> np.ndarray:
    """``I + (1 - cos θ)/θ² hat(w) + (θ - sin θ)/θ³ hat(w)²``."""
    w = elements(w, "w", (3,))
    a, b, _, _ = _left_jacobian(_norm(w))
    return result(_polynomial(w, a, b), out, w=w)


def so3_left_jacobian_inv(w: Any, out: Any = None) -> np.ndarray:
    """``I - hat(w)/2 + (1 - θ/2 cot(θ/2))/θ² hat(w)²``."""
    w = elements(w, "w", (3,))
    a, b, _, _ = _left_jacobian_inv(_norm(w))
    return result(_polynomial(w, a, b), out, w=w)


def se3_exp(xi: Any, out: Any = None) -> np.ndarray:
    """``[[exp(w), V v], [0, 1]]`` with V the left Jacobian of w."""
    xi = elements(xi, "xi", (6,))
    v, w = xi[..., :3], xi[..., 3:]
    return result(_pose(so3_exp(w), _apply(so3_left_jacobian(w), v)), out, xi=xi)


def se3_log(T: Any, out: Any = None) -> np.ndarray:
    """``[V⁻¹ p; w]`` with V the left Jacobian of w."""
    T = poses(T, "T")
    w = so3_log(T[..., :3, :3])
    v = _apply(so3_left_jacobian_inv(w), T[..., :3, 3])
    return result(np.concatenate([v, w], axis=-1), out, T=T)


def se3_inv(T: Any, out: Any = None) -> np.ndarray:
    """``[[Rᵀ, -Rᵀ p], [0, 1]]``."""
    T = poses(T, "T")
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return result(_pose(Rt, -_apply(Rt, T[..., :3, 3])), out, T=T)


def se3_adjoint(T_a_b: Any, out: Any = None) -> np.ndarray:
    """``[[R, hat(p) R], [0, R]]``."""
    T = poses(T_a_b, "T_a_b")
    R = T[..., :3, :3]
    return result(_blocks(R, _hat(T[..., :3, 3]) @ R), out, T_a_b=T_a_b)


def se3_transform_wrench(T_a_b: Any, wrench_b: Any, out: Any = None) -> np.ndarray:
    """``f_a = R f_b``, ``m_a = R m_b + p × f_a``."""
    T, wrench = elements(T_a_b, "T_a_b", (4, 4)), elements(wrench_b, "wrench_b", (6,))
    T, wrench = broadcast(T_a_b=(T, 2), wrench_b=(wrench, 1))
    R, p = poses(T, "T_a_b")[..., :3, :3], T[..., :3, 3]
    f = _apply(R, wrench[..., :3])
    wrench_a = np.concatenate([f, _apply(R, wrench[..., 3:]) + np.cross(p, f)], axis=-1)
    return result(wrench_a, out, T_a_b=T, wrench_b=wrench)


def se3_interpolate(T_a: Any, T_b: Any, s: Any, screw: bool = False, out: Any = None) -> np.ndarray:
    """``T_a exp(s log(T_a⁻¹ T_b))`` when `screw`, otherwise the position along a line and the rotation as above."""
    T_a, T_b, s = elements(T_a, "T_a", (4, 4)), elements(T_b, "T_b", (4, 4)), elements(s, "s", ())
    T_a, T_b, s = broadcast(T_a=(T_a, 2), T_b=(T_b, 2), s=(s, 0))
    poses(T_a, "T_a")
    poses(T_b, "T_b")
    nearer, rest = _nearer(T_a, T_b, s)
    if screw:
        T = nearer @ se3_exp(rest * se3_log(se3_inv(T_a) @ T_b))
        return result(T, out, T_a=T_a, T_b=T_b, s=s)
    p = nearer[..., :3, 3] + rest * (T_b[..., :3, 3] - T_a[..., :3, 3])
    return result(_pose(so3_interpolate(T_a[..., :3, :3], T_b[..., :3, :3], s), p), out, T_a=T_a, T_b=T_b, s=s)


def se3_left_jacobian(xi: Any, out: Any = None) -> np.ndarray:
    """``[[J, Q], [0, J]]``: J of w, and Q its derivative in the direction v."""
    xi = elements(xi, "xi", (6,))
    v, w = xi[..., :3], xi[..., 3:]
    return result(_with_derivative(w, v, _left_jacobian(_norm(w))), out, xi=xi)


def se3_left_jacobian_inv(xi: Any, out: Any = None) -> np.ndarray:
    """The same of the inverse of J."""
    xi = elements(xi, "xi", (6,))
    v, w = xi[..., :3], xi[..., 3:]
    return result(_with_derivative(w, v, _left_jacobian_inv(_norm(w))), out, xi=xi)


def quaternion_from_matrix(R: Any, out: Any = None) -> np.ndarray:
    """Divide the row of 4 q qᵀ with the largest diagonal by its length (Shepperd 1978)."""
    return result(_from_matrix(rotations(R, "R")), out, R=R)


def quaternion_to_matrix(quaternion: Any, out: Any = None) -> np.ndarray:
    """``I + 2 w hat(v) + 2 hat(v)²`` of the unit quaternion (w, v)."""
    q = unit(quaternion, "quaternion")
    return result(_polynomial(q[..., 1:], 2 * q[..., 0], np.full(q.shape[:-1], 2.0)), out, quaternion=quaternion)


def quaternion_multiply(p: Any, q: Any, out: Any = None) -> np.ndarray:
    """``(p_w q_w - p_v · q_v, p_w q_v + q_w p_v + p_v × q_v)``."""
    p, q = elements(p, "p", (4,)), elements(q, "q", (4,))
    p, q = broadcast(p=(p, 1), q=(q, 1))
    (pw, pv), (qw, qv) = ((x[..., :1], x[..., 1:]) for x in (p, q))
    w = pw * qw - (pv * qv).sum(axis=-1, keepdims=True)
    return result(np.concatenate([w, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1), out, p=p, q=q)


def quaternion_slerp(a: Any, b: Any, s: Any, out: Any = None) -> np.ndarray:
    """``(a sin((1-s)Ω) ± b sin(sΩ)) / sin Ω``, Ω at most a quarter turn of the unit sphere."""
    a, b, s = elements(a, "a", (4,)), elements(b, "b", (4,)), elements(s, "s", ())
    a, b, s = broadcast(a=(a, 1), b=(b, 1), s=(s, 0))
    one, other, share = unit(a, "a"), unit(b, "b"), s[..., None]
    other = np.where((one * other).sum(axis=-1, keepdims=True) < 0, -other, other)
    chord = [np.linalg.norm(v, axis=-1, keepdims=True) for v in (other - one, other + one)]
    omega = 2 * np.arctan2(*chord) / np.pi  # in half turns of the unit sphere, as np.sinc wants it
    q = (1 - share) * np.sinc((1 - share) * omega) * one + share * np.sinc(share * omega) * other
    q = q / np.sinc(omega)
    return result(q / np.linalg.norm(q, axis=-1, keepdims=True), out, a=a, b=b, s=s)


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
