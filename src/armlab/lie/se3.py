"""Poses SE(3) as arrays (..., 4, 4) and twists [v; w] (..., 6).

All functions accept any leading axes and preserve them. NaN inputs give NaN results.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name
from armlab.errors import ShapeError
from armlab.lie import arguments, so3

__all__ = [
    "ad", "adjoint", "adjoint_inv", "exp", "from_angular_first", "from_rp", "hat", "interpolate", "inv", "is_pose",
    "left_jacobian", "left_jacobian_inv", "log", "mean", "orthonormalise", "project", "to_angular_first",
    "transform_wrench", "vee",
]  # fmt: skip

PATHS = ("linear", "screw")


def from_rp(R: ArrayLike, p: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the pose ``[[R, p], [0, 1]]`` (..., 4, 4).

    Parameters
    ----------
    R : (..., 3, 3) rotation.
    p : (..., 3) position [m]; leading axes broadcast with those of R.

    Raises
    ------
    ShapeError : R is not a rotation within `so3.ROTATION_TOLERANCE`, or leading axes do not broadcast.
    """
    R, p = kernels.rotations(R, "R"), arguments.array(p, (3,), "p")
    arguments.broadcasts(R=(R, 2), p=(p, 1))
    return assemble(R, p)


def hat(xi: ArrayLike) -> np.ndarray:
    """Return the matrix (..., 4, 4) of a twist: ``[[hat(w), v], [0, 0]]``.

    Parameters
    ----------
    xi : (..., 6) twist [v; w].
    """
    xi = arguments.array(xi, (6,), "xi")
    X = np.zeros((*xi.shape[:-1], 4, 4))
    X[..., :3, :3] = so3.hat(xi[..., 3:])
    X[..., :3, 3] = xi[..., :3]
    return X


def vee(X: ArrayLike) -> np.ndarray:
    """Return the twist [v; w] (..., 6) of a twist matrix: ``vee(hat(xi)) = xi``.

    Parameters
    ----------
    X : (..., 4, 4), with a skew-symmetric upper-left block and zeros in the last row.

    Raises
    ------
    ShapeError : X is not a twist matrix; for a pose use `log`.
    """
    X = arguments.array(X, (4, 4), "X")
    if (X[..., 3, :] != 0).any():
        raise ShapeError(
            f"Expected a twist matrix with zeros in the last row, got {X[..., 3, :].max():.3g}. Use log for a pose."
        )
    return np.concatenate([X[..., :3, 3], so3.vee(X[..., :3, :3])], axis=-1)


