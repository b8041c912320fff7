"""Kinematics and rigid-body dynamics of a serial chain, with spatial vectors: twists [v; w], wrenches [f; m]."""

from __future__ import annotations

from typing import Any

import numpy as np


def apply(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the product (..., m) of matrices (..., m, n) and vectors (..., n)."""
    return (matrix @ vector[..., None])[..., 0]


def hat(p: np.ndarray) -> np.ndarray:
    """Return (..., 3, 3) with ``hat(p) x = p x x``."""
    x, y, z = np.moveaxis(p, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape((*p.shape, 3))


def twist_transform(T: np.ndarray) -> np.ndarray:
    """Return (..., 6, 6) Ad(T^-1): the twist of a body, expressed in frame b instead of a, for T = T_a_b."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    X = np.zeros((*T.shape[:-2], 6, 6))
    X[..., :3, :3] = X[..., 3:, 3:] = R_transposed
    X[..., :3, 3:] = -R_transposed @ hat(T[..., :3, 3])
    return X


def twist_cross(V: np.ndarray) -> np.ndarray:
    """Return (..., 6, 6) V x: rate of change of a twist that is fixed in a body moving with V."""
    X = np.zeros((*V.shape, 6))
    X[..., :3, :3] = X[..., 3:, 3:] = hat(V[..., 3:])
    X[..., :3, 3:] = hat(V[..., :3])
    return X


def wrench_cross(V: np.ndarray) -> np.ndarray:
    """Return (..., 6, 6) V x*: the same for a wrench, -(V x)^T."""
    return -np.swapaxes(twist_cross(V), -1, -2)


def _unit_inertias() -> np.ndarray:
    """Return the (10, 6, 6) spatial inertia [[m 1, -hat(h)], [hat(h), I]] per unit of each entry of `pi`."""
    units = np.zeros((10, 6, 6))
    units[0, :3, :3] = np.eye(3)
    for k in range(3):
        h = hat(np.eye(3)[k])
        units[1 + k, :3, 3:], units[1 + k, 3:, :3] = -h, h
    for k, (row, column) in enumerate([(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]):
        units[4 + k, 3 + row, 3 + column] = units[4 + k, 3 + column, 3 + row] = 1.0
    return units


UNIT_INERTIAS = _unit_inertias()


_Pair = tuple[np.ndarray, np.ndarray]


class Chain:
    """A serial chain of revolute and prismatic joints, immutable.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n`` with ``Z(q) = Rz(q)`` (revolute) or ``Tz(q)`` (prismatic):
    the local product of exponentials with every joint axis along z. Link frame i is
    ``T_base_i = E_0 Z_1(q_1) ... E_{i-1} Z_i(q_i)``.

    Every method takes any leading batch and keeps it, accepts read-only input, leaves it unchanged, and writes into
    `out` if given. NaN in a sample gives NaN in its result. Argument errors are `ShapeError`.
    """

    def __init__(self, frames: Any, prismatic: Any) -> None:
        kinds = np.asarray(prismatic, dtype=float)
        self._prismatic = tuple(bool(kind) for kind in kinds)
        self._frames = _rigid(np.asarray(frames, dtype=float))

    @property
    def n(self) -> int:
        return len(self._prismatic)

    @property
    def frames(self) -> np.ndarray:
        return self._frames.copy()

    @property
    def prismatic(self) -> np.ndarray:
        return np.array(self._prismatic)

    def forward(self, q: Any) -> np.ndarray:
        return self._links(self._joints(q))[..., -1, :, :] @ self._frames[-1]

    def link_transforms(self, q: Any) -> np.ndarray:
        return self._links(self._joints(q))

    def jacobian(self, q: Any, tool: bool = False) -> np.ndarray:
        return self._forward_jacobian(self._joints(q), tool)[1]

    def forward_jacobian(self, q: Any, tool: bool = False) -> _Pair:
        return self._forward_jacobian(self._joints(q), tool)

    def jacobian_derivative(self, q: Any, qd: Any, tool: bool = False) -> np.ndarray:
        positions, speeds = self._joints(q), np.asarray(qd, dtype=float)
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
        return np.ascontiguousarray(np.moveaxis(np.concatenate([vd, wd], axis=-1), 0, -1))

    def rnea(self, q: Any, qd: Any, qdd: Any, gravity: Any, pi: Any) -> np.ndarray:
        steps, V, A = self._motion(q, qd, qdd, gravity)
        inertia = np.einsum("ik,kab->iab", np.asarray(pi, dtype=float), UNIT_INERTIAS)
        tau = np.empty((*V[0].shape[:-1], self.n))
        F = np.zeros_like(V[0])
        for i in reversed(range(self.n)):
            F = F + apply(inertia[i], A[i]) + apply(wrench_cross(V[i]), apply(inertia[i], V[i]))
            tau[..., i] = F @ self._axis(i)
            F = apply(np.swapaxes(steps[i], -1, -2), F)
        return tau

    def rigid_regressor(self, q: Any, qd: Any, qdd: Any, gravity: Any) -> np.ndarray:
        steps, V, A = self._motion(q, qd, qdd, gravity)
        Y = np.zeros((*V[0].shape[:-1], self.n, 10 * self.n))
        for k in range(self.n):
            momenta = np.einsum("kab,...b->...ak", UNIT_INERTIAS, V[k])
            F = np.einsum("kab,...b->...ak", UNIT_INERTIAS, A[k]) + wrench_cross(V[k]) @ momenta
            for i in reversed(range(k + 1)):
                Y[..., i, 10 * k : 10 * k + 10] = self._axis(i) @ F
                F = np.swapaxes(steps[i], -1, -2) @ F
        return Y

    def mass_matrix(self, q: Any, pi: Any) -> np.ndarray:
        """Return M (..., n, n): column j is the torque of a unit acceleration of joint j alone."""
        positions = self._joints(q)
        M = np.empty((*positions.shape, self.n))
        zero = np.zeros_like(positions)
        for j in range(self.n):
            M[..., j] = self.rnea(positions, zero, zero + np.eye(self.n)[j], np.zeros(3), pi)
        return M

    def momentum(self, q: Any, qd: Any, pi: Any) -> _Pair:
        """Return p = M qd and beta = C^T qd (..., n): rnea without gravity is dp/dt - beta; `out` is such a pair.

        With l_i the momentum of links i ... n and V_i the twist of link i: ``p_i = S_i . l_i, beta_i = l_i . (V_i x
        S_i)``.
        """
        steps, V, _ = self._motion(q, qd, np.zeros_like(self._joints(q)), np.zeros(3))
        inertia = np.einsum("ik,kab->iab", np.asarray(pi, dtype=float), UNIT_INERTIAS)
        p, beta = np.empty((*V[0].shape[:-1], self.n)), np.empty((*V[0].shape[:-1], self.n))
        total = np.zeros_like(V[0])
        for i in reversed(range(self.n)):
            total = total + apply(inertia[i], V[i])
            p[..., i] = total @ self._axis(i)
            beta[..., i] = np.einsum("...a,...a->...", total, apply(twist_cross(V[i]), self._axis(i)))
            total = apply(np.swapaxes(steps[i], -1, -2), total)
        return (p, beta)

    def _joints(self, q: Any) -> np.ndarray:
        return np.asarray(q, dtype=float)

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
        positions, speeds = self._joints(q), np.asarray(qd, dtype=float)
        accelerations = np.asarray(qdd, dtype=float)
        g = np.asarray(gravity, dtype=float)
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
    """Return `frames` with rotations projected onto SO(3) by Newton steps.

    Rotations off by more than 1e-6 are refused; those orthonormal to rounding are left unchanged.
    """
    frames = frames.copy()
    for _ in range(2):
        R = frames[:, :3, :3]
        gram = np.swapaxes(R, -1, -2) @ R
        off = np.abs(gram - np.eye(3)).max(axis=(1, 2))
        rough = off > 1e-14
        frames[rough, :3, :3] = R[rough] @ (3.0 * np.eye(3) - gram[rough]) / 2.0
    return frames
