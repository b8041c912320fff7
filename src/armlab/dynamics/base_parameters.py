"""Base parameters: the identifiable combinations of link parameters.

``Y pi = Y[:, kept] B pi + D pi``. ``D pi`` is the constant torque of each joint that is indistinguishable from a torque
sensor offset: the weight carried by a vertical prismatic joint, and zero for revolute arms.
docs/theory/identification.md contains the derivation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import flag, members
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.robots import Robot

LINK_SYMBOLS = ("m", "m c_x", "m c_y", "m c_z", "I_xx", "I_xy", "I_yy", "I_xz", "I_yz", "I_zz")
POSITIVE = (0, 4, 6, 9)  # masses and moments of inertia
TOLERANCE = 1e-8  # relative to the largest column or entry
INDEPENDENT = 0.02  # minimum independent fraction of a column: 0 or > 0.5 for nominal arms, plus axis errors [rad]
SEED = 20170101


@dataclass(frozen=True, eq=False, repr=False)
class BaseParameters(Shown):
    """Identifiable parameter combinations of a robot.

    Attributes
    ----------
    names : names of the p base parameters, each stating its combination of link parameters.
    units : units of the p base parameters: kg, kg m or kg m^2.
    kept : (p,) columns of the regressor [links (10 n), rotors (n)] that represent the base parameters.
    B : (p, 11 n) map from link parameters and rotors pi to base parameters, ``base = B @ pi``.
    lift : (11 n, p) map from base parameters to the minimum-norm pi with ``D pi = 0``.
    D : (n, 11 n) map from pi to the constant torque contained in the offset of each joint.
    offset_names : names of the n offsets, each listing the masses that contribute.
    seen : (n, p) mask of the base parameters that affect the torque of each joint.
    quasi_static : whether only the gravity parameters are included.
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
        """Return link parameters (n, 10) and rotor inertias (n,) that reproduce base parameters (p,) exactly."""
        pi = self.lift @ base
        n = len(pi) // 11
        return pi[: 10 * n].reshape(n, 10), pi[10 * n :]

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds (p,): 0 for sums of masses, moments of inertia and rotors, -inf for the other parameters."""
        n = self.B.shape[1] // 11
        positive = np.array([c >= 10 * n or c % 10 in POSITIVE for c in range(11 * n)])
        sums = np.all((self.B == 0) | ((self.B > 0) & positive), axis=1)
        return np.where(sums, 0.0, -np.inf)


def base_parameters(robot: Robot, *, quasi_static: bool = False, joints: Sequence[int] | None = None) -> BaseParameters:
    """Return the base parameters of `robot`, including rotor inertias.

    The regressor is evaluated at 50 n random states (fixed seed), and its columns are scaled to norm 1. A column is
    independent if more than 2 % of it lies outside the span of the preceding columns. The axis errors of a calibrated
    arm stay below this threshold, so they add no parameters. Columns are ordered as offsets, first moments and inertias
    from base to tip, rotors, and masses. Names therefore read ``m c_x2 + 0.2465 m3``, as in the literature.

    Parameters
    ----------
    robot : robot description, including gravity.
    quasi_static : whether to include only the gravity parameters (masses, first moments), which slow motion excites.
    joints : numbers (from 0) of the joints with measured torque; default: all.

    Raises
    ------
    RobotError : `robot` is not a `Robot`.
    UnknownName : a joint number is out of range.

    References
    ----------
    Gautier, M. (1991), Numerical calculation of the base inertial parameters of robots.
    """
    measured, n = measured_joints(robot, joints), len(robot.joint_names)
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


def _random_regressor(robot: Robot, quasi_static: bool) -> np.ndarray:
    """Return the columns (50 n, n, 12 n) of links, rotors and offsets at random states."""
    n = len(robot.joint_names)
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
        for _ in range(2):  # two passes give orthogonality to rounding error
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
    numbers = range(1, len(robot.joint_names) + 1)
    return [f"{symbol}{i}" for i in numbers for symbol in LINK_SYMBOLS] + [f"rotor{i}" for i in numbers]


def _unit(column: int, n: int) -> str:
    return ("kg", *["kg m"] * 3, *["kg m^2"] * 6)[column % 10] if column < 10 * n else "kg m^2"


def _combination(row: np.ndarray, names: list[str], leader: str, own: int = -1) -> str:
    """Return a parameter name: leading symbol plus dependent symbols, with coefficients rounded to six digits."""
    others = [c for c in np.flatnonzero(row) if c != own]
    terms = [f"{'-' if row[c] < 0 else '+'} {abs(row[c]):.6g} {names[c]}" for c in others]
    return " ".join([leader, *terms]).replace(" 1 ", " ")


def measured_joints(robot: Robot, joints: Sequence[int] | None = None) -> list[int]:
    """Return the selected joints (from 0) in ascending order; default: all."""
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    n = len(robot.joint_names)
    given = range(n) if joints is None else members(joints, f"joint indices from 0 to {n - 1}", UnknownName)
    found = sorted({int(one) for one in given if isinstance(one, int | np.integer)} & {*range(n)})
    if not found or len(found) != len(given):
        raise UnknownName(
            f"Expected distinct joint numbers from 0 to {n - 1}, got {[*given]}. Count from 0, or omit the numbers to "
            "select all joints."
        )
    return found


def regressor(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the regressor Y (..., n, 10 n) of the link parameters: ``inverse_dynamics = Y(q, qd, qdd) pi``.

    The regressor does not depend on the masses. Columns have the order of `Robot.inertias`, link by link: m, m c (3),
    Ixx, Ixy, Iyy, Ixz, Iyz, Izz.

    Parameters
    ----------
    robot : the arm; masses are not needed.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    qdd : (..., n) joint accelerations [rad/s^2 or m/s^2].
    out : (..., n, 10 n) array for the result; default: newly allocated.

    Raises
    ------
    RobotError : if `robot` is not a `Robot`.
    ShapeError : if shapes are wrong or do not broadcast.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    return robot.chain.rigid_regressor(q, qd, qdd, robot.gravity, out)


def base_regressor(
    robot: Robot,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    base: BaseParameters,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Return the regressor (..., n, p) of the base parameters: ``tau = Y_b(q, qd, qdd) (base.B pi) + base.D pi``.

    The columns are independent; rotor columns contain qdd.

    Parameters
    ----------
    robot : the arm; masses are not needed.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    qdd : (..., n) joint accelerations [rad/s^2 or m/s^2].
    base : `base_parameters(robot)`; its `names` are the column names.
    out : (..., n, p) array for the result; default: newly allocated.

    Raises
    ------
    RobotError : if `robot` is not a `Robot`.
    ShapeError : if shapes are wrong or do not broadcast.
    """
    Y = regressor(robot, q, qd, qdd)
    if not isinstance(base, BaseParameters) or base.B.shape[1] != 11 * robot.n:
        raise ShapeError(
            f"Expected base parameters for {robot.n} joints, got base parameters of another robot. Call "
            "base_parameters(robot)."
        )
    links = base.kept < 10 * robot.n
    Y = np.take(Y, np.where(links, base.kept, 0), axis=-1, out=out)
    Y[..., ~links] = 0.0
    for k in np.flatnonzero(~links):
        joint = base.kept[k] - 10 * robot.n
        Y[..., joint, k] = np.asarray(qdd)[..., joint]
    return Y
