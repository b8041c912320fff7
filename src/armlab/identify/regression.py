"""The linear regression behind `fit_dynamics`: base parameters of the rigid body, and columns of each joint's own.

Base-parameter columns are shared by all joints; each joint has its own: viscous, Coulomb, offset, Stribeck, root and
load where they win (`armlab.identify.friction_structure`), and, where the gears are known, cosine and sine of the
ripple line at twice the gear ratio (strain-wave gears press twice per input turn). A robot file that is silent about
the gears has ratio 1: such a line would be a harmonic of gravity and is left out.

A motor that moves several joints, as in wrists, brings three shared columns: its angle is ``theta = c q``, and its
inertia, viscous and Coulomb friction act on all of them, ``tau = c^T f(theta)``.

All columns are filtered and decimated in blocks: at the full rate none exists for the whole record, which would not
fit into memory beside its filtered copy.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, pairwise

import numpy as np

from armlab._numbers import flag
from armlab.estimation import Rows
from armlab.identify.friction_structure import (
    COLUMNS,
    FIXED,
    FOLDS,
    FRICTION,
    SHAPED,
    Chooser,
    FrictionColumns,
    FrictionStructure,
    StructureChoice,
    choose_here,
    mixing,
    term_names,
)
from armlab.identify.record import ORDER, Decimation, Record, measured_joints, slow_enough
from armlab.models.friction import FRICTION_TERMS, Friction, FrictionTerm, Ripple
from armlab.models.torque import CoupledMotors
from armlab.robots import Robot

# Base parameters: the combinations of link parameters that motion can tell apart, ``Y pi = Y[:, kept] B pi + D pi``. D
# pi is the constant torque of each joint that looks like the offset of its sensor: the weight of what a vertical slide
# carries, and nothing for arms that turn. Theory: docs/theory/identification.md.


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
    numbers = range(1, len(robot.joint_names) + 1)
    return [f"{symbol}{i}" for i in numbers for symbol in LINK_SYMBOLS] + [f"rotor{i}" for i in numbers]


def _unit(column: int, n: int) -> str:
    return ("kg", *["kg m"] * 3, *["kg m^2"] * 6)[column % 10] if column < 10 * n else "kg m^2"


def _combination(row: np.ndarray, names: list[str], leader: str, own: int = -1) -> str:
    """Write a parameter as its leading symbol and what moves with it, coefficients rounded to six digits."""
    others = [c for c in np.flatnonzero(row) if c != own]
    terms = [f"{'-' if row[c] < 0 else '+'} {abs(row[c]):.6g} {names[c]}" for c in others]
    return " ".join([leader, *terms]).replace(" 1 ", " ")


# Columns of a regression over joint torque, filtered and decimated.


MIN_CYCLES = 20.0  # rad/rad; a slower ripple line is a harmonic of gravity
SEEN = 0.5  # share of the samples at which a ripple line must not fold back
SMOOTH = 0.02  # rad/s, of the sign of coupled motors


@dataclass(frozen=True, eq=False)
class RegressionColumns:
    """Makes the columns of J joints of a record.

    `decimation`: of its rows; (M,) are kept. `joints`: (J,) those whose torque counts. `motors`: (K, n)
    angles theta = c q of motors that move several joints. `geared`: whether there are columns of ripple. `load`: (N, J)
    torque |x| that goes to the links, at full rate; zero until a solution gives one.
    """

    data: Record
    decimation: Decimation
    robot: Robot
    joints: np.ndarray
    motors: np.ndarray
    geared: bool
    load: np.ndarray

    @property
    def cycles(self) -> np.ndarray:
        """Ripple line of each joint (J,) [rad/rad]: strain-wave gears press twice per input turn."""
        return 2.0 * np.abs(np.diag(np.linalg.inv(self.robot.coupling)))[self.joints]

    @property
    def friction(self) -> FrictionColumns:
        data, joints = self.data, self.joints
        return FrictionColumns(
            self.decimation, data.q[:, joints], data.qd[:, joints], data.resolution[joints], self.load
        )

    def plain(self, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what has neither friction structure nor base parameters, given the acceleration (N, n).

        Torque (M, J); columns (M, J, 2 or 4): viscous, offset, and ripple where it is seen; acceleration, velocity and
        smooth sign (M, K, 3) of the coupled motors.
        """
        data, joints, cycles = self.data, self.joints, self.cycles
        J, K = len(joints), len(self.motors)

        def columns(a: int, b: int) -> np.ndarray:
            qd = data.qd[a:b, joints]
            parts = [data.tau[a:b, joints], qd, np.ones_like(qd)]
            if self.geared:
                slow, angle = slow_enough(qd, data.rate, cycles), cycles * data.q[a:b, joints]
                parts += [np.where(slow, np.cos(angle), 0.0), np.where(slow, np.sin(angle), 0.0)]
            return np.concatenate([*parts, qdd[a:b] @ self.motors.T, data.qd[a:b] @ self.motors.T], axis=1)

        fixed = len(FIXED) if self.geared else len(FIXED) - 2
        thin = self.decimation.run(columns, J * (1 + fixed) + 2 * K)
        tau, own, coupled = np.split(thin, [J, J * (fixed + 1)], axis=1)
        own = np.moveaxis(own.reshape(len(thin), fixed, J), 1, 2)
        sign = self.decimation.run(lambda a, b: np.tanh(data.qd[a:b] @ self.motors.T / SMOOTH), K)
        return tau, own, np.moveaxis(np.concatenate([coupled, sign], axis=1).reshape(len(thin), 3, K), 1, 2)

    def rigid_columns(self, qdd: np.ndarray, base: BaseParameters) -> tuple[np.ndarray, ...]:
        """Return of each joint the columns (M, w) of the base parameters that it sees, at the acceleration (N, n)."""
        data, robot, n = self.data, self.robot, len(self.robot.joint_names)
        seen = [base.kept[base.seen[i]] for i in self.joints]
        edges = np.cumsum([0, *(len(kept) for kept in seen)])
        flat = np.concatenate([np.where(kept < 10 * n, 10 * n * i + kept, 0) for i, kept in zip(self.joints, seen)])
        rotors = [(edges[i] + k, column - 10 * n) for i, kept in enumerate(seen) for k, column in enumerate(kept)]
        rotors = [(position, joint) for position, joint in rotors if joint >= 0]

        def columns(a: int, b: int) -> np.ndarray:
            moves = 0.0 if base.quasi_static else 1.0
            Y = robot.chain.rigid_regressor(data.q[a:b], moves * data.qd[a:b], moves * qdd[a:b], robot.gravity)
            X = np.take(Y.reshape(b - a, -1), flat, axis=1)
            for position, joint in rotors:
                X[:, position] = qdd[a:b, joint]
            return X

        thin = self.decimation.run(columns, int(edges[-1]))
        return tuple(thin[:, edges[i] : edges[i + 1]] for i in range(len(self.joints)))

    def shaped(self, delta: np.ndarray, smooth: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Return the columns (M, J, 4 + S) of a sign with delta, smooth (J,), then Stribeck of each speed (S, J)."""
        friction = self.friction
        return friction.columns(friction.sign(delta, smooth), speeds)

    def lines_are_seen(self) -> bool:
        """Tell whether ripple passes slowly enough for the sampling in most samples; warn where it does not."""
        data = self.data
        share = np.mean(slow_enough(data.qd[:, self.joints], data.rate, self.cycles), axis=0)
        fast = [self.robot.joint_names[joint] for joint, seen in zip(self.joints, share) if seen < SEEN]
        if fast:
            warnings.warn(
                f"Expected torque ripple below {data.rate / 4.0:.3g} Hz, a quarter of the sampling rate, in half of "
                f"the samples at least, got faster ripple for {', '.join(fast)}: it folds back, and no ripple is "
                "fitted. Log slower motion, as of identify.friction_run, or sample faster.",
                stacklevel=3,
            )
        return not fast


# Where the parameters of `fit_dynamics` stand: base, then each joint's own, then those of coupled motors.


COUPLED = {"rotor": "kg m^2", "viscous": "N m s/rad", "coulomb": "N m"}  # of a motor that moves several joints


@dataclass(frozen=True, eq=False)
class ParameterLayout:
    """Names, units, bounds and places of p parameters.

    `joints`: (J,) those whose torque counts. `motors`: (K, n) angles theta = c q of motors that move several joints.
    `owners`: (K,) the joint each belongs to.
    """

    robot: Robot
    base: BaseParameters
    joints: np.ndarray
    motors: np.ndarray
    owners: np.ndarray
    terms: tuple[tuple[str, ...], ...]

    @property
    def columns(self) -> list[np.ndarray]:
        """Which parameters the columns of each joint belong to: base, own, coupled motors."""
        counts = [len(terms) for terms in self.terms]
        first = len(self.base.names) + np.concatenate([[0], np.cumsum(counts)])
        out = []
        for i, joint in enumerate(self.joints):
            moved = np.flatnonzero(self.motors[:, joint])
            coupled = first[-1] + (3 * moved[:, None] + np.arange(3)).ravel()
            out.append(np.concatenate([np.flatnonzero(self.base.seen[joint]), np.arange(*first[i : i + 2]), coupled]))
        return out

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: base, own of each joint, coupled motors."""
        own = []
        for i, terms in zip(self.joints, self.terms):
            plain = {"offset": self.base.offset_names[i]}
            own += [plain.get(term, f"{term} {self.robot.joint_names[i]}") for term in terms]
        motors = [f"{term} of motor {self.robot.joint_names[i]}" for i in self.owners for term in COUPLED]
        return (*self.base.names, *own, *motors)

    @property
    def heads(self) -> list[str]:
        """Names without the combination that base parameters stand for, which fills a line."""
        return [re.split(r" [+-] ", name)[0] for name in self.names]

    @property
    def units(self) -> tuple[str, ...]:
        """Units of all parameters."""
        own = []
        for i, terms in zip(self.joints, self.terms):
            own += [_term(term).units(bool(self.robot.prismatic[i])) for term in terms]
        return (*self.base.units, *own, *[*COUPLED.values()] * len(self.motors))

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds of all parameters: 0 for inertia, viscous and Coulomb friction, else -inf."""
        own = [_term(term).least for terms in self.terms for term in terms]
        return np.concatenate([self.base.lower, own, np.zeros(len(COUPLED) * len(self.motors))])

    @property
    def upper(self) -> np.ndarray:
        """Upper bounds of all parameters: that of the friction of the load, else inf."""
        own = [_term(term).most for terms in self.terms for term in terms]
        rest = np.full(len(COUPLED) * len(self.motors), np.inf)
        return np.concatenate([np.full(len(self.base.names), np.inf), own, rest])

    @property
    def slopes(self) -> np.ndarray:
        """Which parameters (p,) are steps of the logarithm of a number of the structure of friction."""
        own = [_term(term).column is None for terms in self.terms for term in terms]
        return np.array([False] * len(self.base.names) + own + [False] * len(COUPLED) * len(self.motors))


def _term(name: str) -> FrictionTerm:
    """Return the term of a column; amplitudes of ripple have the unit and the bound of an offset."""
    return FRICTION_TERMS.get(name, FRICTION_TERMS["offset"])


AT_ONCE = 8192  # rows handed to the solver


@dataclass(frozen=True, eq=False)
class DesignRows:
    """Rows of a design for the solver, joint by joint; reading it again makes them again.

    `block`: (M,) number of the block of time of each row. `trust`: (M, J) weights of the rows, None for 1.
    """

    design: Design
    block: np.ndarray
    trust: np.ndarray | None

    def __iter__(self) -> Iterator[Rows]:
        design = self.design
        for i, columns in enumerate(design.layout.columns):
            for a in range(0, len(self.block), AT_ONCE):
                part = slice(a, a + AT_ONCE)
                A, y = np.hstack([design.rigid[i][part], design.local[i][part]]), design.tau[part, i]
                if self.trust is not None:
                    A, y = A * self.trust[part, i, None], y * self.trust[part, i]
                yield Rows(A, y, self.block[part], i, columns)


CUTOFF = 25.0  # Hz, the most; a tenth of the rate where that is less
PAD = 20  # rows by which a segment is continued at its ends
BLOCK = 0.5  # s, blocks that go to the folds in turn for the choice of the structure
STEP = 0.01  # of the logarithm of a number of the shape, for its derivative
LONGEST = 0.5  # step of such a logarithm
NOTHING = 1e-12  # of the power of the torque: a slope without effect


@dataclass(frozen=True, eq=False)
class Design(RegressionColumns):
    """Filtered and decimated regression problem of J joints.

    `owners`: (K,) the joint that each coupled motor belongs to. `gains`: (J,) torque as it is read over true torque.
    `tau`: (M, J) filtered torque, divided by them. `rigid`: of each joint (M, w), columns of the base parameters that
    it sees. `fixed`: (M, J, 2 or 4) columns without shape: viscous, offset, and ripple where the gears are known.
    `coupled_motors`: (M, K, 3) filtered acceleration, velocity and sign of the coupled motors. `free`: (J, 2) bool,
    which of `FrictionStructure.numbers` have a column: the derivative of the torque over the logarithm of the number,
    at the parameters given to `with_slopes`. `local`: of each joint (M, k) columns of its own, slopes of its shape
    last, then of the motors that move it.
    """

    base: BaseParameters
    owners: np.ndarray
    gains: np.ndarray
    tau: np.ndarray
    rigid: tuple[np.ndarray, ...]
    fixed: np.ndarray
    coupled_motors: np.ndarray
    structure: FrictionStructure
    free: np.ndarray
    local: tuple[np.ndarray, ...] = ()

    @classmethod
    def build(
        cls,
        data: Record,
        robot: Robot,
        base: BaseParameters,
        *,
        cutoff: float | None = None,
        every: int | None = None,
        joints: Sequence[int] | None = None,
        structure: FrictionStructure | None = None,
        geared: bool | None = None,
    ) -> Design:
        """Filter and thin all columns."""
        corner = min(data.rate / 10.0, CUTOFF) if cutoff is None else cutoff
        step = max(1, int(data.rate / (2.5 * corner))) if every is None else every
        measured = np.arange(len(robot.joint_names)) if joints is None else np.asarray(joints)
        ratios = np.linalg.inv(robot.coupling)
        turning = ratios / np.diag(ratios)[:, None]
        owners = np.flatnonzero(np.count_nonzero(turning, axis=1) > 1)
        unloaded = np.zeros((len(data.t), len(measured)))
        thin = Decimation.of(data, corner, step)
        columns = RegressionColumns(data, thin, robot, measured, turning[owners], False, unloaded)
        if geared or (geared is None and not np.any(columns.cycles < MIN_CYCLES) and columns.lines_are_seen()):
            columns = replace(columns, geared=True)
        qdd = data.differentiate(data.qd)
        tau, fixed, coupled = columns.plain(qdd)
        design = cls(
            **vars(columns),
            base=base,
            owners=owners,
            gains=np.ones(len(measured)),
            tau=tau,
            rigid=columns.rigid_columns(qdd, base),
            fixed=fixed,
            coupled_motors=coupled,
            structure=structure or FrictionStructure.start(len(measured)),
            free=np.zeros((len(measured), 2), dtype=bool),
        )
        return design.with_structure(design.structure)

    @property
    def rows(self) -> np.ndarray:
        """Rows of the record that are kept (M,)."""
        return self.decimation.rows

    @cached_property
    def terms(self) -> list[tuple[str, ...]]:
        """Names of the columns of each joint's own."""
        kinds = zip(self.structure.terms, self.structure.names, self.free)
        return [(*term_names(terms, self.geared), *compress(names, free)) for terms, names, free in kinds]

    @cached_property
    def layout(self) -> ParameterLayout:
        """Names, units, bounds and places of all parameters."""
        return ParameterLayout(self.robot, self.base, self.joints, self.motors, self.owners, tuple(self.terms))

    def own_columns(self, structure: FrictionStructure) -> Iterator[np.ndarray]:
        """Yield of each joint all columns (M, W) of its own, whichever of them a structure of friction has."""
        shaped = self.shaped(structure.delta, structure.smooth, structure.speed[None])
        at = [(*FIXED[: self.fixed.shape[2]], *SHAPED).index(name) for name in COLUMNS[: self._width]]
        for i in range(len(self.joints)):
            yield np.concatenate([self.fixed[:, i], shaped[:, i]], axis=1)[:, at]

    def with_structure(self, structure: FrictionStructure) -> Design:
        """Return it with the columns of another structure of friction."""
        local = []
        for i, (joint, own) in enumerate(zip(self.joints, self.own_columns(structure))):
            own = own @ mixing(structure.terms[i], self._width)
            moved = np.flatnonzero(self.motors[:, joint])
            theirs = (self.motors[m, joint] * self.coupled_motors[:, m] for m in moved)
            local.append(np.hstack([own, *theirs]) if len(moved) else own)
        return replace(self, structure=structure, free=np.zeros_like(self.free), local=tuple(local))

    def smoothed(self, cutoff: float) -> Design:
        """Return it with all columns low-passed once more, in the rows that are kept."""
        from scipy.signal import butter, sosfiltfilt

        sections = butter(ORDER, 2.0 * cutoff * self.decimation.every / self.data.rate, output="sos")
        edges = np.searchsorted(self.rows, [a for a, _ in self.decimation.segments]).tolist()

        def smooth(x: np.ndarray) -> np.ndarray:
            parts = (x[a:b] for a, b in pairwise([*edges, len(x)]))
            return np.concatenate(
                [sosfiltfilt(sections, part, axis=0, padlen=min(PAD, len(part) - 1)) for part in parts]
            )

        own = (tuple(map(smooth, columns)) for columns in (self.rigid, self.local))
        return replace(self, tau=smooth(self.tau), **dict(zip(("rigid", "local"), own)))

    def with_torque(self, tau: np.ndarray) -> Design:
        """Return it with another torque (N, n) that was read."""
        thin = self.decimation.run(lambda a, b: tau[a:b, self.joints], len(self.joints))
        return replace(self, data=replace(self.data, tau=tau), tau=thin / self.gains)

    def with_gains(self, gains: np.ndarray) -> Design:
        """Return it with other gains (J,) of the torque that was read."""
        return replace(self, gains=gains, tau=self.tau * self.gains / gains)

    def with_slopes(self, theta: np.ndarray, free: np.ndarray | None = None) -> Design:
        """Return it with the derivatives of the torque over the logarithms of the numbers that make the structure."""
        slopes = self._slopes(theta)
        power = np.sum(slopes * slopes, axis=0)
        picked = power > NOTHING * np.sum(self.tau * self.tau, axis=0)[:, None] if free is None else free
        local = []
        for i, (L, terms) in enumerate(zip(self.local, self.terms)):
            own = len(terms)
            local.append(np.hstack([L[:, :own], slopes[:, i, picked[i]], L[:, own:]]))
        return replace(self, free=picked, local=tuple(local))

    def _slopes(self, theta: np.ndarray) -> np.ndarray:
        """Return the derivatives (M, J, 2) by central differences."""
        c = self._own(theta)[[COLUMNS.index(name) for name in SHAPED]].T
        up, down, wide, narrow = (
            self.structure.moved(np.tile(step, (len(self.joints), 1)))
            for step in STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        )
        apart, bump = (np.log(a.numbers / b.numbers).sum(axis=1) for a, b in ((up, down), (wide, narrow)))
        more, less = (self.shaped(one.delta, one.smooth, one.speed[None]) for one in (up, down))
        bumps = self.shaped(self.structure.delta, self.structure.smooth, np.stack([wide.speed, narrow.speed]))
        signs = np.einsum("mjk,jk->mj", more - less, c / apart[:, None])
        return np.stack([signs, (bumps[:, :, -2] - bumps[:, :, -1]) * (c[:, -1] / bump)], axis=2)

    def moved(self, theta: np.ndarray) -> FrictionStructure:
        """Return the structure with the steps among parameters theta (p,) taken, each by half at most."""
        steps = np.zeros(self.free.shape)
        steps[self.free] = np.clip(theta[self.layout.slopes], -LONGEST, LONGEST)
        return self.structure.moved(steps)

    def in_units(self, theta: np.ndarray, *covs: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return parameters (p,) and covariances (p, p) with the numbers of the structure in place of their steps."""
        x, scale, at = theta.copy(), np.ones(len(theta)), self.layout.slopes
        x[at] = scale[at] = self.moved(theta).numbers[self.free]
        return x, *(cov * np.outer(scale, scale) for cov in covs)

    def stream(self, block: np.ndarray, trust: np.ndarray | None = None) -> Iterable[Rows]:
        """Return the rows of the problem with numbers of their blocks (M,) and weights (M, J), 1 when left out."""
        return DesignRows(self, block, trust)

    def model(self, theta: np.ndarray) -> np.ndarray:
        """Return the filtered torque (M, J) [N m] of parameters theta (p,)."""
        parts = zip(self.rigid, self.local, self.layout.columns)
        return np.stack([np.hstack([A, L]) @ theta[c] for A, L, c in parts], axis=1)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Return measured minus modelled filtered torque (M, J) [N m]."""
        return self.tau - self.model(theta)

    def drives(self, theta: np.ndarray) -> tuple[Friction, Ripple]:
        """Return friction and ripple of all joints of parameters theta (p,); zero for joints that do not count."""
        values = np.zeros((len(COLUMNS), len(self.robot.joint_names)))
        values[:, self.joints] = self._own(theta)
        found = self.moved(theta)
        filled = np.tile([[1e-3], [0.0], [0.1], [2.0]], values.shape[1])
        filled[:, self.joints] = found.delta, found.smooth, found.speed, self.cycles
        *numbers, cycles = filled
        fields = {FRICTION_TERMS[name].fields[0]: own for name, own in zip(FRICTION, values)}
        fields |= dict(zip(("delta", "smooth_speed", "stribeck_speed"), numbers))
        return Friction(resolution=self.data.resolution, **fields), Ripple(cycles, *values[len(FRICTION) :])

    def _own(self, theta: np.ndarray) -> np.ndarray:
        """Return the parameters of all COLUMNS of each joint (9, J); zero for those that it has not."""
        values = np.zeros((len(COLUMNS), len(self.joints)))
        for i, (columns, A) in enumerate(zip(self.layout.columns, self.rigid)):
            T = mixing(self.structure.terms[i], self._width)
            values[: self._width, i] = T @ theta[columns[A.shape[1] :][: T.shape[1]]]
        return values

    def coupled(self, theta: np.ndarray) -> CoupledMotors | None:
        """Return the motors that move several joints, of parameters theta (p,); None where there are none."""
        K = len(self.motors)
        if not K:
            return None
        inertia, viscous, coulomb = theta[-3 * K :].reshape(K, 3).T
        return CoupledMotors(self.motors, inertia, viscous, coulomb, np.full(K, SMOOTH))

    def load_sd(self, cov: np.ndarray) -> np.ndarray:
        """Return the deviation (J,) of the load friction by the covariance (p, p), NaN where a joint has none."""
        at = {name: k for k, name in enumerate(self.layout.names)}
        known = [at.get(f"load {self.robot.joint_names[joint]}") for joint in self.joints]
        return np.array([np.nan if k is None else np.sqrt(cov[k, k]) for k in known])

    @property
    def _width(self) -> int:
        return len(COLUMNS if self.geared else FRICTION)

    def choose_structure(
        self,
        theta: np.ndarray,
        trust: np.ndarray | None = None,
        chooser: Chooser = choose_here,
        again: bool = False,
    ) -> Design:
        """Choose the structure of friction of each joint on held-out blocks of half a second.

        Of the parameters theta (p,) the base parameters are held, and give the load of the joints. `trust`: (M, J)
        weights of the rows; 0 leaves one out. `again`: begin with the structure that is there, which was chosen before.
        """
        weights = np.ones_like(self.tau) if trust is None else np.asarray(trust, dtype=float)
        used = np.cumsum(weights.any(axis=1))  # blocks of what is used: all folds have as much
        fold = used // max(1, round(BLOCK * self.data.rate / self.decimation.every)) % FOLDS
        loaded = self.with_load(theta)
        motion = loaded.friction

        def choice(i: int) -> StructureChoice:
            A, L, c = self.rigid[i], self.local[i], self.layout.columns[i]
            coupled = L[:, len(self.terms[i]) :]
            free = np.zeros((len(L), 3 * len(self.motors)))
            free[:, : coupled.shape[1]] = coupled
            target = self.tau[:, i] - A @ theta[c[: A.shape[1]]]
            fixed = np.concatenate([self.fixed[:, i], free], axis=1)
            start = self.structure.of(i) if again else None
            return StructureChoice(motion.of(i), fixed, target, fold, weights[:, i], start)

        return loaded.with_structure(FrictionStructure.joined(chooser(map(choice, range(len(self.joints))))))

    def with_load(self, theta: np.ndarray) -> Design:
        """Return it with the load of the joints by the base parameters of theta (p,)."""
        data, moves = self.data, 0.0 if self.base.quasi_static else 1.0
        links, _ = self.base.links_and_rotors(theta[: len(self.base.names)])
        qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
        torque = self.robot.chain.rnea(data.q, moves * data.qd, moves * qdd, self.robot.gravity, links)
        return replace(self, load=np.abs(torque[:, self.joints])).with_structure(self.structure)
