"""Laws of the dynamic kernels."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.kernels import Chain

GRAVITY = np.array([1.0, -2.0, -9.0])


def mass_matrix(chain: Chain, q: np.ndarray, pi: np.ndarray) -> np.ndarray:
    rest = np.zeros((chain.n, chain.n))
    return chain.rnea(rest + q, rest, np.eye(chain.n), np.zeros(3), pi)


def potential(chain: Chain, q: np.ndarray, pi: np.ndarray) -> np.ndarray:
    """U = -sum g . (m p + R m c)."""
    T = chain.link_transforms(q)
    moments = pi[:, :1] * T[..., :3, 3] + (T[..., :3, :3] @ pi[:, 1:4, None])[..., 0]
    return -(moments @ GRAVITY).sum(axis=-1)


def kinetic(chain: Chain, q: np.ndarray, qd: np.ndarray, pi: np.ndarray) -> float:
    """Sum over links of m v.v/2 + v.(w x h) + w.I w/2, from the Jacobians of the link frames."""
    energy = 0.0
    for i in range(chain.n):
        link = Chain(np.concatenate([chain.frames[: i + 1], np.eye(4)[None]]), chain.prismatic[: i + 1])
        v, w = np.split(link.jacobian(q[: i + 1], tool=True) @ qd[: i + 1], 2)
        xx, xy, yy, xz, yz, zz = pi[i, 4:]
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        energy += 0.5 * pi[i, 0] * v @ v + v @ np.cross(w, pi[i, 1:4]) + 0.5 * w @ inertia @ w
    return energy


def test_rnea_is_the_regressor_times_the_parameters(chain: Chain) -> None:
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(scale=2.0, size=(3, 40, chain.n))
    pi = rng.normal(size=(chain.n, 10))
    tau = chain.rnea(q, qd, qdd, GRAVITY, pi)
    Y = chain.rigid_regressor(q, qd, qdd, GRAVITY)
    assert Y.shape == (40, chain.n, 10 * chain.n)
    np.testing.assert_allclose(Y @ pi.ravel(), tau, rtol=0, atol=1e-12 * np.abs(tau).max())


def test_gravity_is_the_gradient_of_the_potential(chain: Chain, solids: np.ndarray) -> None:
    h, q = 1e-4, np.random.default_rng(1).uniform(-3, 3, chain.n)
    steps = h * np.eye(chain.n)
    gradient = (potential(chain, q + steps, solids) - potential(chain, q - steps, solids)) / (2 * h)
    rest = np.zeros(chain.n)
    G = chain.rnea(q, rest, rest, GRAVITY, solids)
    np.testing.assert_allclose(G, gradient, rtol=0, atol=1e-7 * max(1.0, np.abs(G).max()))


def test_mass_matrix_is_symmetric_positive_and_the_kinetic_energy(chain: Chain, solids: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    q, qd = rng.uniform(-3, 3, (2, chain.n))
    M = mass_matrix(chain, q, solids)
    np.testing.assert_allclose(M, M.T, rtol=0, atol=1e-12 * np.abs(M).max())
    assert np.linalg.eigvalsh(M).min() > 0.0
    assert 0.5 * qd @ M @ qd == pytest.approx(kinetic(chain, q, qd, solids), rel=1e-12)


def test_mass_matrix_and_momentum_are_those_of_newton_euler(chain: Chain, solids: np.ndarray) -> None:
    """M by unit accelerations, p = M qd, and rnea without gravity is dp/dt - beta, dp/dt by central differences."""
    rng = np.random.default_rng(5)
    q, qd, qdd = rng.uniform(-2, 2, (3, chain.n))
    M = chain.mass_matrix(q, solids)
    scale = max(1.0, np.abs(M).max())
    np.testing.assert_allclose(M, mass_matrix(chain, q, solids), rtol=0, atol=1e-12 * scale)
    p, beta = chain.momentum(q, qd, solids)
    np.testing.assert_allclose(p, M @ qd, rtol=0, atol=1e-11 * scale)
    h = 1e-5

    def at(s: float) -> np.ndarray:
        return chain.momentum(q + s * qd + 0.5 * s * s * qdd, qd + s * qdd, solids)[0]

    rate = (at(h) - at(-h)) / (2 * h)
    tau = chain.rnea(q, qd, qdd, np.zeros(3), solids)
    np.testing.assert_allclose(rate - beta, tau, rtol=0, atol=1e-6 * max(1.0, np.abs(tau).max()))


def test_power_is_the_rate_of_energy(chain: Chain, solids: np.ndarray) -> None:
    """qd . tau = d(kinetic + potential)/dt: Coriolis terms do no work of their own."""
    rng = np.random.default_rng(3)
    q, qd, qdd = rng.normal(size=(3, chain.n))
    h = 1e-5

    def energy(t: float) -> float:
        x, v = q + t * qd + 0.5 * t * t * qdd, qd + t * qdd
        return kinetic(chain, x, v, solids) + float(potential(chain, x, solids))

    rate = (energy(h) - energy(-h)) / (2 * h)
    assert qd @ chain.rnea(q, qd, qdd, GRAVITY, solids) == pytest.approx(rate, rel=1e-6, abs=1e-6)


def test_coriolis_of_a_sliding_joint_on_a_turntable() -> None:
    """r = d + q2 on a table turning about the vertical: tau1 = 2 m r rd w + m r^2 wd, f2 = m (rdd - r w^2)."""
    quarter = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])  # z of the slide along x
    chain = Chain(np.stack([np.eye(4), quarter, np.eye(4)]), [False, True])
    pi = np.zeros((2, 10))
    m, w, wd, r, rd, rdd = 2.0, 0.7, -0.4, 0.9, 1.3, 0.2
    pi[1, 0] = m
    tau = chain.rnea([0.5, r], [w, rd], [wd, rdd], [0.0, 0.0, -9.81], pi)
    np.testing.assert_allclose(tau, [2 * m * r * rd * w + m * r * r * wd, m * (rdd - r * w * w)], rtol=0, atol=1e-14)


def test_double_pendulum_of_the_textbook() -> None:
    """Planar two-link arm, point masses at the ends of the links (Craig, Introduction to Robotics, section 6.7)."""
    l1, l2, m1, m2, g = 0.5, 0.4, 1.5, 0.8, 9.81
    upright = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # plane x-z, angle from x
    shift = [np.eye(4), np.eye(4)]
    shift[0][0, 3], shift[1][0, 3] = l1, l2
    chain = Chain(np.stack([upright, *shift]), [False, False])
    pi = np.zeros((2, 10))
    for row, mass, length in zip(pi, (m1, m2), (l1, l2)):
        row[0], row[1], row[[6, 9]] = mass, mass * length, mass * length**2
    (q1, q2), (w1, w2), (a1, a2) = (0.3, -1.1), (0.9, 1.7), (-0.6, 2.0)
    c2, s2 = np.cos(q2), np.sin(q2)
    common = m2 * l2**2 * (a1 + a2) + m2 * l2 * g * np.cos(q1 + q2)
    tau1 = common + m2 * l1 * l2 * c2 * (2 * a1 + a2) + (m1 + m2) * l1**2 * a1
    tau1 += -m2 * l1 * l2 * s2 * (w2**2 + 2 * w1 * w2) + (m1 + m2) * l1 * g * np.cos(q1)
    tau2 = common + m2 * l1 * l2 * (c2 * a1 + s2 * w1**2)
    tau = chain.rnea([q1, q2], [w1, w2], [a1, a2], [0.0, 0.0, -g], pi)
    np.testing.assert_allclose(tau, [tau1, tau2], rtol=0, atol=1e-13)
