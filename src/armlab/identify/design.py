"""The linear regression behind `fit_dynamics`: filtered, thinned columns of each joint, made in blocks.

Base-parameter columns are shared by all joints; each joint has its own: viscous, Coulomb, offset, Stribeck and root
where they win (`armlab.identify.shapes`), and, where the gears are known, cosine and sine of the ripple line at twice
the gear ratio (strain-wave gears press twice per input turn). A robot file that is silent about the gears has ratio 1:
such a line would be a harmonic of gravity and is left out.

A motor that moves several joints, as in wrists, brings three shared columns: its angle is ``theta = c q``, and its
inertia, viscous and Coulomb friction act on all of them, ``tau = c^T f(theta)``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab.estimation import Rows
from armlab.identify.base_parameters import BaseParameters
from armlab.identify.plausibility import slow_enough
from armlab.identify.preparation import Prepared
from armlab.identify.shapes import COLUMNS, FOLDS, Shapes, choose, mixing, term_names
from armlab.identify.thinning import Thinning
from armlab.kernels import presliding
from armlab.models import CoupledMotors, Friction, Ripple
from armlab.robots import Robot

__all__ = ["Design"]

CUTOFF = 25.0  # Hz, the most; a tenth of the rate where that is less
BLOCK = 0.5  # s, blocks that go to the folds in turn for the choice of shape
MIN_CYCLES = 20.0  # rad/rad; a slower ripple line is a harmonic of gravity
SEEN = 0.5  # share of the samples at which a ripple line must not fold back
AT_ONCE = 8192  # rows handed to the solver
BOUNDED = ("viscous", "coulomb", "coulomb+", "coulomb-", "rotor")  # not negative
SMOOTH = 0.02  # rad/s, of the sign of coupled motors
COUPLED = ("rotor", "viscous", "coulomb")  # of a motor that moves several joints


@dataclass(frozen=True, eq=False)
class Design:
    """Filtered and thinned regression problem of J joints.

    Attributes
    ----------
    data : the record. thinning : its filter, with the (M,) rows that are kept.
    robot, base : the arm and its base parameters. joints : (J,) those whose torque counts.
    motors : (K, n) angles theta = c q of motors that move several joints. owners : (K,) the joint each belongs to.
    tau : (M, J) filtered torque. rigid : of each joint (M, w), columns of the base parameters that it sees.
    fixed : (M, J, 2 or 4) columns without shape: viscous, offset, and ripple where the gears are known.
    inertial : (M, K, 2) filtered acceleration and velocity of the coupled motors.
    cycles : (J,) ripple line [rad/rad].
    shapes : of friction. local : of each joint (M, k) columns of its own, then of the motors that move it.
    """

    data: Prepared
    thinning: Thinning
    robot: Robot
    base: BaseParameters
    joints: np.ndarray
    motors: np.ndarray
    owners: np.ndarray
    tau: np.ndarray
    rigid: tuple[np.ndarray, ...]
    fixed: np.ndarray
    inertial: np.ndarray
    cycles: np.ndarray
    shapes: Shapes
    local: tuple[np.ndarray, ...] = ()

    @classmethod
    def build(
        cls,
        data: Prepared,
        robot: Robot,
        base: BaseParameters,
        *,
        cutoff: float | None = None,
        every: int | None = None,
        joints: Sequence[int] | None = None,
    ) -> Design:
        """Filter and thin all columns; friction starts with presliding over 1e-3 rad.

        Parameters
        ----------
        data : the record.
        robot : kinematics, gravity and gears.
        base : base parameters of the robot, for the same joints.
        cutoff : of the zero-phase filter [Hz]; a tenth of the rate, at most 25 Hz, when left out; infinite for none.
        every : rows from one kept row to the next; 2.5 kept rows per period of the cut-off when left out.
        joints : whose torque counts; all when left out.
        """
        corner = min(data.rate / 10.0, CUTOFF) if cutoff is None else cutoff
        step = max(1, int(data.rate / (2.5 * corner))) if every is None else every
        thinning = Thinning.of(data, corner, step)
        measured = np.arange(robot.n) if joints is None else np.asarray(joints)
        qdd = data.differentiate(data.qd)
        ratios = np.linalg.inv(robot.coupling)
        cycles = 2.0 * np.abs(np.diag(ratios))[measured]
        turning = ratios / np.diag(ratios)[:, None]
        owners = np.flatnonzero(np.count_nonzero(turning, axis=1) > 1)
        motors = turning[owners]
        fixed = [data.qd[:, measured], np.ones((len(data.t), len(measured)))]
        slow = slow_enough(data.qd[:, measured], data.rate, cycles)
        if not np.any(cycles < MIN_CYCLES) and _lines_are_seen(
            slow, data.rate, [robot.joint_names[i] for i in measured]
        ):
            angle = cycles * data.q[:, measured]
            fixed += [np.where(slow, np.cos(angle), 0.0), np.where(slow, np.sin(angle), 0.0)]
        columns = np.concatenate([data.tau[:, measured], *fixed, qdd @ motors.T, data.qd @ motors.T], axis=1)
        thin = thinning.run(lambda a, b: columns[a:b], columns.shape[1])
        J, K = len(measured), len(motors)
        parts = np.split(thin, [J, J * (len(fixed) + 1)], axis=1)
        design = cls(
            data=data,
            thinning=thinning,
            robot=robot,
            base=base,
            joints=measured,
            motors=motors,
            owners=owners,
            tau=parts[0],
            rigid=_rigid(data, qdd, robot, base, measured, thinning),
            fixed=np.moveaxis(parts[1].reshape(len(thin), len(fixed), J), 1, 2),
            inertial=np.moveaxis(parts[2].reshape(len(thin), 2, K), 1, 2),
            cycles=cycles,
            shapes=Shapes.start(J),
        )
        return design.with_shapes(design.shapes)

    @property
    def rows(self) -> np.ndarray:
        """Rows of the record that are kept (M,)."""
        return self.thinning.rows

    @property
    def geared(self) -> bool:
        """True when the ripple columns are among the columns of each joint."""
        return self.fixed.shape[2] == 4

    @property
    def terms(self) -> list[tuple[str, ...]]:
        """Names of the columns of each joint's own."""
        return [term_names(terms, self.geared) for terms in self.shapes.terms]

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
    def units(self) -> tuple[str, ...]:
        """Units of all parameters."""
        own = []
        for i, terms in zip(self.joints, self.terms):
            force, length = ("N", "m") if self.robot.prismatic[i] else ("N m", "rad")
            special = {"viscous": f"{force} s/{length}", "root": f"{force} sqrt(s/{length})"}
            own += [special.get(term, force) for term in terms]
        return (*self.base.units, *own, *("kg m^2", "N m s/rad", "N m") * len(self.motors))

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds of all parameters: 0 for inertia, viscous and Coulomb friction, else -inf."""
        own = [term for terms in self.terms for term in terms] + list(COUPLED) * len(self.motors)
        return np.concatenate([self.base.lower, [0.0 if term in BOUNDED else -np.inf for term in own]])

    def with_shapes(self, shapes: Shapes) -> Design:
        """Return it with the columns of other shapes of friction."""
        shaped = self.shaped(shapes.delta, shapes.smooth, shapes.speed[None])
        coupled = self._coupled(shapes)
        local = []
        for i, joint in enumerate(self.joints):
            own = [self.fixed[:, i, :1], shaped[:, i, :2], self.fixed[:, i, 1:2], shaped[:, i, [3, 2]]]
            own = np.concatenate([*own, self.fixed[:, i, 2:]], axis=1)
            moved = np.flatnonzero(self.motors[:, joint])
            theirs = self.motors[moved, joint][:, None] * coupled[:, moved]
            local.append(np.hstack([own @ mixing(shapes.terms[i], own.shape[1]), theirs.reshape(len(own), -1)]))
        return replace(self, shapes=shapes, local=tuple(local))

    def stream(self, block: np.ndarray, trust: np.ndarray | None = None) -> Iterable[Rows]:
        """Return the rows of the problem, made again whenever they are read.

        Parameters
        ----------
        block : (M,) number of the block of time of each kept row.
        trust : (M, J) weights to multiply the rows by; 1 when left out.
        """
        return _Stream(self, block, trust)

    def model(self, theta: np.ndarray) -> np.ndarray:
        """Return the filtered torque (M, J) [N m] of parameters theta (p,)."""
        parts = zip(self.rigid, self.local, self.columns)
        return np.stack([np.hstack([A, L]) @ theta[c] for A, L, c in parts], axis=1)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Return measured minus modelled filtered torque (M, J) [N m]."""
        return self.tau - self.model(theta)

    def drives(self, theta: np.ndarray) -> tuple[Friction, Ripple]:
        """Return friction and ripple of all joints of parameters theta (p,); zero for joints that do not count."""
        values = np.zeros((len(COLUMNS), self.robot.n))
        for i, columns in enumerate(self.columns):
            first = self.rigid[i].shape[1]
            own = theta[columns[first : first + len(self.terms[i])]]
            values[: self._width, self.joints[i]] = mixing(self.shapes.terms[i], self._width) @ own
        shapes = np.tile([[1e-3], [0.0], [0.1], [2.0]], self.robot.n)
        shapes[:, self.joints] = self.shapes.delta, self.shapes.smooth, self.shapes.speed, self.cycles
        viscous, positive, negative, offset, stribeck, root, cosine, sine = values
        delta, smooth, speed, cycles = shapes
        state = speed, delta, self.data.resolution
        friction = Friction(viscous, positive, negative, offset, stribeck, *state, root, smooth)
        return friction, Ripple(cycles, cosine, sine)

    def coupled(self, theta: np.ndarray) -> CoupledMotors | None:
        """Return the motors that move several joints, of parameters theta (p,); None where there are none."""
        K = len(self.motors)
        if not K:
            return None
        inertia, viscous, coulomb = theta[-3 * K :].reshape(K, 3).T
        return CoupledMotors(self.motors, inertia, viscous, coulomb, np.full(K, SMOOTH))

    @property
    def _width(self) -> int:
        return len(COLUMNS) if self.geared else len(COLUMNS) - 2

    def choose_shapes(self, theta: np.ndarray, trust: np.ndarray | None = None) -> Design:
        """Choose the shape of friction of each joint on held-out blocks of half a second.

        Parameters
        ----------
        theta : (p,) parameters, of which the base parameters are held.
        trust : (M, J) weights of the rows; 0 leaves one out.
        """
        target, free = self.tau.copy(), np.zeros((*self.tau.shape, 3 * len(self.motors)))
        for i, (A, L, c) in enumerate(zip(self.rigid, self.local, self.columns)):
            target[:, i] -= A @ theta[c[: A.shape[1]]]
            coupled = L[:, len(self.terms[i]) :]
            free[:, i, : coupled.shape[1]] = coupled
        fixed = np.concatenate([self.fixed, free], axis=2)
        weights = np.ones_like(target) if trust is None else np.asarray(trust, dtype=float)
        used = np.cumsum(weights.any(axis=1))  # blocks of what is used: all folds have as much
        fold = used // max(1, round(BLOCK * self.data.rate / self.thinning.every)) % FOLDS
        return self.with_shapes(choose(self.shaped, fixed, target, fold, weights))

    def shaped(self, delta: np.ndarray, smooth: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Return the filtered columns (M, J, 3 + S) that depend on the shape: s+, s-, root, Stribeck of each speed.

        Parameters
        ----------
        delta, smooth : (J,) shape of the sign. speeds : (S, J) of Stribeck's term.
        """
        sign, J = self._sign(self.data.q[:, self.joints], self.data.qd[:, self.joints], delta, smooth), len(self.joints)

        def columns(a: int, b: int) -> np.ndarray:
            s, qd = sign[a:b], self.data.qd[a:b, self.joints]
            bumps = [s * np.exp(-((qd / speed) ** 2)) for speed in speeds]
            return np.concatenate([np.maximum(s, 0.0), np.minimum(s, 0.0), s * np.sqrt(np.abs(qd)), *bumps], axis=1)

        count = 3 + len(speeds)
        return np.moveaxis(self.thinning.run(columns, J * count).reshape(-1, count, J), 1, 2)

    def _sign(self, q: np.ndarray, qd: np.ndarray, delta: np.ndarray, smooth: np.ndarray) -> np.ndarray:
        """Return s (N, k) along the record: presliding state, or smooth sign."""
        resolution = self.data.resolution[self.joints] if len(delta) == len(self.joints) else np.zeros(len(delta))
        z = np.concatenate([presliding(np.ascontiguousarray(q[a:b]), delta, resolution) for a, b in self.data.segments])
        soft = smooth > 0
        z[:, soft] = np.tanh(qd[:, soft] / smooth[soft])
        return z

    def _coupled(self, shapes: Shapes) -> np.ndarray:
        """Return filtered acceleration, velocity and sign (M, K, 3) of the coupled motors."""
        sign = np.tanh(self.data.qd @ self.motors.T / SMOOTH)
        s = self.thinning.run(lambda a, b: sign[a:b], len(self.motors))
        return np.concatenate([self.inertial, s[:, :, None]], axis=2)


@dataclass(frozen=True, eq=False)
class _Stream:
    """Rows of a design; reading it again makes them again."""

    design: Design
    block: np.ndarray
    trust: np.ndarray | None

    def __iter__(self) -> Iterator[Rows]:
        d = self.design
        for i, columns in enumerate(d.columns):
            for a in range(0, len(self.block), AT_ONCE):
                part = slice(a, a + AT_ONCE)
                A, y = np.hstack([d.rigid[i][part], d.local[i][part]]), d.tau[part, i]
                if self.trust is not None:
                    A, y = A * self.trust[part, i, None], y * self.trust[part, i]
                yield Rows(A, y, self.block[part], i, columns)


def _lines_are_seen(slow: np.ndarray, rate: float, names: Sequence[str]) -> bool:
    """Tell whether the ripple lines pass slowly enough for the sampling in most samples; warn where they do not."""
    fast = [names[int(i)] for i in np.flatnonzero(slow.mean(axis=0) < SEEN)]
    if fast:
        warnings.warn(
            f"Expected torque ripple below {rate / 4.0:.3g} Hz, a quarter of the sampling rate, in half of the samples "
            f"at least, got faster ripple for {', '.join(fast)}: it folds back, and no ripple is "
            "fitted. Log slower motion, as of identify.friction_run, or sample faster.",
            stacklevel=2,
        )
    return not fast


def _rigid(
    data: Prepared, qdd: np.ndarray, robot: Robot, base: BaseParameters, joints: np.ndarray, thinning: Thinning
) -> tuple[np.ndarray, ...]:
    """Return the filtered columns of the base parameters that each joint sees."""
    n = robot.n
    seen = [base.kept[base.seen[i]] for i in joints]
    edges = np.cumsum([0, *(len(kept) for kept in seen)])
    flat = np.concatenate([np.where(kept < 10 * n, 10 * n * i + kept, 0) for i, kept in zip(joints, seen)])
    rotors = [(edges[i] + k, column - 10 * n) for i, kept in enumerate(seen) for k, column in enumerate(kept)]
    rotors = [(position, joint) for position, joint in rotors if joint >= 0]

    def columns(a: int, b: int) -> np.ndarray:
        moves = 0.0 if base.quasi_static else 1.0
        Y = robot.chain.rigid_regressor(data.q[a:b], moves * data.qd[a:b], moves * qdd[a:b], robot.gravity)
        X = np.take(Y.reshape(b - a, -1), flat, axis=1)
        for position, joint in rotors:
            X[:, position] = qdd[a:b, joint]
        return X

    thin = thinning.run(columns, int(edges[-1]))
    return tuple(thin[:, edges[i] : edges[i + 1]] for i in range(len(joints)))
