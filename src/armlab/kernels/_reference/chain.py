"""Kinematics and rigid-body dynamics of a serial chain, in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import check_threads, read, result, results, same_shape
from armlab.kernels._reference.spatial import UNIT_INERTIAS, apply, twist_cross, twist_transform, wrench_cross

__all__ = ["Chain"]

MAX_JOINTS = 32
_Pair = tuple[np.ndarray, np.ndarray]


class Chain:
    """A serial chain of revolute and prismatic joints, immutable.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n`` with ``Z(q) = Rz(q)`` (revolute) or ``Tz(q)`` (prismatic):
    the local product of exponentials with every joint axis along z. Link frame i is
    ``T_base_i = E_0 Z_1(q_1) ... E_{i-1} Z_i(q_i)``.

    Every method takes any leading batch and keeps it, accepts read-only input, leaves it unchanged, and writes into
    `out` when that is given. NaN in a sample gives NaN in its result. Argument errors are `ShapeError`.

    Parameters
    ----------
    frames : (n + 1, 4, 4) E_0 ... E_n, rigid to 1e-6 (rotations are then projected on SO(3)) [m].
    prismatic : (n,) bool, True for prismatic joints; n from 1 to 32.
    """

    def __init__(self, frames: Any, prismatic: Any) -> None:
        kinds = read(prismatic, "prismatic", ())
        if kinds.ndim != 1 or not 1 <= kinds.size <= MAX_JOINTS:
            raise ShapeError(
                f"Expected prismatic of shape (n,) with n from 1 to {MAX_JOINTS} joints, got {kinds.shape}."
            )
        self._prismatic = tuple(bool(kind) for kind in kinds)
        self._frames = _rigid(read(frames, "frames", (self.n + 1, 4, 4), exact=True))

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self._prismatic)

    @property
    def frames(self) -> np.ndarray:
        """(n + 1, 4, 4) a copy of E_0 ... E_n."""
        return self._frames.copy()

    @property
    def prismatic(self) -> np.ndarray:
        """(n,) bool, True for prismatic joints."""
        return np.array(self._prismatic)

    def __reduce__(self) -> tuple[type[Chain], _Pair]:
        """Pickle by the constructor's arguments."""
        return type(self), (self.frames, self.prismatic)

    def forward(self, q: Any, out: Any = None, threads: int = 1) -> np.ndarray:
        """Return T_base_tool (..., 4, 4) for joint positions `q` (..., n)."""
        check_threads(threads)
        return result(self._links(self._joints(q))[..., -1, :, :] @ self._frames[-1], out, q=q)

    def link_transforms(self, q: Any, out: Any = None) -> np.ndarray:
        """Return T_base_i (..., n, 4, 4) of link frames 1 ... n."""
        return result(self._links(self._joints(q)), out, q=q)

    def jacobian(self, q: Any, tool: bool = False, out: Any = None, threads: int = 1) -> np.ndarray:
        """Return J (..., 6, n), rows [v; w], at the tool point in base axes, or in tool axes when `tool`.

        Column i is ``[z_i x (p - p_i); z_i]`` (revolute) or ``[z_i; 0]`` (prismatic).
        """
        check_threads(threads)
        return result(self._forward_jacobian(self._joints(q), tool)[1], out, q=q)

    def forward_jacobian(self, q: Any, tool: bool = False, out: _Pair | None = None, threads: int = 1) -> _Pair:
        """Return `forward`, T_base_tool (..., 4, 4), and `jacobian`, J (..., 6, n); `out` is such a pair."""
        check_threads(threads)
        return results(self._forward_jacobian(self._joints(q), tool), out, "(T, J)", q=q)

    def jacobian_derivative(self, q: Any, qd: Any, tool: bool = False, out: Any = None) -> np.ndarray:
        """Return Jd (..., 6, n), the derivative of `jacobian` along the motion `q`, `qd` (..., n).

        Base axes: ``dv_i/dq_j = w_first x v_last`` with first = min(i, j), last = max(i, j), and ``dw_i/dq_j = w_j x
        w_i`` where j < i, else 0. Tool axes: ``d/dt (R^T u) = R^T (ud - w x u)``, w the angular velocity of the tool.
        """
        positions, speeds = self._joints(q), read(qd, "qd", (self.n,))
        same_shape(speeds, "qd", positions, "q")
        T, J = self._forward_jacobian(positions)
        v, w = (np.moveaxis(half, -1, 0) for half in (J[..., :3, :], J[..., 3:, :]))  # (n, ..., 3)
        vd, wd = np.zeros_like(v), np.zeros_like(w)
        for i, slides in enumerate(self._prismatic):
            for j in range(self.n):
                first, last, rate = min(i, j), max(i, j), speeds[..., j, None]
                vd[i] += np.cross(w[first], v[last]) * rate
                if j < i and not slides:
                    wd[i] += np.cross(w[j], w[i]) * rate
        if tool:
            R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
            turn = np.vecdot(np.moveaxis(w, 0, -1), speeds[..., None, :])
            vd, wd = (apply(R_transposed, ud - np.cross(turn, u)) for ud, u in ((vd, v), (wd, w)))
        Jd = np.ascontiguousarray(np.moveaxis(np.concatenate([vd, wd], axis=-1), 0, -1))
        return result(Jd, out, q=q, qd=qd)

    def rnea(self, q: Any, qd: Any, qdd: Any, gravity: Any, pi: Any, out: Any = None) -> np.ndarray:
        """Return joint torques tau (..., n) of a motion, by recursive Newton-Euler.

        ``F_i = I_i A_i + V_i x* (I_i V_i)`` with ``A_0 = [-g; 0]``; ``tau_i = S_i . sum of F_k, k >= i``.

        Parameters
        ----------
        q, qd, qdd : (..., n) joint positions, velocities, accelerations.
        gravity : (3,) gravity in base axes [m/s^2].
        pi : (n, 10) per link, in link frame i about its origin: m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
        out : (..., n) array to write into, or None.
        """
        steps, V, A = self._motion(q, qd, qdd, gravity)
        inertia = np.einsum("ik,kab->iab", read(pi, "pi", (self.n, 10), exact=True), UNIT_INERTIAS)
        tau = np.empty((*V[0].shape[:-1], self.n))
        F = np.zeros_like(V[0])
        for i in reversed(range(self.n)):
            F = F + apply(inertia[i], A[i]) + apply(wrench_cross(V[i]), apply(inertia[i], V[i]))
            tau[..., i] = F @ self._axis(i)
            F = apply(np.swapaxes(steps[i], -1, -2), F)
        return result(tau, out, apart={"gravity": gravity, "pi": pi}, q=q, qd=qd, qdd=qdd)

    def rigid_regressor(self, q: Any, qd: Any, qdd: Any, gravity: Any, out: Any = None) -> np.ndarray:
        """Return Y (..., n, 10 n) with ``tau = Y pi.ravel()``, parameters as in `rnea`."""
        steps, V, A = self._motion(q, qd, qdd, gravity)
        Y = np.zeros((*V[0].shape[:-1], self.n, 10 * self.n))
        for k in range(self.n):
            momenta = np.einsum("kab,...b->...ak", UNIT_INERTIAS, V[k])
            F = np.einsum("kab,...b->...ak", UNIT_INERTIAS, A[k]) + wrench_cross(V[k]) @ momenta
            for i in reversed(range(k + 1)):
                Y[..., i, 10 * k : 10 * k + 10] = self._axis(i) @ F
                F = np.swapaxes(steps[i], -1, -2) @ F
        return result(Y, out, apart={"gravity": gravity}, q=q, qd=qd, qdd=qdd)

    def mass_matrix(self, q: Any, pi: Any, out: Any = None) -> np.ndarray:
        """Return M (..., n, n): column j is the torque of a unit acceleration of joint j, without gravity and velocity.

        Parameters
        ----------
        q : (..., n). pi : (n, 10) as in `rnea`. out : (..., n, n) array to write into, or None.
        """
        positions = self._joints(q)
        M = np.empty((*positions.shape, self.n))
        zero = np.zeros_like(positions)
        for j in range(self.n):
            M[..., j] = self.rnea(positions, zero, zero + np.eye(self.n)[j], np.zeros(3), pi)
        return result(M, out, apart={"pi": pi}, q=q)

    def momentum(self, q: Any, qd: Any, pi: Any, out: _Pair | None = None) -> _Pair:
        """Return p = M qd and beta = C^T qd (..., n): rnea without gravity is dp/dt - beta; `out` is such a pair.

        With l_i the momentum of links i ... n and V_i the twist of link i: ``p_i = S_i . l_i, beta_i = l_i . (V_i x
        S_i)``.

        Parameters
        ----------
        q, qd : (..., n). pi : (n, 10) as in `rnea`.
        """
        steps, V, _ = self._motion(q, qd, np.zeros_like(self._joints(q)), np.zeros(3))
        inertia = np.einsum("ik,kab->iab", read(pi, "pi", (self.n, 10), exact=True), UNIT_INERTIAS)
        p, beta = np.empty((*V[0].shape[:-1], self.n)), np.empty((*V[0].shape[:-1], self.n))
        total = np.zeros_like(V[0])
        for i in reversed(range(self.n)):
            total = total + apply(inertia[i], V[i])
            p[..., i] = total @ self._axis(i)
            beta[..., i] = np.einsum("...a,...a->...", total, apply(twist_cross(V[i]), self._axis(i)))
            total = apply(np.swapaxes(steps[i], -1, -2), total)
        return results((p, beta), out, "(p, beta)", {"pi": pi}, q=q, qd=qd)

    def gravity_regressor(self, q: Any, gravity: Any, out: Any = None) -> np.ndarray:
        """Return Y_g (..., n, 4 n) of the gravity torques ``G = dU/dq = Y_g [m, m cx, m cy, m cz]`` per link.

        ``U = -sum g . (m_i p_i + R_i m_i c_i)``.
        """
        g = read(gravity, "gravity", (3,), exact=True)
        T = self._links(self._joints(q))
        z, p = T[..., :3, 2], T[..., :3, 3]
        Y = np.zeros((*T.shape[:-3], self.n, 4 * self.n))
        for k in range(self.n):
            for i in range(k + 1):
                lever = z[..., i, :] if self._prismatic[i] else np.cross(z[..., i, :], p[..., k, :] - p[..., i, :])
                Y[..., i, 4 * k] = -lever @ g
                if not self._prismatic[i]:
                    turn = np.cross(z[..., i, :], g)
                    Y[..., i, 4 * k + 1 : 4 * k + 4] = apply(np.swapaxes(T[..., k, :3, :3], -1, -2), turn)
        return result(Y, out, apart={"gravity": gravity}, q=q)

    def _joints(self, q: Any) -> np.ndarray:
        return read(q, "q", (self.n,))

    def _axis(self, i: int) -> np.ndarray:
        """(6,) axis of joint i as a twist [v; w] in link frame i."""
        return np.eye(6)[2 if self._prismatic[i] else 5]

    def _joint_transform(self, i: int, q: np.ndarray) -> np.ndarray:
        """(..., 4, 4) Z_i(q_i)."""
        Z = np.zeros((*q.shape, 4, 4))
        Z[...] = np.eye(4)
        if self._prismatic[i]:
            Z[..., 2, 3] = q
            return Z
        with np.errstate(invalid="ignore"):  # infinity gives NaN, as in C++
            Z[..., 0, 0] = Z[..., 1, 1] = np.cos(q)
            Z[..., 1, 0] = np.sin(q)
        Z[..., 0, 1] = -Z[..., 1, 0]
        return Z

    def _links(self, q: np.ndarray) -> np.ndarray:
        T = np.empty((*q.shape, 4, 4))
        for i in range(self.n):
            before = self._frames[0] if i == 0 else T[..., i - 1, :, :] @ self._frames[i]
            T[..., i, :, :] = before @ self._joint_transform(i, q[..., i])
        return T

    def _forward_jacobian(self, q: np.ndarray, tool: bool = False) -> _Pair:
        links = self._links(q)
        T = links[..., -1, :, :] @ self._frames[-1]
        z = links[..., :3, 2]
        lever = T[..., None, :3, 3] - links[..., :3, 3]
        prismatic = self.prismatic[:, None]
        missing = 0.0 * T[..., None, :3, 3]  # NaN where a joint is, also for columns that do not depend on it
        v, w = np.where(prismatic, z, np.cross(z, lever)) + missing, np.where(prismatic, np.zeros(3), z)
        if tool:
            v, w = v @ T[..., :3, :3], w @ T[..., :3, :3]
        return T, np.ascontiguousarray(np.swapaxes(np.concatenate([v, w], axis=-1), -1, -2))

    def _motion(
        self, q: Any, qd: Any, qdd: Any, gravity: Any
    ) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
        """Twist transforms from link to link, twists V and spatial accelerations A of every link, in its own frame."""
        positions, speeds = self._joints(q), read(qd, "qd", (self.n,))
        accelerations = read(qdd, "qdd", (self.n,))
        same_shape(speeds, "qd", positions, "q")
        same_shape(accelerations, "qdd", positions, "q")
        g = read(gravity, "gravity", (3,), exact=True)
        v = np.zeros((*positions.shape[:-1], 6))
        a = v - np.concatenate([g, np.zeros(3)])
        steps, V, A = [], [], []
        for i in range(self.n):
            X = twist_transform(self._frames[i] @ self._joint_transform(i, positions[..., i]))
            own = self._axis(i) * speeds[..., i, None]
            v = apply(X, v) + own
            a = apply(X, a) + self._axis(i) * accelerations[..., i, None] + apply(twist_cross(v), own)
            steps.append(X)
            V.append(v)
            A.append(a)
        return steps, V, A


def _rigid(frames: np.ndarray) -> np.ndarray:
    """Return `frames` with rotations projected on SO(3) by Newton steps.

    Refuses what is off by more than 1e-6, leaves alone what is orthonormal to rounding.
    """
    frames = frames.copy()
    for _ in range(2):
        R = frames[:, :3, :3]
        gram = np.swapaxes(R, -1, -2) @ R
        off = np.abs(gram - np.eye(3)).max(axis=(1, 2))
        bottom = (frames[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
        right_handed = np.vecdot(np.cross(R[:, :, 0], R[:, :, 1]), R[:, :, 2]) > 0.0
        good = bottom & (off <= 1e-6) & right_handed & np.isfinite(frames[:, :3, 3]).all(axis=1)
        if not good.all():
            raise ShapeError(
                "Expected every frame to be a rigid transformation (rotation orthonormal to 1e-6, determinant 1, last "
                f"row 0 0 0 1), got one that is not: frames[{np.argmin(good)}]. "
                "Normalise quaternions and rotations first."
            )
        rough = off > 1e-14
        frames[rough, :3, :3] = R[rough] @ (3.0 * np.eye(3) - gram[rough]) / 2.0
    return frames
