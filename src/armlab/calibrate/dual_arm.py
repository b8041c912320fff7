"""Two arms that measure each other: both kinematics and where one stands in the base of the other.

    Z_i = T_a(q_a,i)^-1 T_basea_baseb T_b(q_b,i)

What is measured is the tool of b, its pose or a point, seen from the tool of a. One system for both arms and all
samples; nothing absolute is needed, and where the feet of the arms are is then a matter of convention.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.calibrate._arm import Arm
from armlab.calibrate._dual_problem import DualProblem, DualState
from armlab.calibrate._dual_solution import DualQuestion
from armlab.calibrate._kinematic_data import Kind, check_harmonics, check_joints, check_terms, measured_kinds
from armlab.calibrate._kinematic_question import check_weak, length_angle
from armlab.calibrate._kinematic_start import check_scale, hand_eye, kabsch
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Fit
from armlab.lie import se3
from armlab.models import DualArmCorrection
from armlab.robots import Robot

__all__ = ["fit_dual_arm"]

LIMITS = (0.05, 0.05)


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
    """Calibrate two arms from what one sees of the other.

    Parameters
    ----------
    robot_a, robot_b : nominal arms.
    q_a, q_b : (N, n) joint positions of the same moments [rad or m].
    pose : (N, 4, 4) of b's tool seen from a's tool; (4, 4) for a closed chain whose tools are held in a known pose.
    position : (N, 3) of b's tool point, in a's tool axes [m].
    closed : the tools are joined: b's tool does not move in a's. The pose may be unknown.
    absolute_a : (N, 4, 4) of a's tool in a frame that is then the base of a.
    visible : (N,), False where the relative measurement is missing.
    noise : of the relative measurement, as in `fit_kinematics`. None: estimated.
    noise_absolute : of `absolute_a`, (sd [m], sd [rad]) or a covariance; given where `noise` is.
    harmonics : orders of joint errors of both arms, see `fit_kinematics`.
    joint_terms_a, joint_terms_b : phi (N, n, L) of an arm, see `fit_kinematics`.
    prior, weak, robust, limits : see `fit_kinematics`.

    Returns
    -------
    Fit of `models.DualArmCorrection`. The parameters are the twists of the frames of a, of b, from their start; that of
    T_basea_baseb, which has no nominal value, is counted from the value found.

    Raises
    ------
    NotExcited : directions that the data do not tell, by name; of a closed chain always the overall scale and what both
        tools have in common, unless weak="prior" holds them. NotConverged : samples that do not belong together.
    ShapeError, ConfigError, UnknownName : see `fit_kinematics`.

    References
    ----------
    Bennett and Hollerbach (1991), IEEE T-RA 7(5), closed chains and their scale.
    """
    q_a, q_b = check_joints(robot_a, q_a, "q_a"), check_joints(robot_b, q_b, "q_b")
    if len(q_a) != len(q_b):
        raise ShapeError(
            f"Expected as many rows of q_a as of q_b, got {len(q_a)} and {len(q_b)}. Both are of the same moments."
        )
    check_weak(weak)
    orders = check_harmonics(harmonics)
    arms = [
        Arm.of(robot, q, orders, check_terms(terms, q.shape, name), "local_poe")
        for robot, q, terms, name in (
            (robot_a, q_a, joint_terms_a, "joint_terms_a"),
            (robot_b, q_b, joint_terms_b, "joint_terms_b"),
        )
    ]
    kinds, T = _measured(arms[0], arms[1], pose, position, closed, visible, noise)
    if absolute_a is not None:
        kinds += measured_kinds(len(q_a), {"pose": absolute_a}, None, noise_absolute)[0]
        if (noise is None) != (noise_absolute is None):
            raise ConfigError("Expected noise and noise_absolute together, got one of them. Give both or none.")
    held = length_angle(prior, "prior") if weak == "prior" else None
    problem = DualProblem(arms[0], arms[1], tuple(kinds), absolute_a is not None, closed, np.zeros(0, dtype=bool), held)
    used = np.concatenate([arms[0].existing, arms[1].existing, np.ones(6, dtype=bool)])
    problem = replace(problem, active=used if held is not None else _without_feet(problem))
    question = DualQuestion(problem, used, length_angle(limits, "limits"), weak == "prior")
    return question.fit(question.solve(DualState(arms[0].first(), arms[1].first(), T), robust))


def _without_feet(problem: DualProblem) -> np.ndarray:
    """Return the unknowns that remain when gauge and feet are left out; T_basea_baseb says where the feet are."""
    a, b = problem.arm_a.unbound.copy(), problem.arm_b.unbound.copy()
    b[:6] = False
    a[:6] &= problem.absolute
    return np.concatenate([a, b, np.ones(6, dtype=bool)])


def _measured(
    a: Arm, b: Arm, pose: Any, position: Any, closed: bool, visible: Any, noise: Any
) -> tuple[list[Kind], np.ndarray]:
    """Return the relative measurement and a first T_basea_baseb."""
    if (pose is None) == (position is None) and not (closed and position is None):
        raise ConfigError("Expected either pose or position of b's tool in a's, got both or none. Give one of them.")
    T_a, T_b = a.move(a.first()).T, b.move(b.first()).T
    if closed:
        if position is not None:
            raise ConfigError("Expected no position for a closed chain, got one. Give the pose (4, 4), or nothing.")
        pose = _closed_pose(T_a, T_b) if pose is None else pose
        pose = np.broadcast_to(np.asarray(pose, dtype=float), (len(T_a), 4, 4))
    kinds, _ = measured_kinds(len(T_a), {"pose": pose, "position": position}, visible, noise)
    kind = kinds[0]
    if kind.name == "position" and kind.values.shape[1] > 1:
        raise ShapeError(
            f"Expected position of shape ({len(T_a)}, 3), one point of b's tool, got {kind.values.shape}. Give one of "
            "the points."
        )
    rows = np.flatnonzero(kind.visible.reshape(len(T_a), -1)[:, 0])
    if len(rows) < 3:
        raise NotExcited(
            f"Expected at least 3 samples in which b is seen from a, got {len(rows)}. Measure more.",
            ["everything"],
            [f"{len(rows)} of at least 3 samples"],
        )
    if kind.name == "pose":
        check_scale(_size(T_a[:, :3, 3]) + _size(T_b[:, :3, 3]), _size(kind.values[rows, :3, 3]), "positions of poses")
        seen = T_a[rows] @ kind.values[rows] @ se3.inv(T_b[rows])
        return kinds, se3.project(np.mean(seen, axis=0))[0]
    seen = np.einsum("iab,ib->ia", T_a[rows, :3, :3], kind.values[rows, 0]) + T_a[rows, :3, 3]
    check_scale(_size(T_a[:, :3, 3]) + _size(T_b[:, :3, 3]), _size(kind.values[rows, 0]), "positions")
    return kinds, kabsch(T_b[rows, :3, 3], seen)


def _size(points: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=-1))))


def _closed_pose(T_a: np.ndarray, T_b: np.ndarray) -> np.ndarray:
    """Return Z of ``T_b = T_basea_baseb^-1 T_a Z``."""
    R, t, _, _ = hand_eye(T_a, T_b)
    return se3.from_rp(R, t)
