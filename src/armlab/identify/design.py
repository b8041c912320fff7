"""The linear regression behind `fit_dynamics`: filtered, thinned regressor columns and the choice of friction shape.

Base-parameter columns are shared by all joints; each joint has its own: viscous, Coulomb for both directions, offset,
Stribeck, and, where the gears are known, cosine and sine of the ripple line at twice the gear ratio (strain-wave gears
press twice per input turn). A robot file that is silent about the gears has ratio 1: such a line would be a harmonic of
gravity and is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armlab.identify.base_parameters import BaseParameters
from armlab.identify.preparation import Prepared
from armlab.kernels import presliding
from armlab.robots import Robot

__all__ = ["DELTAS", "STRIBECK_SPEEDS", "Design"]

DELTAS = np.geomspace(1e-4, 1e-2, 7)  # rad
STRIBECK_SPEEDS = np.array([0.02, 0.05, 0.1, 0.3])  # rad/s
LOCAL = (("viscous", "N m s/rad"), ("coulomb+", "N m"), ("coulomb-", "N m"), ("offset", "N m"), ("stribeck", "N m"))
RIPPLE = (("ripple cos", "N m"), ("ripple sin", "N m"))
REFINEMENTS = (1.5, 1.25, 1.12, 1.06)  # factors tried both ways after the grid
BLOCK = 1.0  # s, alternating blocks for the choice of shape
MIN_CYCLES = 20.0  # rad/rad; a slower ripple line is a harmonic of gravity


@dataclass(frozen=True, eq=False)
class Design:
    """Filtered and thinned regression problem.

    Attributes
    ----------
    data : the record. rows : (M,) rows of it that are kept. cutoff : of the zero-phase filter [Hz].
    tau : (M, n) filtered torque. rigid : (M, n, p) filtered base-parameter columns.
    fixed : (M, n, 4) filtered columns of each joint that have no shape: viscous, offset, ripple cosine and sine; the
        first two alone where the gears are not known.
    delta, speed : (n,) shape of friction. cycles : (n,) ripple line [rad/rad].
    names, units : of the p + k n parameters, k = 7 of each joint, 5 where the gears are not known.
    """

    data: Prepared
    rows: np.ndarray
    cutoff: float
    tau: np.ndarray
    rigid: np.ndarray
    fixed: np.ndarray
    delta: np.ndarray
    speed: np.ndarray
    cycles: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]

    @classmethod
    def build(cls, data: Prepared, robot: Robot, base: BaseParameters) -> Design:
        """Filter and thin all columns that have no shape; friction starts with delta 1e-3 rad and speed 0.1 rad/s.

        Parameters
        ----------
        data : the record.
        robot : kinematics, gravity and gears.
        base : base parameters of the robot.
        """
        n = robot.n
        cutoff = data.rate / 10.0
        every = max(1, int(data.rate / (2.5 * cutoff)))
        rows = np.concatenate([np.arange(a, b, every) for a, b in data.segments])
        qdd = data.differentiate(data.qd)
        Y = np.zeros((len(data.t), n, 11 * n))
        Y[:, :, : 10 * n] = robot.chain.rigid_regressor(data.q, data.qd, qdd, robot.gravity)
        Y[:, range(n), range(10 * n, 11 * n)] = qdd
        cycles = 2.0 * np.abs(np.diag(np.linalg.inv(robot.coupling)))
        angle = cycles * data.q
        fixed = [data.qd, np.ones_like(data.qd), np.cos(angle), np.sin(angle)]
        columns = (*LOCAL, *RIPPLE)
        if np.any(cycles < MIN_CYCLES):
            fixed, columns = fixed[:2], LOCAL
        joints = [(f"{name} {joint}", unit) for joint in robot.joint_names for name, unit in columns]
        return cls(
            data=data,
            rows=rows,
            cutoff=cutoff,
            tau=data.filter(data.tau, cutoff)[rows],
            rigid=data.filter(Y[:, :, base.kept], cutoff)[rows],
            fixed=data.filter(np.stack(fixed, axis=2), cutoff)[rows],
            delta=np.full(n, 1e-3),
            speed=np.full(n, 0.1),
            cycles=cycles,
            names=(*base.names, *(name for name, _ in joints)),
            units=(*base.units, *(unit for _, unit in joints)),
        )

    @property
    def t(self) -> np.ndarray:
        """Time of the kept rows (M,) [s]."""
        return self.data.t[self.rows]

    @property
    def geared(self) -> bool:
        """True when the ripple columns are among the columns of each joint."""
        return self.fixed.shape[2] == 4

    def local(self) -> np.ndarray:
        """Return the columns of each joint (M, n, k) in the order of `names`."""
        shaped = self._shaped(self.delta, self.speed)
        viscous, offset, *ripple = np.moveaxis(self.fixed, 2, 0)
        return np.stack([viscous, shaped[0], shaped[1], offset, shaped[2], *ripple], axis=2)

    def matrix(self) -> np.ndarray:
        """Return the whole regressor (M, n, p + k n)."""
        M, n, p = self.rigid.shape
        local = self.local()
        k = local.shape[2]
        A = np.zeros((M, n, p + k * n))
        A[:, :, :p] = self.rigid
        for i in range(n):
            A[:, i, p + k * i : p + k * (i + 1)] = local[:, i]
        return A

    def solve(self, weights: np.ndarray) -> np.ndarray:
        """Return the least-squares parameters (p + k n,) with a weight per joint (n,), of columns scaled to norm 1."""
        A = (self.matrix() * weights[None, :, None]).reshape(-1, len(self.names))
        scale = np.linalg.norm(A, axis=0)
        scale[scale == 0] = 1.0
        solution = np.linalg.lstsq(A / scale, (self.tau * weights).ravel(), rcond=None)[0]
        return solution / scale

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Return measured minus modelled filtered torque (M, n) [N m]."""
        return self.tau - self.matrix() @ theta

    def choose_shapes(self, theta: np.ndarray) -> Design:
        """Choose presliding distance and Stribeck speed of each joint on held-out alternating blocks.

        Parameters
        ----------
        theta : (p + k n,) parameters whose rigid part is held.
        """
        p = self.rigid.shape[2]
        target = self.tau - self.rigid @ theta[:p]
        odd = self.data.blocks(BLOCK)[self.rows] % 2 == 1
        n = self.tau.shape[1]
        best, delta, speed = np.full(n, np.inf), self.delta.copy(), self.speed.copy()

        def attempt(trial_delta: np.ndarray, trial_speed: np.ndarray) -> None:
            trial = replace(self, delta=trial_delta, speed=trial_speed).local()
            score = np.array([_held_out(trial[:, i], target[:, i], odd) for i in range(n)])
            better = score < best
            best[better], delta[better], speed[better] = score[better], trial_delta[better], trial_speed[better]

        for candidate in DELTAS:
            for width in STRIBECK_SPEEDS:
                attempt(np.full(n, candidate), np.full(n, width))
        for step in REFINEMENTS:
            for factor in (step, 1.0 / step):
                attempt(delta * factor, speed.copy())
                attempt(delta.copy(), speed * factor)
        return replace(self, delta=delta, speed=speed)

    def _shaped(self, delta: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return filtered, thinned columns (3, M, n) that depend on the shape: Coulomb +, Coulomb -, Stribeck."""
        data = self.data
        z = np.concatenate([presliding(data.q[a:b], delta, data.resolution) for a, b in data.segments])
        bump = z * np.exp(-((data.qd / speed) ** 2))
        columns = np.stack([np.maximum(z, 0.0), np.minimum(z, 0.0), bump], axis=2)
        return np.moveaxis(data.filter(columns, self.cutoff)[self.rows], 2, 0)


def _held_out(A: np.ndarray, y: np.ndarray, odd: np.ndarray) -> float:
    """Return the squared error on blocks that the parameters were not fitted to, both ways."""
    total = 0.0
    for train in (odd, ~odd):
        solution = np.linalg.lstsq(A[train], y[train], rcond=None)[0]
        total += float(np.sum((y[~train] - A[~train] @ solution) ** 2))
    return total
