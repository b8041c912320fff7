"""Calibration of two arms that measure each other: the kinematics of both arms and the relative pose of their bases.

    Z_i = T_a(q_a,i)^-1 T_basea_baseb T_b(q_b,i)

The measurement Z is the pose of b's tool, or the position of a point on it, relative to a's tool. One system of
equations covers both arms and all samples. Absolute measurements are optional; without them, the pose of each base
relative to its arm is a matter of convention. The motion of a point on b's tool, in a's tool axes, is the motion due to
the frames and the base of b minus the motion due to the frames of a.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab.calibrate.kinematics.identifiability import UnobservableDirection, arm_scale, far_links, joints_at_rest
from armlab.calibrate.kinematics.measurements import Kind, check_harmonics, check_joints, check_terms, measured_kinds
from armlab.calibrate.kinematics.model import TWIST, Arm, ArmState, amplitude_prior, chosen, link_prior, pose_residual
from armlab.calibrate.kinematics.solve import (
    KinematicEstimation,
    check_scale,
    check_weak,
    corrected_arm,
    hand_eye,
    kabsch,
    length_angle,
    size_of,
    spread_of,
)
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Fit, Measurement
from armlab.estimation.nonlinear import NonlinearSolution
from armlab.kinematics.forward import twist_jacobian
from armlab.lie import se3
from armlab.models import DualArmCorrection
from armlab.robots import Robot

LIMITS = (0.05, 0.05)  # largest accepted standard deviation along any direction [m, rad]


def fit_dual_arm(
    robot_a: Robot,
    robot_b: Robot,
    q_a: ArrayLike,
    q_b: ArrayLike,
    *,
    pose: ArrayLike | None = None,
    position: ArrayLike | None = None,
    closed: bool = False,
    absolute_a: ArrayLike | None = None,
    visible: ArrayLike | None = None,
    noise: Any = None,
    noise_absolute: Any = None,
    harmonics: Sequence[int] = (),
    joint_terms_a: ArrayLike | None = None,
    joint_terms_b: ArrayLike | None = None,
    prior: float | tuple[float, float] = 0.1,
    weak: str = "refuse",
    robust: bool = False,
    limits: tuple[float, float] = LIMITS,
) -> Fit[DualArmCorrection]:
    """Calibrate two arms from relative measurements of their tools.

    Parameters
    ----------
    robot_a, robot_b : nominal arms.
    q_a, q_b : (N, n) simultaneous joint positions [rad or m].
    pose : (N, 4, 4) poses of b's tool relative to a's tool; (4, 4) if a closed chain holds the tools in a known pose.
    position : (N, 3) positions of b's tool point in a's tool axes [m].
    closed : True if the tools are rigidly joined; their relative pose may be unknown.
    absolute_a : (N, 4, 4) poses of a's tool in an external frame, which then defines the base of a.
    visible : (N,) mask, False for missing relative measurements.
    noise : noise of the relative measurement, as in `fit_kinematics`. Default: estimated.
    noise_absolute : noise of `absolute_a`, (sd [m], sd [rad]) or a covariance; required with `noise`.
    harmonics : orders of the joint errors of both arms, as in `fit_kinematics`.
    joint_terms_a, joint_terms_b : phi (N, n, L) of each arm, as in `fit_kinematics`.
    prior, weak, robust, limits : as in `fit_kinematics`.

    Returns
    -------
    Fit of a `models.DualArmCorrection`
        The parameters are the twists of the frames of a and b relative to their nominal values. The twist of
        T_basea_baseb, which has no nominal value, is relative to its estimate.

    Raises
    ------
    NotExcited : unidentifiable directions (named in the message). A closed chain cannot determine the overall scale or
        a common motion of both tools; weak="prior" constrains them.
    NotConverged : inconsistent samples.
    ShapeError, ConfigError, UnknownName : as in `fit_kinematics`.

    References
    ----------
    Bennett and Hollerbach (1991), IEEE T-RA 7(5) (closed chains and their scale).
    """
    q_a, q_b = check_joints(robot_a, q_a, "q_a"), check_joints(robot_b, q_b, "q_b")
    if len(q_a) != len(q_b):
        raise ShapeError(
            f"Expected equal numbers of rows of q_a and q_b, got {len(q_a)} and {len(q_b)}. Pass simultaneous samples."
        )
    check_weak(weak)
    orders = check_harmonics(harmonics)
    a = Arm.of(robot_a, q_a, orders, check_terms(joint_terms_a, q_a.shape, "joint_terms_a"), "local_poe")
    b = Arm.of(robot_b, q_b, orders, check_terms(joint_terms_b, q_b.shape, "joint_terms_b"), "local_poe")
    kinds, T = _measured(a, b, pose, position, closed, visible, noise)
    if absolute_a is not None:
        kinds += measured_kinds(len(q_a), {"pose": absolute_a}, None, noise_absolute)[0]
        if (noise is None) != (noise_absolute is None):
            raise ConfigError(
                "Expected noise and noise_absolute together, got only one of them. Pass both or omit both."
            )
    held = length_angle(prior, "prior") if weak == "prior" else None
    problem = DualProblem(a, b, tuple(kinds), absolute_a is not None, closed, np.zeros(0, dtype=bool), held)
    used = np.concatenate([a.existing, b.existing, np.ones(6, dtype=bool)])
    problem = replace(problem, active=used if held is not None else _without_bases(problem))
    start = DualState(a.first(), b.first(), T)
    estimation = DualArmEstimation(problem, used, length_angle(limits, "limits"), weak == "prior", start)
    return estimation.fit(estimation.solve(robust))


def _without_bases(problem: DualProblem) -> np.ndarray:
    """Return the mask of unknowns without the gauge and the bases; T_basea_baseb replaces the bases."""
    a, b = problem.arm_a.unbound.copy(), problem.arm_b.unbound.copy()
    b[:6] = False
    a[:6] &= problem.absolute
    return np.concatenate([a, b, np.ones(6, dtype=bool)])


def _measured(
    a: Arm, b: Arm, pose: Any, position: Any, closed: bool, visible: Any, noise: Any
) -> tuple[list[Kind], np.ndarray]:
    """Return the relative measurement and an initial guess of T_basea_baseb."""
    if (pose is None) == (position is None) and not (closed and position is None):
        raise ConfigError(
            "Expected either the pose or the position of b's tool relative to a's tool, got both or neither. "
            "Pass exactly one."
        )
    T_a, T_b = (arm.move(arm.first())[:, -1] for arm in (a, b))
    if closed:
        if position is not None:
            raise ConfigError(
                "Expected no position for a closed chain, got position=. Omit position=, and pass pose= (4, 4) if "
                "the pose is known."
            )
        if pose is None:  # Z of T_b = T_basea_baseb^-1 T_a Z
            pose = se3.from_rp(*hand_eye(T_a, T_b)[:2])
        pose = np.broadcast_to(np.asarray(pose, dtype=float), (len(T_a), 4, 4))
    kinds, _ = measured_kinds(len(T_a), {"pose": pose, "position": position}, visible, noise)
    kind = kinds[0]
    if kind.name == "position" and kind.values.shape[1] > 1:
        raise ShapeError(
            f"Expected position of shape ({len(T_a)}, 3), one point on b's tool, got {kind.values.shape}. Pass only "
            "one point."
        )
    rows = np.flatnonzero(kind.visible.reshape(len(T_a), -1)[:, 0])
    if len(rows) < 3:
        raise NotExcited(
            f"Expected at least 3 samples with a relative measurement, got {len(rows)}. Measure more samples.",
            ["everything"],
            [f"{len(rows)} samples (at least 3 required)"],
        )
    size = size_of(T_a[:, :3, 3]) + size_of(T_b[:, :3, 3])
    if kind.name == "pose":
        check_scale(size, size_of(kind.values[rows, :3, 3]), "positions of poses")
        seen = T_a[rows] @ kind.values[rows] @ se3.inv(T_b[rows])
        return kinds, se3.project(np.mean(seen, axis=0))[0]
    seen = np.einsum("iab,ib->ia", T_a[rows, :3, :3], kind.values[rows, 0]) + T_a[rows, :3, 3]
    check_scale(size, size_of(kind.values[rows, 0]), "positions")
    return kinds, kabsch(T_b[rows, :3, 3], seen)


class DualState(NamedTuple):
    a: ArmState
    b: ArmState
    T: np.ndarray


@dataclass(frozen=True, eq=False)
class DualProblem:
    """Two arms and their measurements."""

    arm_a: Arm
    arm_b: Arm
    kinds: tuple[Kind, ...]  # relative pose or position, then optionally the absolute pose of arm a
    absolute: bool  # whether the absolute pose is given
    closed: bool  # whether b's tool is fixed relative to a's tool
    active: np.ndarray  # (d,) mask of the components of a step
    prior: tuple[float, float] | None  # standard deviations (metres, radians) of the links; None: no prior

    @property
    def size(self) -> int:
        """Number d of unknowns, including the gauge: arm a, arm b, twist of T_basea_baseb."""
        return self.arm_a.size + self.arm_b.size + 6

    @property
    def n(self) -> int:
        return len(self.arm_a.q)

    @property
    def rows(self) -> int:
        return self.n

    @property
    def waves(self) -> int:
        return self.arm_a.waves[0].size + self.arm_b.waves[0].size

    @property
    def names(self) -> tuple[str, ...]:
        arms = [f"{letter}: {name}" for letter, arm in (("a", self.arm_a), ("b", self.arm_b)) for name in arm.names]
        return (*arms, *(f"base of b {name}" for name in TWIST))

    @property
    def units(self) -> tuple[str, ...]:
        return (*self.arm_a.units, *self.arm_b.units, *("m",) * 3, *("rad",) * 3)

    def sizes(self, length: float, angle: float) -> np.ndarray:
        """Return limits (d,): `length` for unknowns in metres, `angle` for unknowns in radians."""
        arms = [arm.sizes(length, angle) for arm in (self.arm_a, self.arm_b)]
        return np.concatenate([*arms, np.repeat([length, angle], 3)])

    def values(self, state: DualState) -> np.ndarray:
        """Return all unknowns (d,); frames are twists relative to the start, and the twist of T is zero."""
        parts = []
        for arm, one in ((self.arm_a, state.a), (self.arm_b, state.b)):
            parts += [arm.corrections(one.frames).ravel(), one.amplitudes.ravel(), one.coefficients]
        return np.concatenate([*parts, np.zeros(6)])

    def gauge(self, state: DualState, used: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the unobservable directions (d, g) of the joints and the bases, and their names."""
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
            names += [f"base of arm {letter} {name}" for name in TWIST]
        return np.hstack(columns), tuple(names)

    def retract(self, state: DualState, y: np.ndarray) -> DualState:
        x = np.zeros(self.size)
        x[self.active] = y
        a, b = self.arm_a.size, self.arm_a.size + self.arm_b.size
        arms = self.arm_a.plus(state.a, x[:a]), self.arm_b.plus(state.b, x[a:b])
        return DualState(*arms, state.T @ se3.exp(x[b:]))

    def evaluate(self, state: DualState) -> list[Measurement]:
        return [chosen(one, self.active) for one in [*self.measurements(state), *self.priors(state)]]

    def relative(self, state: DualState) -> np.ndarray:
        return se3.inv(self.arm_a.move(state.a)[:, -1]) @ state.T @ self.arm_b.move(state.b)[:, -1]

    def measurements(self, state: DualState, local: bool = False) -> list[Measurement]:
        Pa = self.arm_a.move(state.a)
        W = state.T @ self.arm_b.move(state.b)
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
        """Yield the priors on the amplitudes and, if requested, on the links."""
        for arm, one, at in ((self.arm_a, state.a, 0), (self.arm_b, state.b, self.arm_a.size)):
            if arm.orders:
                yield amplitude_prior(arm, one, self.size, at)
            if self.prior is not None and arm.n > 1:
                yield link_prior(arm, one, self.prior, self.size, at)


