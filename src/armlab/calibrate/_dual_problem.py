"""Residuals of two arms that measure each other: one system for both, all samples.

The tool of b seen from the tool of a is ``Z = T_a^-1 T_basea_baseb T_b``. A point p of b's tool, in a's base, moves in
a's tool axes by what the frames of b and the base of b do to it, less what the frames of a do to a point there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from armlab.calibrate._arm import Arm, ArmState
from armlab.calibrate._kinematic_data import Kind
from armlab.calibrate._kinematic_problem import amplitude_prior, chosen, link_prior, pose_residual
from armlab.calibrate._kinematic_rank import Suspect
from armlab.calibrate._kinematic_words import arm_scale, joints_at_rest
from armlab.estimation import Measurement
from armlab.kinematics import twist_jacobian
from armlab.lie import se3

TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")


class DualState(NamedTuple):
    """The unknowns: both arms and T_basea_baseb (4, 4)."""

    a: ArmState
    b: ArmState
    T: np.ndarray


@dataclass(frozen=True, eq=False)
class DualProblem:
    """Two arms and what was measured.

    Attributes
    ----------
    arm_a, arm_b : the arms. kinds : relative pose or position, then perhaps the pose of arm a from outside.
    absolute : whether that is so. closed : whether b's tool does not move in a's.
    active : (d,) mask of the components of a step. prior : (metres, radians) of the links, or None.
    """

    arm_a: Arm
    arm_b: Arm
    kinds: tuple[Kind, ...]
    absolute: bool
    closed: bool
    active: np.ndarray
    prior: tuple[float, float] | None

    @property
    def size(self) -> int:
        """Number of unknowns, gauge included: arm a, arm b, twist of T_basea_baseb."""
        return self.arm_a.size + self.arm_b.size + 6

    @property
    def waves(self) -> int:
        """Number of amplitudes."""
        return self.arm_a.waves[0].size + self.arm_b.waves[0].size

    @property
    def names(self) -> tuple[str, ...]:
        """Name of every unknown."""
        arms = [f"{letter}: {name}" for letter, arm in (("a", self.arm_a), ("b", self.arm_b)) for name in arm.names]
        return (*arms, *(f"base of b {name}" for name in TWIST))

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of every unknown."""
        return (*self.arm_a.units, *self.arm_b.units, *("m",) * 3, *("rad",) * 3)

    def sizes(self, length: float, angle: float) -> np.ndarray:
        """Return (d,) a length for metres and an angle for radians."""
        arms = [arm.sizes(length, angle) for arm in (self.arm_a, self.arm_b)]
        return np.concatenate([*arms, np.repeat([length, angle], 3)])

    def values(self, state: DualState) -> np.ndarray:
        """Return all unknowns (d,); frames by the twists that lead to them from the start, that of T as zero."""
        parts = []
        for arm, one in ((self.arm_a, state.a), (self.arm_b, state.b)):
            parts += [arm.corrections(one.frames).ravel(), one.amplitudes.ravel(), one.coefficients]
        return np.concatenate([*parts, np.zeros(6)])

    def gauge(self, state: DualState, used: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return directions (d, g) that nothing sees, and their names: joints, and where the foot of each arm is."""
        a, b = self.arm_a.size, self.arm_a.size + self.arm_b.size
        columns, names = [], []
        for arm, one, at, letter in ((self.arm_a, state.a, 0, "a"), (self.arm_b, state.b, a, "b")):
            inner, mine = arm.gauge(one.frames)
            G = np.zeros((self.size, len(mine)))
            G[at : at + arm.size] = inner
            columns.append(G)
            names += [f"{letter}: {name}" for name in mine]
        for letter in "ab"[self.absolute :]:
            G = np.zeros((self.size, 6))
            if letter == "a":
                G[:6], G[b:] = se3.adjoint_inv(state.a.frames[0]), se3.adjoint_inv(state.T)
            else:
                G[a : a + 6], G[b:] = -se3.adjoint_inv(state.b.frames[0]), np.eye(6)
            columns.append(G)
            names += [f"foot of arm {letter} {name}" for name in TWIST]
        return np.hstack(columns), tuple(names)

    def retract(self, state: DualState, y: np.ndarray) -> DualState:
        """Return the state after a step of the active components."""
        x = np.zeros(self.size)
        x[self.active] = y
        a, b = self.arm_a.size, self.arm_a.size + self.arm_b.size
        arms = self.arm_a.plus(state.a, x[:a]), self.arm_b.plus(state.b, x[a:b])
        return DualState(*arms, state.T @ se3.exp(x[b:]))

    def evaluate(self, state: DualState) -> list[Measurement]:
        """Return residuals with their derivatives by the active components."""
        return [chosen(one, self.active) for one in [*self.measurements(state), *self.priors(state)]]

    def relative(self, state: DualState) -> np.ndarray:
        """Return ``Z = T_a^-1 T_basea_baseb T_b`` (N, 4, 4)."""
        return se3.inv(self.arm_a.move(state.a).T) @ state.T @ self.arm_b.move(state.b).T

    def measurements(self, state: DualState, local: bool = False) -> list[Measurement]:
        """Return residuals of the data with their derivatives by all components."""
        Pa = self.arm_a.move(state.a).P
        W = state.T @ self.arm_b.move(state.b).P
        point = W[:, -1, :3, 3]
        base = twist_jacobian(np.broadcast_to(state.T, (len(W), 1, 4, 4)), point)[:, :, 0]
        J = [-self.arm_a.jacobian(state.a, Pa, point), self.arm_b.jacobian(state.b, W, point), base]
        R = Pa[:, -1, :3, :3].transpose(0, 2, 1)
        moved = np.concatenate(J, axis=2)
        moved = np.concatenate([R @ moved[:, :3], R @ moved[:, 3:]], axis=1)  # base of a -> tool of a
        Z = se3.inv(Pa[:, -1]) @ W[:, -1]
        found = [_relative(self.kinds[0], Z, moved)]
        if self.absolute:
            own = self.arm_a.jacobian(state.a, Pa, Pa[:, -1, :3, 3])
            wide = np.concatenate([own, np.zeros((*own.shape[:2], self.size - own.shape[2]))], axis=2)
            found.append(_relative(self.kinds[1], Pa[:, -1], wide))
        return found

    def priors(self, state: DualState, local: bool = False) -> Iterator[Measurement]:
        """Yield what is known before: amplitudes are small; links are nearly nominal, if they are to be held."""
        for arm, one, at in ((self.arm_a, state.a, 0), (self.arm_b, state.b, self.arm_a.size)):
            if arm.orders:
                yield amplitude_prior(arm, one, self.size, at)
            if self.prior is not None and arm.n > 1:
                yield link_prior(arm, one, self.prior, self.size, at)

    def never_seen(self) -> list[Suspect]:
        """Return how b's tool is turned."""
        at = self.arm_a.size + 6 * self.arm_b.n + 3
        turns = np.zeros((self.size, 3))
        turns[at : at + 3] = np.eye(3)
        return [Suspect(f"orientation of the tool of arm b about {'xyz'[k]}", turns[:, [k]]) for k in range(3)]

    def may_be_missing(self, state: DualState) -> list[Suspect]:
        """Return joints at rest, what both tools have in common, and the scale."""
        a, size = self.arm_a.size, self.size
        found = joints_at_rest(self.arm_a, state.a.frames, 0, size, " of arm a")
        found += joints_at_rest(self.arm_b, state.b.frames, a, size, " of arm b")
        Z = self.relative(state)[0]
        end_a, end_b = 6 * self.arm_a.n, a + 6 * self.arm_b.n
        scale = np.zeros((size, 1))
        scale[:a, 0] = arm_scale(self.arm_a, state.a.frames)
        scale[a:-6, 0] = arm_scale(self.arm_b, state.b.frames)
        scale[-6:-3, 0] = state.T[:3, :3].T @ state.T[:3, 3]
        scale[end_b : end_b + 3, 0] -= Z[:3, :3].T @ Z[:3, 3]
        if self.closed:
            tools = np.zeros((size, 6))
            tools[end_a : end_a + 6], tools[end_b : end_b + 6] = np.eye(6), se3.adjoint_inv(Z)
            advice = "Measure the pose of one tool."
            found.append(Suspect("common change of both tools", tools, advice))
        return [*found, Suspect("overall scale", scale, "Measure one length that is known.")]


def _relative(kind: Kind, T: np.ndarray, J: np.ndarray) -> Measurement:
    rows = np.flatnonzero(kind.visible.reshape(len(T), -1)[:, 0])
    if kind.name == "pose":
        r, J = pose_residual(T[rows], kind.values[rows], J[rows])
    else:
        r, J = kind.values[rows, 0] - T[rows, :3, 3], -J[rows, :3]
    return Measurement(r[:, kind.kept], J[:, kind.kept], kind.noise(rows), kind.classes, rows)
