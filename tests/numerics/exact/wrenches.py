"""Tables of the wrench of one instant, by every method.

The most probable wrench is the root of the gradient of its cost. Clipping is the iteration that it is said to be, with
as many steps as its own gradient asks for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mpmath import mp
from rigid import array, exact

Table = dict[str, Any]
Vector = Any
KKT_GOAL = mp.mpf(1e-10)  # where clipping stops
Problem = tuple[mp.matrix, Vector, Vector, Vector, Vector]  # A, error, variance, bound, prior


def beyond(error: Vector, A: mp.matrix, x: Vector, bound: Vector) -> list[Any]:
    """Return what of each residual its bound does not explain."""
    return [mp.sign(r) * max(abs(r) - b, mp.zero) for r, b in zip(error - A.T * x, bound)]


def information(A: mp.matrix, variance: Vector, prior: Vector, joints: list[int]) -> mp.matrix:
    """Return what some joints and the prior say of the wrench."""
    known = mp.diag([1 / p for p in prior])
    return sum((A[:, i] * A[:, i].T / variance[i] for i in joints), known)


def probable(A: mp.matrix, error: Vector, variance: Vector, bound: Vector, prior: Vector) -> tuple[Vector, mp.matrix]:
    """Return the most probable x and its covariance: Newton until the joints beyond their bounds stay the same."""
    x, every = mp.zeros(A.rows, 1), range(A.cols)
    P = mp.zeros(A.rows)
    for _ in range(50):
        over = beyond(error, A, x, bound)
        P = mp.inverse(information(A, variance, prior, [i for i in every if over[i]]))
        pull = [-x[a] / prior[a] + mp.fsum(A[a, i] * over[i] / variance[i] for i in every) for a in range(A.rows)]
        x += P * mp.matrix(pull)
    if mp.norm(mp.matrix(pull)) > mp.mpf(10) ** -50:
        raise ValueError("no minimum")
    return x, P


def linear(A: mp.matrix, error: Vector, variance: Vector, _: Vector, prior: Vector) -> tuple[Vector, mp.matrix]:
    """Return the most probable x and its covariance where no error has a bound."""
    P = mp.inverse(information(A, variance, prior, list(range(A.cols))))
    return P * A * mp.matrix([e / v for e, v in zip(error, variance)]), P


def printed(A: mp.matrix, error: Vector, variance: Vector, _: Vector, prior: Vector) -> tuple[Vector, mp.matrix]:
    """Return x and its covariance with the variance in the place of its inverse, as TFRT-7651 prints it."""
    V, C = mp.diag(list(variance)), mp.diag(list(prior))
    K = mp.inverse(A * V * A.T + mp.inverse(C)) * A * V
    rest = mp.eye(A.rows) - K * A.T
    return K * error, rest * C * rest.T + K * V * K.T


def clipped(A: mp.matrix, error: Vector, variance: Vector, bound: Vector, prior: Vector) -> tuple[Vector, mp.matrix]:
    """Return x and its covariance where ``d <- clip(error - A'x); x <- map(error - d)`` stops."""
    every, x, least = range(A.cols), mp.zeros(A.rows, 1), mp.inf
    gain = mp.inverse(information(A, variance, prior, list(every))) * A * mp.diag([1 / v for v in variance])
    for _ in range(3000):
        over = beyond(error, A, x, bound)
        slope = [x[a] / prior[a] - mp.fsum(A[a, i] * over[i] / variance[i] for i in every) for a in range(A.rows)]
        least, last = max(abs(s * mp.sqrt(p)) for s, p in zip(slope, prior)), least
        if least < KKT_GOAL:
            if min(last / KKT_GOAL, KKT_GOAL / max(least, mp.mpf(10) ** -70)) < 1.001:
                raise ValueError("doubles may stop elsewhere")
            return x, mp.inverse(information(A, variance, prior, [i for i in every if over[i]]))
        x = gain * (A.T * x + mp.matrix(over))
    raise ValueError("clipping takes too long")


METHODS: dict[str, Callable[..., tuple[Vector, mp.matrix]]] = {
    "map": linear,
    "bounded": probable,
    "clip": clipped,
    "interval": probable,
    "ls": lambda A, e, v, b, p: linear(A, e, v, b, p * mp.inf),
    "lund": printed,
}


def problems() -> dict[str, tuple[str, dict[str, np.ndarray]]]:
    """Return problems with the methods that they are for."""
    rng = np.random.default_rng(67)

    def drawn(k: int, n: int) -> dict[str, np.ndarray]:
        return {
            "A": rng.normal(size=(k, n)), "error": rng.normal(size=n), "variance": rng.uniform(0.01, 1, n),
            "bound": rng.uniform(0, 0.5, n), "prior": np.array([100.0, 100, 100, 1, 1, 1])[:k],
        }  # fmt: skip

    found = {"regular": ("map bounded interval ls lund", drawn(6, 7)), "point": ("map bounded ls lund", drawn(3, 7))}
    found["few joints"] = ("map bounded lund", drawn(6, 3))
    found["uneven"] = ("bounded ls", drawn(3, 5))
    found["uneven"][1]["variance"][:] = [1e-3, 1.0, 1e3, 1e-2, 1e300]
    found["uneven"][1]["prior"] = np.array([1e4, 1.0, 1e-4])
    found["singular"] = ("map bounded lund", drawn(3, 4))
    found["singular"][1]["A"][2] = found["singular"][1]["A"][1]
    found["within"] = ("bounded clip", drawn(3, 4))
    found["within"][1]["bound"] = np.abs(found["within"][1]["error"]) + np.array([0.0, 1e-12, 1.0, 1e100])
    found["weak prior"] = ("clip", drawn(6, 7))
    found["strong prior"] = ("bounded clip", drawn(3, 4))
    found["weak prior"][1]["prior"] = np.array([10.0, 10, 10, 1, 1, 1])
    found["strong prior"][1]["prior"] = np.array([0.1, 1e-3, 1e-12])
    return found


def tables() -> dict[str, Table]:
    """Return the wrench, its covariance, and the joints beyond their bounds."""
    found: dict[str, Table] = {}
    for problem, (methods, given) in problems().items():
        numbers = [exact(value) for value in given.values()]
        for method in methods.split():
            x, P = METHODS[method](*numbers)
            for part, wanted in enumerate((array(x), array(P))):
                found[f"solve_wrench {method} {part} {problem}"] = {"given": given, "wanted": wanted[None]}
    return found
