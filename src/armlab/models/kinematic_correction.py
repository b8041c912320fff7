"""Calibrated arms: identified constant frames and joint errors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import numbers
from armlab.errors import RobotError, ShapeError
from armlab.kinematics import forward, parameter_jacobian
from armlab.lie import se3, so3
from armlab.models.friction import freeze_arrays
from armlab.robots import Robot
from armlab.robots.comparison import check_same

COMMAND_ROUNDS = 50


def harmonic_basis(q: np.ndarray, harmonics: tuple[int, ...]) -> np.ndarray:
    """Return ``cos k q_j, sin k q_j`` for each k in `harmonics`: (..., n, 2 m)."""
    q, orders = numbers(q, "joint positions [rad]", ShapeError), numbers(harmonics, "orders of harmonics", ShapeError)
    if not q.ndim or orders.ndim != 1:
        raise ShapeError(f"Expected positions (..., n) and orders (m,), got shapes {q.shape} and {orders.shape}.")
    angles = q[..., None] * orders
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(*q.shape, 2 * len(orders))


@dataclass(frozen=True, eq=False, repr=False)
class KinematicCorrection(Shown):
    """Result of `calibrate.fit_kinematics`.

    Attributes
    ----------
    robot : the corrected arm, usable like any `Robot`. Its frame ``base`` is the measurement frame, and its tool
        is the measured tool; gravity is rotated with the mount.
    robot_name, robot_hash : the nominal robot.
    harmonics : orders k of the joint errors ``a_jk cos k q_j + b_jk sin k q_j``.
    amplitudes : (n, 2 m) ``a_j1 b_j1 a_j2 b_j2 ...`` [rad].
    coefficients : (L,) coefficients of the joint terms.
    cov : (d, d) covariance of 6 (n+1) frame errors ([v; w] of each frame in its own axes), n 2 m amplitudes and L
        coefficients.
    points : (K, 3) tool points in tool axes [m], if several were measured.
    anchor : (3,) fixed end point of measured distances, base axes [m], or None.
    length_offset, length_scale : errors of the distance instrument: measured = scale * true + offset.
    sources : SHA-256 and name of each log.
    """

    robot: Robot
    robot_name: str
    robot_hash: str
    harmonics: tuple[int, ...]
    amplitudes: np.ndarray
    coefficients: np.ndarray
    cov: np.ndarray
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    anchor: np.ndarray | None = None
    length_offset: float = 0.0
    length_scale: float = 1.0
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.robot, Robot):
            raise RobotError.no_robot(self.robot)
        n, L = self.robot.n, len(self.coefficients)
        d = 6 * (n + 1) + 2 * n * len(self.harmonics) + L
        shapes = {
            "amplitudes": (n, 2 * len(self.harmonics)),
            "coefficients": (L,),
            "cov": (d, d),
            "points": (len(self.points), 3),
            "anchor": (3,),
        }
        given = {name: shape for name, shape in shapes.items() if getattr(self, name) is not None}
        freeze_arrays(self, "a kinematic correction", given)

    @property
    def frames(self) -> np.ndarray:
        """(n+1, 4, 4) constant frames ``E_0 ... E_n`` of the corrected arm; see `robots.Robot`."""
        return self.robot.frames

    def check_robot(self, robot: Robot) -> None:
        """Raise an error unless `robot` is the calibrated arm.

        Parameters
        ----------
        robot : the arm before calibration.

        Raises
        ------
        ModelMismatchError : a different arm.
        RobotError : `robot` is not a `Robot`.
        """
        advice = "Calibrate this robot, or load the robot that was calibrated."
        check_same(robot, "the kinematic correction", self.robot_name, self.robot_hash, None, advice)

    def joints(self, q: ArrayLike, joint_terms: ArrayLike | None = None) -> np.ndarray:
        """Return the true joint positions: ``q_j + sum_k (a_jk cos k q_j + b_jk sin k q_j) + sum_l c_l phi_l,j``.

        Parameters
        ----------
        q : (..., n) joint positions reported by the robot [rad or m].
        joint_terms : phi (..., n, L), if the fit used any.

        Raises
        ------
        ShapeError : wrong number of joints or of terms.
        """
        q = numbers(q, "q", ShapeError)
        n, L = self.robot.n, len(self.coefficients)
        if q.shape[-1:] != (n,):
            raise ShapeError(f"Expected q of shape (..., {n}) for robot {self.robot.name!r}, got {q.shape}.")
        found = q + np.sum(harmonic_basis(q, self.harmonics) * self.amplitudes, axis=-1)
        if not L and joint_terms is None:
            return found
        terms = numbers(np.zeros(0) if joint_terms is None else joint_terms, "joint_terms", ShapeError)
        if terms.shape != (*q.shape, L):
            raise ShapeError(
                f"Expected joint_terms of shape {(*q.shape, L)}, got {terms.shape}. The correction was fitted with "
                f"L = {L}: pass the same terms, evaluated at these positions."
            )
        return found + terms @ self.coefficients

    def command(self, q: ArrayLike) -> np.ndarray:
        """Return the positions to command for the true joint positions q; inverse of `joints`.

        Parameters
        ----------
        q : (..., n) desired true joint positions [rad or m].

        Raises
        ------
        ShapeError : wrong number of joints, or a correction with joint terms, which depend on more than q.
        """
        target = numbers(q, "q", ShapeError)
        asked = target
        for _ in range(COMMAND_ROUNDS):
            before, asked = asked, asked + target - self.joints(asked)
            if np.array_equal(before, asked):
                break
        return asked

    def forward(self, q: ArrayLike, joint_terms: ArrayLike | None = None) -> np.ndarray:
        """Return T_base_tool (..., 4, 4) of the corrected arm, including joint errors.

        Parameters
        ----------
        q : (..., n) joint positions reported by the robot [rad or m].
        joint_terms : phi (..., n, L), if the fit used any.
        """
        return forward(self.robot, self.joints(q, joint_terms))

    def pose_cov(self, q: ArrayLike, joint_terms: ArrayLike | None = None) -> np.ndarray:
        """Return the covariance (..., 6, 6) of `forward`, [v; w]: v in base axes, w in tool axes [m, rad].

        ``C(q) = J(q) cov J(q)^T``. Unidentified directions have zero variance.

        Parameters
        ----------
        q : (..., n) joint positions reported by the robot [rad or m].
        joint_terms : phi (..., n, L), if the fit used any.
        """
        J = self.pose_jacobian(q, joint_terms)
        return J @ self.cov @ np.swapaxes(J, -1, -2)

    def pose_jacobian(self, q: ArrayLike, joint_terms: ArrayLike | None = None) -> np.ndarray:
        """Return the Jacobian (..., 6, d) of `forward` with respect to the parameters whose covariance is `cov`.

        Parameters
        ----------
        q : (..., n) joint positions reported by the robot [rad or m].
        joint_terms : phi (..., n, L), if the fit used any.
        """
        q = np.asarray(q, dtype=float)
        there = self.joints(q, joint_terms)
        J = parameter_jacobian(self.robot, there)
        J[..., 3:, :, :] = np.einsum("...ji,...jab->...iab", forward(self.robot, there)[..., :3, :3], J[..., 3:, :, :])
        turning = J[..., np.arange(self.robot.n), np.where(self.robot.prismatic, 2, 5)]
        parts = [J.reshape(*J.shape[:-2], -1)]
        if self.harmonics:
            waves = turning[..., None] * harmonic_basis(q, self.harmonics)[..., None, :, :]
            parts.append(waves.reshape(*waves.shape[:-2], -1))
        if len(self.coefficients):
            parts.append(turning @ np.asarray(joint_terms, dtype=float))
        return np.concatenate(parts, axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class DualArmCorrection(Shown):
    """Result of `calibrate.fit_dual_arm`: two arms and their relative base pose.

    Attributes
    ----------
    arm_a, arm_b : the corrected arms.
    T_basea_baseb : (4, 4) pose of the base of b in the base frame of a.
    cov : (d, d) joint covariance of the parameters of arm a, those of arm b, and the twist [v; w] of T_basea_baseb in
        its own axes.
    sources : SHA-256 and name of each log.
    """

    arm_a: KinematicCorrection
    arm_b: KinematicCorrection
    T_basea_baseb: np.ndarray
    cov: np.ndarray
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        d = len(self.arm_a.cov) + len(self.arm_b.cov) + 6
        freeze_arrays(self, "two arms", {"T_basea_baseb": (4, 4), "cov": (d, d)})

    def forward(
        self,
        q_a: ArrayLike,
        q_b: ArrayLike,
        joint_terms_a: ArrayLike | None = None,
        joint_terms_b: ArrayLike | None = None,
    ) -> np.ndarray:
        """Return the pose of tool b relative to tool a: ``Z = T_a^-1 T_basea_baseb T_b`` (..., 4, 4).

        Parameters
        ----------
        q_a, q_b : (..., n) joint positions reported by the robots [rad or m].
        joint_terms_a, joint_terms_b : phi (..., n, L), if the fit used any.
        """
        T_toola_basea = se3.inv(self.arm_a.forward(q_a, joint_terms_a))
        T_baseb_toolb = self.arm_b.forward(q_b, joint_terms_b)
        return T_toola_basea @ self.T_basea_baseb @ T_baseb_toolb

    def pose_cov(
        self,
        q_a: ArrayLike,
        q_b: ArrayLike,
        joint_terms_a: ArrayLike | None = None,
        joint_terms_b: ArrayLike | None = None,
    ) -> np.ndarray:
        """Return the covariance (..., 6, 6) of `forward`, [v; w]: v in the axes of tool a, w in the axes of tool b [m,
        rad].

        ``C = J cov J^T``. Unidentified directions have zero variance.

        Parameters
        ----------
        q_a, q_b : (..., n) joint positions reported by the robots [rad or m].
        joint_terms_a, joint_terms_b : phi (..., n, L), if the fit used any.
        """
        J = self.pose_jacobian(q_a, q_b, joint_terms_a, joint_terms_b)
        return J @ self.cov @ np.swapaxes(J, -1, -2)

    def pose_jacobian(
        self,
        q_a: ArrayLike,
        q_b: ArrayLike,
        joint_terms_a: ArrayLike | None = None,
        joint_terms_b: ArrayLike | None = None,
    ) -> np.ndarray:
        """Return the Jacobian (..., 6, d) of `forward` with respect to the parameters whose covariance is `cov`.

        With errors (v, w) of both tools and of the base of b, ``v_Z = R_a^T (R_ab v_b - v_a + R_ab (v_ab - [p_b] w_ab))
        + [p_Z] w_a`` and ``w_Z = w_b + R_b^T w_ab - R_Z^T w_a``.

        Parameters
        ----------
        q_a, q_b : (..., n) joint positions reported by the robots [rad or m].
        joint_terms_a, joint_terms_b : phi (..., n, L), if the fit used any.
        """
        T_a, T_b = self.arm_a.forward(q_a, joint_terms_a), self.arm_b.forward(q_b, joint_terms_b)
        J_a, J_b = self.arm_a.pose_jacobian(q_a, joint_terms_a), self.arm_b.pose_jacobian(q_b, joint_terms_b)
        Z = se3.inv(T_a) @ self.T_basea_baseb @ T_b
        back = np.swapaxes(T_a[..., :3, :3], -1, -2)
        turned, to_tool = back @ self.T_basea_baseb[:3, :3], np.swapaxes(T_b[..., :3, :3], -1, -2)
        by_a = [
            so3.hat(Z[..., :3, 3]) @ J_a[..., 3:, :] - back @ J_a[..., :3, :],
            -np.swapaxes(Z[..., :3, :3], -1, -2) @ J_a[..., 3:, :],
        ]
        by_b = [turned @ J_b[..., :3, :], J_b[..., 3:, :]]
        by_base = [
            np.concatenate([turned, -turned @ so3.hat(T_b[..., :3, 3])], axis=-1),
            np.concatenate([np.zeros_like(to_tool), to_tool], axis=-1),
        ]
        return np.concatenate([np.concatenate(part, axis=-2) for part in (by_a, by_b, by_base)], axis=-1)
