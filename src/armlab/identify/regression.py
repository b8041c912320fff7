"""Linear regression of `fit_dynamics`: shared columns of the base parameters, and separate columns for each joint.

All joints share the base-parameter columns. Each joint has its own columns: viscous, Coulomb and offset; Stribeck, root
and load if selected (`armlab.identify.friction_structure`). With known gears, each joint also has the cosine and sine
of the ripple line at twice the gear ratio, because strain-wave gears engage twice per input revolution. Robot files
without gears imply a gear ratio of 1. The ripple line for this ratio would be a harmonic of gravity, so `fit_dynamics`
searches the residual for lines instead.

A motor that drives several joints, as in many wrists, adds three shared columns. The motor angle is ``theta = c q``;
the motor's inertia and its viscous and Coulomb friction act on every joint that the motor drives, ``tau = c^T
f(theta)``.

All columns are filtered and decimated in blocks, because the full-rate regressor of a whole record does not fit into
memory.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, pairwise

import numpy as np

from armlab.dynamics import BaseParameters, base_regressor
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
from armlab.identify.record import ORDER, Decimation, Record, slow_enough
from armlab.models.friction import FRICTION_TERMS, Friction, FrictionTerm, Ripple
from armlab.models.torque import CoupledMotors
from armlab.models.uncertainty import ParameterCovariance
from armlab.robots import Robot

# Filtered and decimated columns of the regression for joint torque.


MIN_CYCLES = 20.0  # rad/rad; a slower ripple line is a harmonic of gravity
SEEN = 0.5  # fraction of the samples that must not alias a ripple line
SMOOTH = 0.02  # rad/s, width of the smooth sign of coupled motors


@dataclass(frozen=True, eq=False)
class RegressionColumns:
    """Regression columns of J joints, computed from a record.

    `decimation`: filter of the record and the (M,) rows kept. `joints`: (J,) joints with torque. `motors`: (K, n)
    rows c such that theta = c q is the angle of a motor that drives several joints. `lines`: (J,) ripple lines
    [rad/rad], or (0,) without ripple columns. `load`: (N, J) torque |x| transmitted to the links, at full rate; zero
    before the first solution.
    """

    data: Record
    decimation: Decimation
    robot: Robot
    joints: np.ndarray
    motors: np.ndarray
    lines: np.ndarray
    load: np.ndarray

    @property
    def geared(self) -> bool:
        """Whether the regression has ripple columns."""
        return len(self.lines) > 0

    @property
    def cycles(self) -> np.ndarray:
        """Ripple line of each joint (J,) [rad/rad]; known strain-wave gears engage twice per input revolution."""
        by_gears = 2.0 * np.abs(np.diag(np.linalg.inv(self.robot.coupling)))[self.joints]
        return self.lines if self.geared else by_gears

    @property
    def friction(self) -> FrictionColumns:
        data, joints = self.data, self.joints
        return FrictionColumns(
            self.decimation, data.q[:, joints], data.qd[:, joints], data.resolution[joints], self.load
        )

    def plain(self, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the columns that depend on neither friction structure nor base parameters, for acceleration (N, n).

        The result is the torque (M, J); the columns (M, J, 2 or 4) for viscous friction, offset and observable ripple;
        and the acceleration, velocity and smooth sign (M, K, 3) of the coupled motors.
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
        """Return, for each joint, the columns (M, w) of its base parameters at the acceleration (N, n)."""
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
        """Return the columns (M, J, 4 + S) for a friction sign with parameters `delta` and `smooth` (J,), then the
        Stribeck columns at speeds (S, J)."""
        friction = self.friction
        return friction.columns(friction.sign(delta, smooth), speeds)

    def lines_are_seen(self) -> bool:
        """Return whether the sampling rate resolves the ripple in most samples; if not, issue a warning."""
        data = self.data
        share = np.mean(slow_enough(data.qd[:, self.joints], data.rate, self.cycles), axis=0)
        fast = [self.robot.joint_names[joint] for joint, seen in zip(self.joints, share) if seen < SEEN]
        if fast:
            warnings.warn(
                f"Expected torque ripple below {data.rate / 4.0:.3g} Hz, a quarter of the sampling rate, in at least "
                f"half of the samples, got faster ripple for {', '.join(fast)}: "
                "this ripple aliases, so no ripple is fitted. "
                "Record slower motion, such as that of identify.friction_run, or sample faster.",
                stacklevel=3,
            )
        return not fast


# Layout of the parameters of `fit_dynamics`: base parameters, then those of each joint, then coupled motors.


COUPLED = {"rotor": "kg m^2", "viscous": "N m s/rad", "coulomb": "N m"}  # of a motor that drives several joints


@dataclass(frozen=True, eq=False)
class ParameterLayout:
    """Names, units, bounds and positions of p parameters.

    `joints`: (J,) joints with torque. `motors`: (K, n) rows c such that theta = c q is the angle of a motor that
    drives several joints. `owners`: (K,) joint to which each motor belongs. `rotors`: (K,) bool, whether the rotor
    inertia is identifiable.
    """

    robot: Robot
    base: BaseParameters
    joints: np.ndarray
    motors: np.ndarray
    owners: np.ndarray
    rotors: np.ndarray
    terms: tuple[tuple[str, ...], ...]

    @property
    def coupled(self) -> list[tuple[int, int]]:
        """Return the motor and the entry of `COUPLED` for each parameter of the coupled motors."""
        return [(m, k) for m, seen in enumerate(self.rotors) for k in range(0 if seen else 1, len(COUPLED))]

    @property
    def columns(self) -> list[np.ndarray]:
        """Parameter indices of the columns of each joint: base, joint-specific and coupled-motor parameters."""
        counts = [len(terms) for terms in self.terms]
        first = len(self.base.names) + np.concatenate([[0], np.cumsum(counts)])
        out = []
        for i, joint in enumerate(self.joints):
            coupled = first[-1] + np.array(
                [k for k, (m, _) in enumerate(self.coupled) if self.motors[m, joint]], dtype=int
            )
            out.append(np.concatenate([np.flatnonzero(self.base.seen[joint]), np.arange(*first[i : i + 2]), coupled]))
        return out

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: base parameters, joint-specific parameters, coupled motors."""
        own = []
        for i, terms in zip(self.joints, self.terms):
            plain = {"offset": self.base.offset_names[i]}
            own += [plain.get(term, f"{term} {self.robot.joint_names[i]}") for term in terms]
        terms = list(COUPLED)
        motors = [f"{terms[k]} of motor {self.robot.joint_names[self.owners[m]]}" for m, k in self.coupled]
        return (*self.base.names, *own, *motors)

    @property
    def heads(self) -> list[str]:
        """Short names of all parameters, without the other terms that base parameters combine."""
        return [re.split(r" [+-] ", name)[0] for name in self.names]

    @property
    def units(self) -> tuple[str, ...]:
        """Units of all parameters."""
        own = []
        for i, terms in zip(self.joints, self.terms):
            own += [_term(term).units(bool(self.robot.prismatic[i])) for term in terms]
        return (*self.base.units, *own, *(list(COUPLED.values())[k] for _, k in self.coupled))

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds of all parameters: 0 for inertia and for viscous and Coulomb friction, otherwise -inf."""
        own = [_term(term).least for terms in self.terms for term in terms]
        return np.concatenate([self.base.lower, own, np.zeros(len(self.coupled))])

    @property
    def upper(self) -> np.ndarray:
        """Upper bounds of all parameters: finite for load-dependent friction, otherwise inf."""
        own = [_term(term).most for terms in self.terms for term in terms]
        rest = np.full(len(self.coupled), np.inf)
        return np.concatenate([np.full(len(self.base.names), np.inf), own, rest])

    @property
    def slopes(self) -> np.ndarray:
        """Mask (p,) of the parameters that are logarithmic steps of nonlinear friction parameters."""
        own = [_term(term).column is None for terms in self.terms for term in terms]
        return np.array([False] * len(self.base.names) + own + [False] * len(self.coupled))


def _term(name: str) -> FrictionTerm:
    """Return the term of a column; ripple amplitudes have the unit and bound of an offset."""
    return FRICTION_TERMS.get(name, FRICTION_TERMS["offset"])


AT_ONCE = 8192  # rows passed to the solver together


@dataclass(frozen=True, eq=False)
class DesignRows:
    """Rows of a design for the solver, joint by joint; recomputed in each iteration.

    `block`: (M,) time block of each row. `trust`: (M, J) weights of the rows; None means 1.
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


