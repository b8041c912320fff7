"""Base parameters: the combinations of link parameters that motion can tell apart.

The regressor of an arm, ``Y pi`` with 10 parameters per link and one rotor inertia per joint, has dependent columns. A
pivoted QR in a fixed physical order (Gautier 1991) keeps the first independent columns and expresses the others by
them:

    Y pi = Y[:, kept] B pi,      B = [I, K] in the order of the columns

so ``B pi`` are the base parameters, and ``lift @ base`` is the smallest pi with the same torque.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.robots import Robot

__all__ = ["BaseParameters", "base_parameters"]

LINK_SYMBOLS = ("m", "m c_x", "m c_y", "m c_z", "I_xx", "I_xy", "I_yy", "I_xz", "I_yz", "I_zz")
TOLERANCE = 1e-8
SEED = 20170101


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The identifiable combinations of one robot.

    Attributes
    ----------
    names : of the p base parameters, with the combination they stand for.
    units : kg, kg m or kg m^2 each.
    kept : (p,) columns of the regressor [links (10 n), rotors (n)] that carry them.
    B : (p, 11 n) base = B @ pi. lift : (11 n, p) the smallest pi for given base parameters.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kept: np.ndarray
    B: np.ndarray
    lift: np.ndarray

    def links_and_rotors(self, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return link parameters (n, 10) and rotor inertias (n,) that evaluate the base parameters (p,) exactly."""
        pi = self.lift @ base
        n = len(pi) // 11
        return pi[: 10 * n].reshape(n, 10), pi[10 * n :]


def base_parameters(robot: Robot) -> BaseParameters:
    """Return the base parameters of `robot`, rotor inertias included.

    The regressor is evaluated at 50 n random states (fixed seed); columns are scaled to norm 1. A column counts as
    independent when its part outside the span of the columns before it exceeds 1e-8. First moments and inertias come
    first, from base to tip, then rotors, then masses: so a name reads ``m c_x2 + 0.2465 m3``, as in the literature.

    Parameters
    ----------
    robot : frozen description; its gravity counts.

    References
    ----------
    Gautier, M. (1991), Numerical calculation of the base inertial parameters of robots.
    """
    n = robot.n
    rng = np.random.default_rng(SEED)
    q = rng.uniform(-np.pi, np.pi, (50 * n, n))
    qd, qdd = rng.uniform(-2, 2, (2, 50 * n, n))
    Y = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity)
    rotor = np.zeros((50 * n, n, n))
    rotor[:, range(n), range(n)] = qdd
    A = np.concatenate([Y, rotor], axis=2).reshape(-1, 11 * n)
    order = [10 * link + j for link in range(n) for j in range(1, 10)]
    order += [10 * n + joint for joint in range(n)] + [10 * link for link in range(n)]
    kept, B = _independent(A, np.array(order))
    names = _column_names(robot)
    texts = tuple(_combination(B[row], kept[row], names) for row in range(len(kept)))
    units = tuple(("kg", *["kg m"] * 3, *["kg m^2"] * 6)[c % 10] if c < 10 * n else "kg m^2" for c in kept)
    return BaseParameters(texts, units, kept, B, np.linalg.pinv(B))


def _independent(A: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the independent columns in `order` and B with ``A = A[:, kept] B``."""
    norms = np.linalg.norm(A, axis=0)
    alive = [c for c in order if norms[c] > TOLERANCE * norms.max()]
    basis = np.zeros((A.shape[0], 0))
    kept = []
    for column in alive:
        v = A[:, column] / norms[column]
        for _ in range(2):  # twice is enough for orthogonality to rounding
            v = v - basis @ (basis.T @ v)
        size = np.linalg.norm(v)
        if size > TOLERANCE:
            kept.append(column)
            basis = np.column_stack([basis, v / size])
    kept_array = np.array(kept)
    B = np.zeros((len(kept), A.shape[1]))
    B[:, alive] = np.linalg.lstsq(A[:, kept_array], A[:, alive], rcond=None)[0]
    B[np.abs(B) < TOLERANCE] = 0.0
    B[range(len(kept)), kept_array] = 1.0
    return kept_array, B


def _column_names(robot: Robot) -> list[str]:
    links = [f"{symbol}{link + 1}" for link in range(robot.n) for symbol in LINK_SYMBOLS]
    return links + [f"rotor{joint + 1}" for joint in range(robot.n)]


def _combination(row: np.ndarray, leader: int, names: list[str]) -> str:
    """Write a base parameter as its leading symbol and what moves with it, coefficients rounded to six digits."""
    others = [c for c in np.flatnonzero(row) if c != leader]
    terms = [f"{'-' if row[c] < 0 else '+'} {abs(row[c]):.6g} {names[c]}" for c in others]
    return " ".join([names[leader], *terms]).replace(" 1 ", " ")