def exp(xi: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the pose (..., 4, 4) reached in unit time at a constant twist: ``[[exp(w), V v], [0, 1]]``.

    V is ``so3.left_jacobian(w)``.

    Parameters
    ----------
    xi : (..., 6) twist [v; w]; w = 0 gives a pure translation.
    out : (..., 4, 4) array for the result; default: newly allocated.
    """
    return kernels.se3_exp(xi, out)


def log(T: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the minimum-rotation twist [v; w] (..., 6) of a pose: ``exp(log(T)) = T``, abs(w) ≤ π.

    Parameters
    ----------
    T : (..., 4, 4) pose.
    out : (..., 6) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : T is not a pose within `so3.ROTATION_TOLERANCE`.
    """
    return kernels.se3_log(T, out)


def inv(T: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the inverse pose (..., 4, 4): ``[[Rᵀ, -Rᵀ p], [0, 1]]``.

    Parameters
    ----------
    T : (..., 4, 4) pose.
    out : (..., 4, 4) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : T is not a pose within `so3.ROTATION_TOLERANCE`.
    """
    return kernels.se3_inv(T, out)


def ad(xi: ArrayLike) -> np.ndarray:
    """Return the matrix (..., 6, 6) of the Lie bracket: ``hat(ad(xi) eta) = hat(xi) hat(eta) - hat(eta) hat(xi)``.

    The matrix ``[[hat(w), hat(v)], [0, hat(w)]]`` is the derivative of `adjoint`: ``expm(ad(xi)) = adjoint(exp(xi))``.
    The negative transpose of the matrix acts on wrenches.

    Parameters
    ----------
    xi : (..., 6) twist [v; w].
    """
    xi = arguments.array(xi, (6,), "xi")
    result = np.zeros((*xi.shape, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = so3.hat(xi[..., 3:])
    result[..., :3, 3:] = so3.hat(xi[..., :3])
    return result


def adjoint(T_a_b: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the matrix Ad (..., 6, 6) with ``twist_a = Ad twist_b`` for twists [v; w]: ``[[R, hat(p) R], [0, R]]``.

    Equivalently, ``hat(Ad xi) = T hat(xi) T⁻¹``.

    Parameters
    ----------
    T_a_b : (..., 4, 4) pose of b in a.
    out : (..., 6, 6) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : T_a_b is not a pose within `so3.ROTATION_TOLERANCE`.
    """
    return kernels.se3_adjoint(T_a_b, out)


def adjoint_inv(T_a_b: ArrayLike) -> np.ndarray:
    """Return ``adjoint(T)⁻¹ = adjoint(T⁻¹)`` (..., 6, 6), for twists [v; w].

    Parameters
    ----------
    T_a_b : (..., 4, 4) pose of b in a.

    Raises
    ------
    ShapeError : T_a_b is not a pose within `so3.ROTATION_TOLERANCE`.
    """
    return adjoint(inv(T_a_b))


def transform_wrench(T_a_b: ArrayLike, wrench_b: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Transform a wrench [f; m] (..., 6) from frame b to frame a: ``f_a = R f_b``, ``m_a = R m_b + p × f_a``.

    Both the axes and the reference point of the moment change: the moment of `wrench_b` is about the origin of b, and
    that of the result is about the origin of a. The result equals ``adjoint(T_b_a)ᵀ wrench_b``, so power is invariant.

    Parameters
    ----------
    T_a_b : (..., 4, 4) pose of b in a; leading axes broadcast.
    wrench_b : (..., 6) [f; m] in b.
    out : (..., 6) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : T_a_b is not a pose within `so3.ROTATION_TOLERANCE`.
    """
    return kernels.se3_transform_wrench(T_a_b, wrench_b, out)


def is_pose(T: ArrayLike, tolerance: float = so3.ROTATION_TOLERANCE) -> np.ndarray:
    """Return whether each matrix is a pose: (...) bool, False for NaN and infinity.

    A pose consists of a rotation, a finite position and the last row (0, 0, 0, 1).

    Parameters
    ----------
    T : (..., 4, 4) matrices.
    tolerance : largest accepted entry of ``abs(RᵀR - I)``.

    Raises
    ------
    ShapeError : wrong shape, or a negative or invalid tolerance.
    """
    T = arguments.array(T, (4, 4), "T")
    last_row = (T[..., 3, :] == (0.0, 0.0, 0.0, 1.0)).all(axis=-1)
    return so3.is_rotation(T[..., :3, :3], tolerance) & np.isfinite(T[..., :3, 3]).all(axis=-1) & last_row


def orthonormalise(T: ArrayLike, tolerance: float = so3.ROTATION_TOLERANCE) -> np.ndarray:
    """Orthonormalise the rounded rotations of poses (`so3.orthonormalise`); positions are unchanged.

    Parameters
    ----------
    T : (..., 4, 4) poses.
    tolerance : largest entry of ``abs(RᵀR - I)`` that counts as rounding error.

    Raises
    ------
    ShapeError : wrong shape, or a negative or invalid tolerance.
    """
    T = arguments.array(T, (4, 4), "T").copy()
    T[..., :3, :3] = so3.orthonormalise(T[..., :3, :3], tolerance)
    return T


def project(M: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose with the same position and the nearest rotation, and its distance from the matrix.

    Parameters
    ----------
    M : (..., 4, 4) matrix.

    Returns
    -------
    T : (..., 4, 4) nearest pose.
    distance : (...) Frobenius norm of the change in the rotation.

    Raises
    ------
    ShapeError : the last row is not (0, 0, 0, 1), or the nearest rotation is not unique.
    """
    M = arguments.array(M, (4, 4), "M")
    off = np.abs(M[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(axis=-1)
    missing = np.isnan(M[..., :3, :]).any(axis=(-1, -2))
    bad = (off > 0) | (np.isnan(off) & ~missing)  # reject NaN that is only in the last row
    if bad.any():
        raise ShapeError(f"Expected (0, 0, 0, 1) as the last row of M, got an error of {off[bad].max():.3g}.")
    R, distance = so3.project(M[..., :3, :3])
    return assemble(R, M[..., :3, 3]), distance


def left_jacobian(xi: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return J (..., 6, 6) with ``exp(xi + dxi) = exp(J dxi) exp(xi)``: ``[[V, Q], [0, V]]``.

    V is ``so3.left_jacobian(w)``, and Q is its derivative in the direction v: ``J = f(ad(xi))`` and ``V = f(hat(w))``
    with ``f(X) = I + X/2! + X²/3! + ...``. The right Jacobian is ``left_jacobian(-xi)``.

    Parameters
    ----------
    xi : (..., 6) twist [v; w].
    out : (..., 6, 6) array for the result; default: newly allocated.

    Reference: T. D. Barfoot, State estimation for robotics, 2017, eq. 7.83 to 7.86 (angular parts last, as here).
    """
    return kernels.se3_left_jacobian(xi, out)


def left_jacobian_inv(xi: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the inverse (..., 6, 6) of `left_jacobian`, in closed form: ``[[V⁻¹, -V⁻¹ Q V⁻¹], [0, V⁻¹]]``.

    Parameters
    ----------
    xi : (..., 6) twist [v; w] with w shorter than 2π [rad].
    out : (..., 6, 6) array for the result; default: newly allocated.
    """
    return kernels.se3_left_jacobian_inv(xi, out)


def from_angular_first(x: ArrayLike, axis: int = -1) -> np.ndarray:
    """Reorder twists [w; v] to [v; w], or wrenches [m; f] to [f; m]; the shape is unchanged.

    Use this function for data from libraries that put the angular part first.

    Parameters
    ----------
    x : array of length 6 along the axis: twists or wrenches (..., 6), or a Jacobian (..., 6, n) with axis -2. Convert a
        6 × 6 matrix along both axes.
    axis : the axis to reorder.

    Raises
    ------
    ShapeError : the axis does not have length 6.
    """
    x = arguments.array(x, (), "x")
    if not isinstance(axis, int | np.integer) or not -x.ndim <= axis < x.ndim or x.shape[axis] != 6:
        raise ShapeError(f"Expected an array of length 6 along axis {axis}, got shape {x.shape}. Choose another axis.")
    return np.roll(x, 3, axis=axis)


def to_angular_first(x: ArrayLike, axis: int = -1) -> np.ndarray:
    """Reorder twists [v; w] to [w; v], or wrenches [f; m] to [m; f]; inverse of `from_angular_first`.

    Use this function for libraries that put the angular part first. The shape is unchanged.

    Parameters
    ----------
    x : array of length 6 along the axis, as in `from_angular_first`.
    axis : the axis to reorder.

    Raises
    ------
    ShapeError : the axis does not have length 6.
    """
    return from_angular_first(x, axis)


def assemble(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1.0
    return T


def interpolate(
    T_a: ArrayLike,
    T_b: ArrayLike,
    s: ArrayLike,
    path: Literal["linear", "screw"] = "linear",
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Interpolate from a to b at constant speed, with the position along a line and the rotation about a fixed axis.

    The poses (..., 4, 4) are exact at both ends. The alternative screw path ``T_a exp(s log(T_a⁻¹ T_b))`` does not
    depend on the choice of reference point on the body; each point moves along a helix.

    Parameters
    ----------
    T_a, T_b : (..., 4, 4) poses in one frame; leading axes broadcast with those of s.
    s : (...) path parameter, 0 at a and 1 at b.
    path : "linear" or "screw".
    out : (..., 4, 4) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : an argument is not a pose within `so3.ROTATION_TOLERANCE`.
    UnknownName : unknown path.
    """
    check_name(path, "path between poses", PATHS)
    return kernels.se3_interpolate(T_a, T_b, s, path == "screw", out)


def mean(
    T: ArrayLike, weights: ArrayLike | None = None, method: Literal["chordal", "geodesic"] = "chordal"
) -> np.ndarray:
    """Return the mean pose (..., 4, 4) along axis 0: the mean position and `so3.mean` of the rotations.

    The result depends on the origin of the moving frame, because the positions of this origin are averaged.

    Parameters
    ----------
    T : (N, ..., 4, 4) poses, N ≥ 1.
    weights : (N,) or (N, ...), non-negative; default: equal. A weight of 0 excludes a pose, even a missing one.
    method : "chordal" or "geodesic" mean of the rotations.

    Raises
    ------
    ShapeError, NotConverged, UnknownName : as in `so3.mean`.
    """
    T = kernels.poses(T, "T")
    R = so3.mean(T[..., :3, :3], weights, method)
    share = so3.shares(weights, T.shape[:-2])[..., None]
    return assemble(R, (share * np.where(share > 0, T[..., :3, 3], 0.0)).sum(axis=0))