def independent_rotors(robot: Robot, base: BaseParameters, motors: np.ndarray) -> np.ndarray:
    """Return the mask (K,) of coupled motors whose rotor inertia is not absorbed by a base parameter."""
    rng, n = np.random.default_rng(0), robot.n
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, SAMPLES, n))
    A = base_regressor(robot, q, qd, qdd, base).reshape(SAMPLES * n, -1)
    rotors = ((qdd @ motors.T)[:, None] * motors.T).reshape(SAMPLES * n, -1)
    left = rotors - A @ np.linalg.lstsq(A, rotors, rcond=None)[0]
    return np.linalg.norm(left, axis=0) > DEPENDENT * np.linalg.norm(rotors, axis=0)


SAMPLES, DEPENDENT = 100, 1e-6  # random regressor samples, and relative residual of a dependent column
CUTOFF = 25.0  # Hz, or a tenth of the rate if less
PAD = 20  # rows of extension at the ends of a segment
BLOCK = 0.5  # s, blocks assigned cyclically to the folds of the structure selection
STEP = 0.01  # logarithmic step of a nonlinear parameter for numerical derivatives
LONGEST = 0.5  # largest logarithmic step
NOTHING = 1e-12  # fraction of the torque power below which a derivative is ignored


@dataclass(frozen=True, eq=False)
class Design(RegressionColumns):
    """Filtered and decimated regression problem of J joints.

    `owners`: (K,) joint of each coupled motor. `rotors`: (K,) bool, whether the motor's rotor inertia is identifiable;
    behind a parallel rod, this inertia acts as link inertia. `gains`: (J,) ratio of measured to true torque. `tau`: (M,
    J) filtered torque divided by the gains. `rigid`: for each joint, columns (M, w) of its base parameters. `fixed`:
    (M, J, 2 or 4) linear columns: viscous, offset, and ripple with known gears. `coupled_motors`: (M, K, 3) filtered
    acceleration, velocity and sign of the coupled motors. `free`: (J, 2) bool, which of `FrictionStructure.numbers`
    have a column. Each such column is the derivative of the torque with respect to the logarithm of the friction
    parameter, at the parameters passed to `with_slopes`. `local`: for each joint, (M, k) joint-specific columns with
    derivatives last, then the columns of the motors that drive the joint.
    """

    base: BaseParameters
    owners: np.ndarray
    rotors: np.ndarray
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
        lines: np.ndarray | None = None,
    ) -> Design:
        """Filter and decimate all columns; `lines` defaults to the ripple lines of the gears."""
        corner = min(data.rate / 10.0, CUTOFF) if cutoff is None else cutoff
        step = max(1, int(data.rate / (2.5 * corner))) if every is None else every
        measured = np.arange(len(robot.joint_names)) if joints is None else np.asarray(joints)
        ratios = np.linalg.inv(robot.coupling)
        turning = ratios / np.diag(ratios)[:, None]
        owners = np.flatnonzero(np.count_nonzero(turning, axis=1) > 1)
        unloaded = np.zeros((len(data.t), len(measured)))
        thin = Decimation.of(data, corner, step)
        columns = RegressionColumns(data, thin, robot, measured, turning[owners], np.zeros(0), unloaded)
        if lines is None and not np.any(columns.cycles < MIN_CYCLES) and columns.lines_are_seen():
            lines = columns.cycles
        columns = replace(columns, lines=np.zeros(0) if lines is None else lines)
        qdd = data.differentiate(data.qd)
        tau, fixed, coupled = columns.plain(qdd)
        design = cls(
            **vars(columns),
            base=base,
            owners=owners,
            rotors=independent_rotors(robot, base, turning[owners]),
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
        """Kept rows (M,) of the record."""
        return self.decimation.rows

    @cached_property
    def terms(self) -> list[tuple[str, ...]]:
        """Names of the columns specific to each joint."""
        kinds = zip(self.structure.terms, self.structure.names, self.free)
        return [(*term_names(terms, self.geared), *compress(names, free)) for terms, names, free in kinds]

    @cached_property
    def layout(self) -> ParameterLayout:
        """Names, units, bounds and positions of all parameters."""
        return ParameterLayout(
            self.robot, self.base, self.joints, self.motors, self.owners, self.rotors, tuple(self.terms)
        )

    def own_columns(self, structure: FrictionStructure) -> Iterator[np.ndarray]:
        """Yield, for each joint, all joint-specific columns (M, W), including those not in its friction structure."""
        shaped = self.shaped(structure.delta, structure.smooth, structure.speed[None])
        at = [(*FIXED[: self.fixed.shape[2]], *SHAPED).index(name) for name in COLUMNS[: self._width]]
        for i in range(len(self.joints)):
            yield np.concatenate([self.fixed[:, i], shaped[:, i]], axis=1)[:, at]

    def with_structure(self, structure: FrictionStructure) -> Design:
        """Return the design with the columns of another friction structure."""
        local = []
        for i, (joint, own) in enumerate(zip(self.joints, self.own_columns(structure))):
            own = own @ mixing(structure.terms[i], self._width)
            moved = np.flatnonzero(self.motors[:, joint])
            theirs = (self.motors[m, joint] * self.coupled_motors[:, m, 0 if self.rotors[m] else 1 :] for m in moved)
            local.append(np.hstack([own, *theirs]) if len(moved) else own)
        return replace(self, structure=structure, free=np.zeros_like(self.free), local=tuple(local))

    def smoothed(self, cutoff: float) -> Design:
        """Return the design with all columns low-passed once more, at the kept rows."""
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
        """Return the design with a different measured torque (N, n)."""
        thin = self.decimation.run(lambda a, b: tau[a:b, self.joints], len(self.joints))
        return replace(self, data=replace(self.data, tau=tau), tau=thin / self.gains)

    def with_gains(self, gains: np.ndarray) -> Design:
        """Return the design with different gains (J,) of the measured torque."""
        return replace(self, gains=gains, tau=self.tau * self.gains / gains)

    def with_slopes(self, theta: np.ndarray, free: np.ndarray | None = None) -> Design:
        """Return the design extended by the torque derivatives with respect to the logarithms of the nonlinear
        parameters."""
        slopes = self._slopes(theta)
        power = np.sum(slopes * slopes, axis=0)
        picked = power > NOTHING * np.sum(self.tau * self.tau, axis=0)[:, None] if free is None else free
        local = []
        for i, (L, terms) in enumerate(zip(self.local, self.terms)):
            own = len(terms)
            local.append(np.hstack([L[:, :own], slopes[:, i, picked[i]], L[:, own:]]))
        return replace(self, free=picked, local=tuple(local))

    def _slopes(self, theta: np.ndarray) -> np.ndarray:
        """Return the torque derivatives (M, J, 2), computed by central differences."""
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
        """Return the friction structure moved by the steps in the parameters theta (p,), each clipped to 0.5."""
        steps = np.zeros(self.free.shape)
        steps[self.free] = np.clip(theta[self.layout.slopes], -LONGEST, LONGEST)
        return self.structure.moved(steps)

    def in_units(self, theta: np.ndarray, *covs: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return parameters (p,) and covariances (p, p) with the values of the nonlinear parameters instead of their
        logarithmic steps."""
        x, scale, at = theta.copy(), np.ones(len(theta)), self.layout.slopes
        x[at] = scale[at] = self.moved(theta).numbers[self.free]
        return x, *(cov * np.outer(scale, scale) for cov in covs)

    def stream(self, block: np.ndarray, trust: np.ndarray | None = None) -> Iterable[Rows]:
        """Return the rows of the problem with their blocks (M,) and weights (M, J) (default 1)."""
        return DesignRows(self, block, trust)

    def model(self, theta: np.ndarray) -> np.ndarray:
        """Return the filtered torque (M, J) [N m] for parameters theta (p,)."""
        parts = zip(self.rigid, self.local, self.layout.columns)
        return np.stack([np.hstack([A, L]) @ theta[c] for A, L, c in parts], axis=1)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Return the filtered torque residual (M, J), measured minus modelled [N m]."""
        return self.tau - self.model(theta)

    def drives(self, theta: np.ndarray) -> tuple[Friction, Ripple]:
        """Return the friction and ripple of all joints for parameters theta (p,); zero for joints without torque."""
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
        """Return the parameters of all COLUMNS of each joint (9, J); zero for absent columns."""
        values = np.zeros((len(COLUMNS), len(self.joints)))
        for i, (columns, A) in enumerate(zip(self.layout.columns, self.rigid)):
            T = mixing(self.structure.terms[i], self._width)
            values[: self._width, i] = T @ theta[columns[A.shape[1] :][: T.shape[1]]]
        return values

    def coupled(self, theta: np.ndarray) -> CoupledMotors | None:
        """Return the motors that drive several joints, for parameters theta (p,), or None."""
        K, at = len(self.motors), self.layout.coupled
        if not K:
            return None
        values = np.zeros((len(COUPLED), K))
        for (m, k), value in zip(at, theta[-len(at) :]):
            values[k, m] = value
        inertia, viscous, coulomb = values
        return CoupledMotors(self.motors, inertia, viscous, coulomb, np.full(K, SMOOTH))

    def parameter_covariance(self, cov: np.ndarray) -> ParameterCovariance:
        """Extract the covariance of the base parameters and friction from the covariance (p, p) of all parameters."""
        n, size = len(self.robot.joint_names), len(self.base.names)
        columns, maps = [self.base.kept], [np.eye(size, len(cov))]
        for i, (joint, own, A) in enumerate(zip(self.joints, self.layout.columns, self.rigid)):
            T = mixing(self.structure.terms[i], len(FRICTION))
            made = np.zeros((len(FRICTION), len(cov)))
            made[:, own[A.shape[1] :][: T.shape[1]]] = T
            columns.append(11 * n + len(FRICTION) * joint + np.arange(len(FRICTION)))
            maps.append(made)
        of = np.concatenate(maps)
        own = of @ cov @ of.T
        kept = np.flatnonzero(np.diag(own) > 0)
        lower = own[np.ix_(kept, kept)][np.tril_indices(len(kept))]
        return ParameterCovariance(np.concatenate(columns)[kept], lower, np.zeros(n))

    def load_sd(self, cov: np.ndarray) -> np.ndarray:
        """Return the standard deviation (J,) of the load-dependent friction; NaN for joints without it."""
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
        """Select the friction structure of each joint using held-out blocks of half a second.

        The base parameters theta (p,) are kept fixed and determine the load on the joints. `trust`: (M, J) weights of
        the rows; 0 excludes a row. `again`: start from the current structure, which was selected previously.
        """
        weights = np.ones_like(self.tau) if trust is None else np.asarray(trust, dtype=float)
        used = np.cumsum(weights.any(axis=1))  # only used rows count, so all folds have equal size
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
        """Return the design with the joint loads computed from the base parameters in theta (p,)."""
        data, moves = self.data, 0.0 if self.base.quasi_static else 1.0
        links, _ = self.base.links_and_rotors(theta[: len(self.base.names)])
        qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
        torque = self.robot.chain.rnea(data.q, moves * data.qd, moves * qdd, self.robot.gravity, links)
        return replace(self, load=np.abs(torque[:, self.joints])).with_structure(self.structure)
