"""Base parameters: the combinations of link parameters that motion can tell apart.

The regressor of an arm, ``Y pi`` with 10 parameters per link and one rotor inertia per joint, has dependent columns. A
pivoted QR in a fixed physical order (Gautier 1991) keeps the first independent columns and expresses the others by
them:

    Y pi = Y[:, kept] B pi + D pi,      B = [I, K] in the order of the columns

so ``B pi`` are the base parameters, and ``lift @ base`` is the smallest pi with the same torque. D pi is the constant
torque of each joint that looks like the offset of its sensor: the weight of what a vertical slide carries,
and nothing for arms that turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab._numbers import flag, members
from armlab.errors import RobotError, UnknownName
from armlab.robots import Robot

LINK_SYMBOLS = ("m", "m c_x", "m c_y", "m c_z", "I_xx", "I_xy", "I_yy", "I_xz", "I_yz", "I_zz")
POSITIVE = (0, 4, 6, 9)  # masses and moments of inertia
TOLERANCE = 1e-8
INDEPENDENT = 0.02  # of a column: above half or nothing as drawn; a calibrated arm adds what its axes are off [rad]
SEED = 20170101


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The identifiable combinations of one robot.

    `names`: of the p base parameters, with the combination they stand for. `units`: kg, kg m or kg m^2 each. `kept`:
    (p,) columns of the regressor [links (10 n), rotors (n)] that carry them. `B`: (p, 11 n) base = B @ pi. `lift`: (11
    n, p) the smallest pi for given base parameters, with D pi = 0. `D`: (n, 11 n) constant torque of each joint that
    counts as its offset. `offset_names`: (n,) of the offsets, with the masses that count there. `seen`: (n, p) which
    base parameters act on which joint.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kept: np.ndarray
    B: np.ndarray
    lift: np.ndarray
    D: np.ndarray
    offset_names: tuple[str, ...]
    seen: np.ndarray
    quasi_static: bool

    def links_and_rotors(self, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return link parameters (n, 10) and rotor inertias (n,) that evaluate the base parameters (p,) exactly."""
        pi = self.lift @ base
        n = len(pi) // 11
        return pi[: 10 * n].reshape(n, 10), pi[10 * n :]

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds (p,): 0 for sums of masses, moments of inertia and rotors, -inf for the others."""
        n = self.B.shape[1] // 11
        positive = np.array([c >= 10 * n or c % 10 in POSITIVE for c in range(11 * n)])
        sums = np.all((self.B == 0) | ((self.B > 0) & positive), axis=1)
        return np.where(sums, 0.0, -np.inf)


def base_parameters(robot: Robot, *, quasi_static: bool = False, joints: Sequence[int] | None = None) -> BaseParameters:
    """Return the base parameters of `robot`, rotor inertias included.

    The regressor is evaluated at 50 n random states (fixed seed); columns are scaled to norm 1. A column counts as
    independent when its part outside the span of the columns before it exceeds 2 %: less is what axes that are nearly
    perpendicular or parallel, as of a calibrated arm, add to those of an ideal one. Offsets come first, then first
    moments and inertias from base to tip, rotors, and masses last: so a name reads ``m c_x2 + 0.2465 m3``, as in the
    literature.

    Parameters
    ----------
    robot : frozen description; its gravity counts.
    quasi_static : of gravity alone, as slow motion shows it: masses and first moments.
    joints : whose torque is measured; all when left out.

    Raises
    ------
    RobotError : something else than a robot. UnknownName : no such joint.

    References
    ----------
    Gautier, M. (1991), Numerical calculation of the base inertial parameters of robots.
    """
    measured, n = measured_joints(robot, joints), robot.n
    A = _random_regressor(robot, quasi_static)
    norms = np.abs(A[:, :, : 11 * n]).max()
    A = A[:, measured]
    order = [11 * n + joint for joint in measured]
    order += [10 * link + j for link in range(n) for j in range(1, 10)]
    order += [10 * n + joint for joint in range(n)] + [10 * link for link in range(n)]
    kept, B = _independent(A.reshape(-1, 12 * n), np.array(order))
    own = kept < 11 * n
    D = np.zeros((n, 11 * n))
    D[kept[~own] - 11 * n] = B[~own, : 11 * n]
    B, kept = B[own, : 11 * n], kept[own]
    names = _column_names(robot)
    offsets = [f"offset {joint}" for joint in robot.joint_names]
    seen = np.zeros((n, len(kept)), dtype=bool)
    seen[measured] = np.abs(A[:, :, kept]).max(axis=0) > TOLERANCE * norms
    held = D[np.any(D != 0, axis=1)]
    return BaseParameters(
        names=tuple(_combination(B[row], names, names[leader], leader) for row, leader in enumerate(kept)),
        units=tuple(_unit(column, n) for column in kept),
        kept=kept,
        B=B,
        lift=np.linalg.pinv(np.vstack([B, held]))[:, : len(kept)],
        D=D,
        offset_names=tuple(_combination(D[i], names, offsets[i]) for i in range(n)),
        seen=seen,
        quasi_static=quasi_static,
    )


def measured_joints(robot: Robot, joints: Sequence[int] | None = None) -> list[int]:
    """Return the numbers of the joints that are meant, ascending; all when left out.

    `joints`: numbers from 0.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    given = (
        range(robot.n) if joints is None else members(joints, f"numbers of joints from 0 to {robot.n - 1}", UnknownName)
    )
    found = sorted({int(one) for one in given if isinstance(one, int | np.integer)} & {*range(robot.n)})
    if not found or len(found) != len(given):
        raise UnknownName(
            f"Expected numbers of joints from 0 to {robot.n - 1}, each once, got {[*given]}. "
            "Count from 0, or leave them out for all."
        )
    return found


def _random_regressor(robot: Robot, quasi_static: bool) -> np.ndarray:
    """Return the columns (50 n, n, 12 n) of links, rotors and offsets at random states."""
    n = robot.n
    quasi_static = flag(quasi_static, "quasi_static")
    rng = np.random.default_rng(SEED)
    q = rng.uniform(-np.pi, np.pi, (50 * n, n))
    qd, qdd = rng.uniform(-2, 2, (2, 50 * n, n)) * (0.0 if quasi_static else 1.0)
    own = np.zeros((2, 50 * n, n, n))
    own[0][:, range(n), range(n)] = qdd
    own[1][:, range(n), range(n)] = 1.0
    return np.concatenate([robot.chain.rigid_regressor(q, qd, qdd, robot.gravity), *own], axis=2)


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
        if size > INDEPENDENT:
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


def _unit(column: int, n: int) -> str:
    return ("kg", *["kg m"] * 3, *["kg m^2"] * 6)[column % 10] if column < 10 * n else "kg m^2"


def _combination(row: np.ndarray, names: list[str], leader: str, own: int = -1) -> str:
    """Write a parameter as its leading symbol and what moves with it, coefficients rounded to six digits."""
    others = [c for c in np.flatnonzero(row) if c != own]
    terms = [f"{'-' if row[c] < 0 else '+'} {abs(row[c]):.6g} {names[c]}" for c in others]
    return " ".join([leader, *terms]).replace(" 1 ", " ")
