"""Filtered and thinned columns of a regression over joint torque, made piece by piece from a record.

No column exists at the full rate for the whole record: a long one would not fit into memory beside its filtered copy.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from armlab.identify.base_parameters import BaseParameters
from armlab.identify.friction_columns import FrictionColumns
from armlab.identify.preparation import Prepared
from armlab.identify.sampling import slow_enough
from armlab.identify.thinning import Thinning
from armlab.robots import Robot

__all__ = ["SMOOTH", "Columns"]

MIN_CYCLES = 20.0  # rad/rad; a slower ripple line is a harmonic of gravity
SEEN = 0.5  # share of the samples at which a ripple line must not fold back
SMOOTH = 0.02  # rad/s, of the sign of coupled motors


@dataclass(frozen=True, eq=False)
class Columns:
    """Makes the columns of J joints of a record.

    Attributes
    ----------
    data : the record. thinning : its filter, with the (M,) rows that are kept.
    robot : kinematics, gravity and gears. joints : (J,) those whose torque counts.
    motors : (K, n) angles theta = c q of motors that move several joints.
    geared : whether there are columns of ripple; where gears are known and ripple is seen in this record, when None.
    """

    data: Prepared
    thinning: Thinning
    robot: Robot
    joints: np.ndarray
    motors: np.ndarray
    geared: bool | None = None

    @property
    def cycles(self) -> np.ndarray:
        """Ripple line of each joint (J,) [rad/rad]: strain-wave gears press twice per input turn."""
        return 2.0 * np.abs(np.diag(np.linalg.inv(self.robot.coupling)))[self.joints]

    @property
    def friction(self) -> FrictionColumns:
        """What makes the columns that depend on the shape of friction."""
        data, joints = self.data, self.joints
        return FrictionColumns(self.thinning, data.q[:, joints], data.qd[:, joints], data.resolution[joints])

    def plain(self, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what has neither shape nor base parameters.

        Parameters
        ----------
        qdd : (N, n) acceleration of the record.

        Returns
        -------
        Torque (M, J); columns (M, J, 2 or 4): viscous, offset, and ripple where it is seen; acceleration and velocity
        (M, K, 2) of the coupled motors.
        """
        data, joints, cycles = self.data, self.joints, self.cycles
        J, K = len(joints), len(self.motors)
        geared = self.geared
        if geared is None:
            geared = not np.any(cycles < MIN_CYCLES) and self._lines_are_seen()

        def columns(a: int, b: int) -> np.ndarray:
            qd = data.qd[a:b, joints]
            parts = [data.tau[a:b, joints], qd, np.ones_like(qd)]
            if geared:
                slow, angle = slow_enough(qd, data.rate, cycles), cycles * data.q[a:b, joints]
                parts += [np.where(slow, np.cos(angle), 0.0), np.where(slow, np.sin(angle), 0.0)]
            return np.concatenate([*parts, qdd[a:b] @ self.motors.T, data.qd[a:b] @ self.motors.T], axis=1)

        fixed = 4 if geared else 2
        thin = self.thinning.run(columns, J * (1 + fixed) + 2 * K)
        tau, own, coupled = np.split(thin, [J, J * (fixed + 1)], axis=1)
        own = np.moveaxis(own.reshape(len(thin), fixed, J), 1, 2)
        return tau, own, np.moveaxis(coupled.reshape(len(thin), 2, K), 1, 2)

    def rigid(self, qdd: np.ndarray, base: BaseParameters) -> tuple[np.ndarray, ...]:
        """Return of each joint the columns (M, w) of the base parameters that it sees.

        Parameters
        ----------
        qdd : (N, n) acceleration of the record. base : base parameters for the same joints.
        """
        data, robot, n = self.data, self.robot, self.robot.n
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

        thin = self.thinning.run(columns, int(edges[-1]))
        return tuple(thin[:, edges[i] : edges[i + 1]] for i in range(len(self.joints)))

    def shaped(self, delta: np.ndarray, smooth: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Return the columns (M, J, 3 + S) that depend on the shape of friction: s+, s-, root, Stribeck of each speed.

        Parameters
        ----------
        delta, smooth : (J,) shape of the sign. speeds : (S, J) of Stribeck's term.
        """
        friction = self.friction
        return friction.columns(friction.sign(delta, smooth), [friction.bell(speed) for speed in speeds])

    def coupled_sign(self) -> np.ndarray:
        """Return the smooth sign (M, K) of the coupled motors' velocity."""
        return self.thinning.run(lambda a, b: np.tanh(self.data.qd[a:b] @ self.motors.T / SMOOTH), len(self.motors))

    def _lines_are_seen(self) -> bool:
        """Tell whether ripple passes slowly enough for the sampling in most samples; warn where it does not."""
        data = self.data
        share = [
            np.mean(slow_enough(data.qd[:, joint], data.rate, line)) for joint, line in zip(self.joints, self.cycles)
        ]
        fast = [self.robot.joint_names[joint] for joint, seen in zip(self.joints, share) if seen < SEEN]
        if fast:
            warnings.warn(
                f"Expected torque ripple below {data.rate / 4.0:.3g} Hz, a quarter of the sampling rate, in half of "
                f"the samples at least, got faster ripple for {', '.join(fast)}: it folds back, and no ripple is "
                "fitted. Log slower motion, as of identify.friction_run, or sample faster.",
                stacklevel=3,
            )
        return not fast
