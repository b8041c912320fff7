"""One step of the momentum filter (specification; the compiled twin is native/momentum_filter.cpp).

State [p; z]: the momentum p (n,) and m hidden inputs z, each a random walk with leak ``dz/dt = -a z + w``, w of
intensity q. Between samples ``dp/dt = u + G z + w_p``, w_p of intensity Qp. The matrix [[0, G], [0, -diag(a)]] has an
exponential, and the noise of a step (Van Loan 1978), in closed form; with ``phi(s) = (1 - e^(-a s))/a``

    Phi = [[I, G diag(phi(h))], [0, diag(e^(-a h))]]
    Qzz = diag(q int e^(-2 a s)),  Qpz = G diag(q phi(h)^2 / 2),  Qpp = diag(Qp) h + G diag(q int phi^2) G^T

then an update with the measured momentum y = p + v, v ~ N(0, R), in Joseph's form.
"""

from __future__ import annotations

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import read

__all__ = ["leak_integrals", "momentum_step"]

SERIES_BELOW = 1.0  # of a h: there the closed form of int phi^2 loses digits


def leak_integrals(a: np.ndarray, h: float) -> tuple[np.ndarray, ...]:
    """Return e^(-a h), phi(h), int e^(-2 a s), int phi e^(-a s), int phi^2 over 0 ... h for leaks a (m,) >= 0."""
    x = a * h
    decay = np.exp(-x)
    safe = np.where(x > 0, a, 1.0)
    phi = np.where(x > 0, -np.expm1(-x) / safe, h)
    twice = np.where(x > 0, -np.expm1(-2.0 * x) / (2.0 * safe), h)
    near, series, term = np.minimum(x, SERIES_BELOW), np.zeros(np.shape(x)), np.full(np.shape(x), 1 / 6)
    for k in range(20):
        series, term = series + term * (2.0 ** (k + 2) - 2.0), term * -near / (k + 4)
    far = np.where(x > SERIES_BELOW, a, 1.0)
    return decay, phi, twice, 0.5 * phi**2, np.where(x > SERIES_BELOW, (h - 2.0 * phi + twice) / far**2, h**3 * series)


def momentum_step(
    x: np.ndarray,
    P: np.ndarray,
    G: np.ndarray,
    u: np.ndarray,
    y: np.ndarray,
    R: np.ndarray,
    h: float,
    Qp: np.ndarray,
    q: np.ndarray,
    a: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return state (n+m,) and covariance (n+m, n+m) after a step of h seconds and a measurement of the momentum.

    Parameters
    ----------
    x, P : state [p; z] and its covariance before the step.
    G : (n, m) what the hidden inputs do to the momentum. u : (n,) the known input, mean over the step.
    y : (n,) measured momentum. R : (n, n) its covariance.
    h : step [s]. Qp : (n,) intensity of the torque error [(N m)^2 s]. q, a : (m,) intensity and leak of the inputs.
    """
    G = read(G, "G", np.shape(G), exact=True)
    n, m = G.shape
    x, P = read(x, "x", (n + m,), exact=True), read(P, "P", (n + m, n + m), exact=True)
    u, y, Qp = (read(v, name, (n,), exact=True) for v, name in ((u, "u"), (y, "y"), (Qp, "Qp")))
    R, q, a = read(R, "R", (n, n), exact=True), read(q, "q", (m,), exact=True), read(a, "a", (m,), exact=True)
    decay, phi, zz, pz, pp = leak_integrals(a, h)
    Phi = np.block([[np.eye(n), G * phi], [np.zeros((m, n)), np.diag(decay)]])
    noise = np.block([[np.diag(Qp * h) + (G * (q * pp)) @ G.T, G * (q * pz)], [(G * (q * pz)).T, np.diag(q * zz)]])
    x = Phi @ x
    x[:n] += h * u
    P = Phi @ P @ Phi.T + noise
    try:
        np.linalg.cholesky(P[:n, :n] + R)
    except np.linalg.LinAlgError:
        raise ShapeError(
            "Expected Qp, q and R that leave the measured momentum a positive covariance, got others. "
            "Give positive variances."
        ) from None
    K = np.linalg.solve(P[:n, :n] + R, P[:n]).T
    A = np.eye(n + m)
    A[:, :n] -= K
    P = A @ P @ A.T + K @ R @ K.T
    return x + K @ (y - x[:n]), 0.5 * (P + P.T)
