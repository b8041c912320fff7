"""The linear regression behind `fit_dynamics`: filtered, decimated columns of each joint, made in blocks.

Base-parameter columns are shared by all joints; each joint has its own: viscous, Coulomb, offset, Stribeck and root
where they win (`armlab.identify.friction_structure`), and, where the gears are known, cosine and sine of the ripple
line at twice the gear ratio (strain-wave gears press twice per input turn). A robot file that is silent about the
gears has ratio 1: such a line would be a harmonic of gravity and is left out.

A motor that moves several joints, as in wrists, brings three shared columns: its angle is ``theta = c q``, and its
inertia, viscous and Coulomb friction act on all of them, ``tau = c^T f(theta)``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from armlab.estimation import Rows
from armlab.identify.base_parameters import BaseParameters
from armlab.identify.columns import FIXED, SHAPED, SMOOTH, Decimation, RegressionColumns
from armlab.identify.friction_structure import (
    COLUMNS,
    FOLDS,
    FRICTION,
    Chooser,
    FrictionStructure,
    StructureChoice,
    choose_here,
    mixing,
    term_names,
)
from armlab.identify.record import Record
from armlab.models.friction import FRICTION_TERMS, Friction, FrictionTerm, Ripple
from armlab.models.torque import CoupledMotors
from armlab.robots import Robot

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
    def slopes(self) -> np.ndarray:
        """Which parameters (p,) are steps of the logarithm of a number of the structure of friction."""
        own = [_term(term).column is None for terms in self.terms for term in terms]
        return np.array([False] * len(self.base.names) + own + [False] * len(COUPLED) * len(self.motors))


def _term(name: str) -> FrictionTerm:
    """Return the term of a column; amplitudes of ripple have the unit and the bound of an offset."""
    return FRICTION_TERMS.get(name, FRICTION_TERMS["offset"])


# Rows of a regression over joint torque for the solver, joint by joint and in pieces of bounded size.


AT_ONCE = 8192  # rows handed to the solver


@dataclass(frozen=True, eq=False)
class DesignRows:
    """Rows of J joints; reading it again makes them again.

    `tau`: (M, J) torque. `rigid`, `local`: of each joint (M, w) and (M, k), its columns, in this order. `columns`: of
    each joint (w + k,), the parameters that they belong to. `block`: (M,) number of the block of time of each row.
    `trust`: (M, J) weights of the rows, None for 1.
    """

    tau: np.ndarray
    rigid: Sequence[np.ndarray]
    local: Sequence[np.ndarray]
    columns: Sequence[np.ndarray]
    block: np.ndarray
    trust: np.ndarray | None

    def __iter__(self) -> Iterator[Rows]:
        """Yield the rows of one joint after the other."""
        for i, columns in enumerate(self.columns):
            for a in range(0, len(self.block), AT_ONCE):
                part = slice(a, a + AT_ONCE)
                A, y = np.hstack([self.rigid[i][part], self.local[i][part]]), self.tau[part, i]
                if self.trust is not None:
                    A, y = A * self.trust[part, i, None], y * self.trust[part, i]
                yield Rows(A, y, self.block[part], i, columns)


CUTOFF = 25.0  # Hz, the most; a tenth of the rate where that is less
BLOCK = 0.5  # s, blocks that go to the folds in turn for the choice of the structure
STEP = 0.01  # of the logarithm of a number of the shape, for its derivative
LONGEST = 0.5  # step of such a logarithm
NOTHING = 1e-12  # of the power of the torque: a slope without effect


@dataclass(frozen=True, eq=False)
class Design:
    """Filtered and decimated regression problem of J joints.

    `owners`: (K,) the joint that each coupled motor belongs to. `gains`: (J,) torque as it is read over true torque.
    `tau`: (M, J) filtered torque, divided by them. `rigid`: of each joint (M, w), columns of the base parameters that
    it sees. `fixed`: (M, J, 2 or 4) columns without shape: viscous, offset, and ripple where the gears are known.
    `coupled_motors`: (M, K, 3) filtered acceleration, velocity and sign of the coupled motors. `free`: (J, 2) bool,
    which of `FrictionStructure.numbers` have a column: the derivative of the torque over the logarithm of the number,
    at the parameters given to `with_slopes`. `local`: of each joint (M, k) columns of its own, slopes of its shape
    last, then of the motors that move it.
    """

    made: RegressionColumns
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
        """Filter and thin all columns.

        `base`: base parameters of the robot, for the same joints. `cutoff`: of the zero-phase filter [Hz]; a tenth of
        the rate, at most 25 Hz, when left out; infinite for none. `every`: rows from one kept row to the next; 2.5 kept
        rows per period of the cut-off when left out. `joints`: whose torque counts; all when left out. `structure`: of
        friction; presliding over 1e-3 rad when left out. `geared`: whether there are ripple columns.
        """
        corner = min(data.rate / 10.0, CUTOFF) if cutoff is None else cutoff
        step = max(1, int(data.rate / (2.5 * corner))) if every is None else every
        measured = np.arange(robot.n) if joints is None else np.asarray(joints)
        ratios = np.linalg.inv(robot.coupling)
        turning = ratios / np.diag(ratios)[:, None]
        owners = np.flatnonzero(np.count_nonzero(turning, axis=1) > 1)
        columns = RegressionColumns(data, Decimation.of(data, corner, step), robot, measured, turning[owners], geared)
        qdd = data.differentiate(data.qd)
        tau, fixed, inertial = columns.plain(qdd)
        design = cls(
            made=columns,
            base=base,
            owners=owners,
            gains=np.ones(len(measured)),
            tau=tau,
            rigid=columns.rigid(qdd, base),
            fixed=fixed,
            coupled_motors=np.concatenate([inertial, columns.coupled_sign()[:, :, None]], axis=2),
            structure=structure or FrictionStructure.start(len(measured)),
            free=np.zeros((len(measured), 2), dtype=bool),
        )
        return design.with_structure(design.structure)

    @property
    def data(self) -> Record:
        """The record."""
        return self.made.data

    @property
    def decimation(self) -> Decimation:
        """Its filter, with the rows that are kept."""
        return self.made.decimation

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self.made.robot

    @property
    def joints(self) -> np.ndarray:
        """Those whose torque counts (J,)."""
        return self.made.joints

    @property
    def rows(self) -> np.ndarray:
        """Rows of the record that are kept (M,)."""
        return self.decimation.rows

    @property
    def geared(self) -> bool:
        """True when the ripple columns are among the columns of each joint."""
        return self.fixed.shape[2] == len(FIXED)

    @property
    def terms(self) -> list[tuple[str, ...]]:
        """Names of the columns of each joint's own."""
        kinds = zip(self.structure.terms, self.structure.names, self.free)
        return [(*term_names(terms, self.geared), *compress(names, free)) for terms, names, free in kinds]

    @property
    def layout(self) -> ParameterLayout:
        """Names, units, bounds and places of all parameters."""
        return ParameterLayout(self.robot, self.base, self.joints, self.made.motors, self.owners, tuple(self.terms))

    def with_structure(self, structure: FrictionStructure) -> Design:
        """Return it with the columns of another structure of friction."""
        shaped = self.made.shaped(structure.delta, structure.smooth, structure.speed[None])
        made_of = (*FIXED[: self.fixed.shape[2]], *SHAPED)
        at = [made_of.index(name) for name in COLUMNS[: self._width]]
        local = []
        for i, joint in enumerate(self.joints):
            own = np.concatenate([self.fixed[:, i], shaped[:, i]], axis=1)[:, at]
            own = own @ mixing(structure.terms[i], self._width)
            moved = np.flatnonzero(self.made.motors[:, joint])
            theirs = (self.made.motors[m, joint] * self.coupled_motors[:, m] for m in moved)
            local.append(np.hstack([own, *theirs]) if len(moved) else own)
        return replace(self, structure=structure, free=np.zeros_like(self.free), local=tuple(local))

    def with_torque(self, tau: np.ndarray) -> Design:
        """Return it with another torque (N, n) that was read."""
        thin = self.decimation.run(lambda a, b: tau[a:b, self.joints], len(self.joints))
        made = replace(self.made, data=replace(self.data, tau=tau))
        return replace(self, made=made, tau=thin / self.gains)

    def with_gains(self, gains: np.ndarray) -> Design:
        """Return it with other gains (J,) of the torque that was read."""
        return replace(self, gains=gains, tau=self.tau * self.gains / gains)

    def with_slopes(self, theta: np.ndarray, free: np.ndarray | None = None) -> Design:
        """Return it with the derivatives of the torque over the logarithms of the numbers that make the structure.

        `theta`: (p,) parameters of this design, without slopes, at which they are taken. `free`: (J, 2) bool, which
        numbers; those that matter to the torque when left out.
        """
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
        more, less = (self.made.shaped(one.delta, one.smooth, one.speed[None]) for one in (up, down))
        bumps = self.made.shaped(self.structure.delta, self.structure.smooth, np.stack([wide.speed, narrow.speed]))
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
        """Return the rows of the problem, made again whenever they are read.

        `block`: (M,) number of the block of time of each kept row. `trust`: (M, J) weights to multiply the rows by; 1
        when left out.
        """
        return DesignRows(self.tau, self.rigid, self.local, self.layout.columns, block, trust)

    def model(self, theta: np.ndarray) -> np.ndarray:
        """Return the filtered torque (M, J) [N m] of parameters theta (p,)."""
        parts = zip(self.rigid, self.local, self.layout.columns)
        return np.stack([np.hstack([A, L]) @ theta[c] for A, L, c in parts], axis=1)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Return measured minus modelled filtered torque (M, J) [N m]."""
        return self.tau - self.model(theta)

    def drives(self, theta: np.ndarray) -> tuple[Friction, Ripple]:
        """Return friction and ripple of all joints of parameters theta (p,); zero for joints that do not count."""
        values = np.zeros((len(COLUMNS), self.robot.n))
        values[:, self.joints] = self._own(theta)
        found = self.moved(theta)
        filled = np.tile([[1e-3], [0.0], [0.1], [2.0]], self.robot.n)
        filled[:, self.joints] = found.delta, found.smooth, found.speed, self.made.cycles
        *numbers, cycles = filled
        fields = {FRICTION_TERMS[name].fields[0]: own for name, own in zip(FRICTION, values)}
        fields |= dict(zip(("delta", "smooth_speed", "stribeck_speed"), numbers))
        return Friction(resolution=self.data.resolution, **fields), Ripple(cycles, *values[len(FRICTION) :])

    def _own(self, theta: np.ndarray) -> np.ndarray:
        """Return the parameters of all COLUMNS of each joint (8, J); zero for those that it has not."""
        values = np.zeros((len(COLUMNS), len(self.joints)))
        for i, (columns, A) in enumerate(zip(self.layout.columns, self.rigid)):
            T = mixing(self.structure.terms[i], self._width)
            values[: self._width, i] = T @ theta[columns[A.shape[1] :][: T.shape[1]]]
        return values

    def coupled(self, theta: np.ndarray) -> CoupledMotors | None:
        """Return the motors that move several joints, of parameters theta (p,); None where there are none."""
        K = len(self.made.motors)
        if not K:
            return None
        inertia, viscous, coulomb = theta[-3 * K :].reshape(K, 3).T
        return CoupledMotors(self.made.motors, inertia, viscous, coulomb, np.full(K, SMOOTH))

    @property
    def _width(self) -> int:
        return len(COLUMNS if self.geared else FRICTION)

    def choose_structure(
        self, theta: np.ndarray, trust: np.ndarray | None = None, chooser: Chooser = choose_here
    ) -> Design:
        """Choose the structure of friction of each joint on held-out blocks of half a second.

        `theta`: (p,) parameters, of which the base parameters are held. `trust`: (M, J) weights of the rows; 0 leaves
        one out.
        """
        weights = np.ones_like(self.tau) if trust is None else np.asarray(trust, dtype=float)
        used = np.cumsum(weights.any(axis=1))  # blocks of what is used: all folds have as much
        fold = used // max(1, round(BLOCK * self.data.rate / self.decimation.every)) % FOLDS
        motion = self.made.friction

        def choice(i: int) -> StructureChoice:
            A, L, c = self.rigid[i], self.local[i], self.layout.columns[i]
            coupled = L[:, len(self.terms[i]) :]
            free = np.zeros((len(L), 3 * len(self.made.motors)))
            free[:, : coupled.shape[1]] = coupled
            target = self.tau[:, i] - A @ theta[c[: A.shape[1]]]
            fixed = np.concatenate([self.fixed[:, i], free], axis=1)
            return StructureChoice(motion.of(i), fixed, target, fold, weights[:, i])

        return self.with_structure(FrictionStructure.joined(chooser(map(choice, range(len(self.joints))))))