def _relative(kind: Kind, T: np.ndarray, J: np.ndarray) -> Measurement:
    rows = np.flatnonzero(kind.visible.reshape(len(T), -1)[:, 0])
    if kind.name == "pose":
        r, J = pose_residual(T[rows], kind.values[rows], J[rows])
    else:
        r, J = kind.values[rows, 0] - T[rows, :3, 3], -J[rows, :3]
    return Measurement(r[:, kind.kept], J[:, kind.kept], kind.noise(rows), kind.classes, rows)


@dataclass(frozen=True, eq=False)
class DualArmEstimation(KinematicEstimation[DualState]):
    """Estimation of two arms that measure each other."""

    problem: DualProblem

    def rigid(self) -> np.ndarray:
        mask, first = np.ones(self.problem.size, dtype=bool), 0
        for arm in (self.problem.arm_a, self.problem.arm_b):
            mask[first + 6 : first + 6 * arm.n] = False
            mask[first + 6 * arm.n + 6 : first + arm.size] = False
            first += arm.size
        return mask

    def nature(self, state: DualState) -> list[UnobservableDirection]:
        """Return the orientation directions of b's tool, which position measurements never determine."""
        problem = self.problem
        at = problem.arm_a.size + 6 * problem.arm_b.n + 3
        turns = np.zeros((problem.size, 3))
        turns[at : at + 3] = np.eye(3)
        return [
            UnobservableDirection(f"orientation of the tool of arm b about {'xyz'[k]}", turns[:, [k]]) for k in range(3)
        ]

    def candidates(self, state: DualState) -> list[UnobservableDirection]:
        """Return the candidate unobservable directions: joints at rest, the common motion of both tools, and the
        overall scale."""
        arm_a, arm_b = self.problem.arm_a, self.problem.arm_b
        a, size = arm_a.size, self.problem.size
        found = joints_at_rest(arm_a, state.a.frames, 0, size, " of arm a")
        found += joints_at_rest(arm_b, state.b.frames, a, size, " of arm b")
        Z = self.problem.relative(state)[0]
        end_a, end_b = 6 * arm_a.n, a + 6 * arm_b.n
        scale = np.zeros((size, 1))
        scale[:a, 0] = arm_scale(arm_a, state.a.frames)
        scale[a:-6, 0] = arm_scale(arm_b, state.b.frames)
        scale[-6:-3, 0] = state.T[:3, :3].T @ state.T[:3, 3]
        scale[end_b : end_b + 3, 0] -= Z[:3, :3].T @ Z[:3, 3]
        if self.problem.closed:
            tools = np.zeros((size, 6))
            tools[end_a : end_a + 6], tools[end_b : end_b + 6] = np.eye(6), se3.adjoint_inv(Z)
            advice = "Measure the pose of one tool."
            found.append(UnobservableDirection("common change of both tools", tools, advice))
        return [*found, UnobservableDirection("overall scale", scale, "Measure one known length.")]

    def fit(self, found: NonlinearSolution[DualState]) -> Fit[DualArmCorrection]:
        problem, state = self.problem, found.value
        tool = np.eye(6)[:, 3:] if problem.kinds[0].name == "position" else np.zeros((6, 0))
        a, _ = problem.arm_a.smallest(state.a.frames, np.zeros((6, 0)), np.zeros((6, 0)))
        b, _ = problem.arm_b.smallest(state.b.frames, np.zeros((6, 0)), tool)
        state = DualState(state.a._replace(frames=a), state.b._replace(frames=b), se3.project(state.T)[0])
        return self.result(found, state, self._value, ())

    def spaces(self) -> list[float]:
        """Return the workspace size of each measurement [m]; for a closed chain, the workspace of arm a."""
        problem = self.problem
        places = [kind.values[kind.visible.reshape(len(kind.values), -1)[:, 0]] for kind in problem.kinds]
        if problem.closed:
            places[0] = problem.arm_a.move(problem.arm_a.first())[:, -1]
        return [spread_of(seen[:, 0] if seen.shape[1:] == (1, 3) else seen[:, :3, 3]) for seen in places]

    def doubts(self, state: DualState) -> list[str]:
        a, b = self.problem.arm_a, self.problem.arm_b
        return far_links(a, state.a.frames, " of arm a") + far_links(b, state.b.frames, " of arm b")

    def _value(self, state: DualState, whole: np.ndarray) -> DualArmCorrection:
        problem, a = self.problem, self.problem.arm_a.size
        arm_a = corrected_arm(problem.arm_a, state.a, whole[:a, :a])
        return DualArmCorrection(arm_a, corrected_arm(problem.arm_b, state.b, whole[a:-6, a:-6]), state.T, whole)
