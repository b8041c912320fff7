"""The torque model of one robot: rigid body, friction, ripple, and how uncertain it is.

    tau / gains = Y(q, qd, qdd) pi + rotor qdd + F_f(qd, z) + ripple(q) - J^T F + e,   e ~ N(0, C_tau(qd))

with the torque tau that each joint reads; all else is in true newton metres. F is the wrench by the environment on the
robot, in base axes, at the tool point.
`link_parameters` is the smallest parameter vector that gives the identified base parameters: it evaluates the model
exactly and is not a set of masses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from armlab.errors import ModelMismatchError, RobotError, ShapeError
from armlab.kernels import Chain, Drive, MomentumEstimator, WrenchEstimator, model_torque
from armlab.models.coupled import CoupledKernel, CoupledMotors
from armlab.models.friction import Friction, FrictionBound, Ripple
from armlab.models.momentum import MomentumNoise
from armlab.models.quality import Quality
from armlab.models.rbf import FrictionMap
from armlab.models.ripple import RippleLines
from armlab.models.training import Training
from armlab.models.velocity_covariance import KINDS, VelocityCovariance
from armlab.models.warm_up import WarmUp
from armlab.robots import Robot

__all__ = ["TorqueModel"]

SIGN = "environment_on_robot"
WEIGHTLESS = 1e-9


@dataclass(frozen=True, eq=False)
class TorqueModel:
    """An identified torque model, bound to one robot.

    Attributes
    ----------
    robot_name, robot_hash : the robot it belongs to; `check_robot` refuses another.
    frames, prismatic, gravity : its kinematics (n + 1, 4, 4), (n,), and gravity (3,) [m/s^2] in base axes.
    link_parameters : (n, 10) in link frames, order m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
    rotor : (n,) rotor inertia [kg m^2]. friction, ripple, covariance : the other terms.
    bound : of friction near rest, for the estimators that take it as bounded.
    cutoff : corner [Hz] of the causal filter on the torque residual that `covariance` belongs to.
    base_names, base_values, base_cov : the identified base parameters with their covariance while the gains hold.
    gains : (n,) torque as it is read over true torque, 1 when left out; gain_cov : (n, n) of them, 0 when left out.
    quality : how well it fits. training : the ranges of the data behind it.
    sources : SHA-256 and name of each log.
    lines, friction_map, warm_up : parts of the drives that `identify.fit_friction` adds where they win, or None.
    momentum : noise of torque and velocity for the momentum estimators, or None: then there is none.
    coupled : motors that move several joints, or None.
    quasi_static : True for gravity, friction and offset alone: no torque comes with velocity or acceleration of links.
    """

    robot_name: str
    robot_hash: str
    frames: np.ndarray
    prismatic: np.ndarray
    gravity: np.ndarray
    link_parameters: np.ndarray
    rotor: np.ndarray
    friction: Friction
    ripple: Ripple
    covariance: VelocityCovariance
    bound: FrictionBound
    cutoff: float
    base_names: tuple[str, ...]
    base_values: np.ndarray
    base_cov: np.ndarray
    quality: Quality
    training: Training
    sources: tuple[str, ...] = field(default=())
    lines: RippleLines | None = None
    friction_map: FrictionMap | None = None
    warm_up: WarmUp | None = None
    momentum: MomentumNoise | None = None
    coupled: CoupledMotors | None = None
    quasi_static: bool = False
    gains: np.ndarray = field(default_factory=lambda: np.ones(0))
    gain_cov: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        """Check shapes and freeze the arrays."""
        n, p = len(self.rotor), len(self.base_names)
        if not np.size(self.gains):
            object.__setattr__(self, "gains", np.ones(n))
        if not np.size(self.gain_cov):
            object.__setattr__(self, "gain_cov", np.zeros((n, n)))
        shapes = {
            "frames": (n + 1, 4, 4), "prismatic": (n,), "gravity": (3,), "link_parameters": (n, 10), "rotor": (n,),
            "base_values": (p,), "base_cov": (p, p), "gains": (n,), "gain_cov": (n, n),
        }  # fmt: skip
        for name, shape in shapes.items():
            values = np.array(getattr(self, name), dtype=bool if name == "prismatic" else float)
            if values.shape != shape or not np.all(np.isfinite(values)):
                raise ShapeError(f"Expected finite {name} of shape {shape} for {n} joints, got shape {values.shape}.")
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if np.any(self.gains <= 0):
            raise ShapeError(f"Expected gains above 0, got {self.gains.tolist()}. Identify again.")
        if self.momentum is not None and len(self.momentum.memory) != n:
            raise ShapeError(f"Expected momentum noise of {n} joints, got {len(self.momentum.memory)}.")
        if self.coupled is not None and self.coupled.ratios.shape[1] != n:
            raise ShapeError(f"Expected coupled motors of {n} joints, got ratios {self.coupled.ratios.shape}.")
        lengths = len(self.friction.delta), len(self.ripple.cycles), len(self.covariance.C0), len(self.bound.speed)
        lengths = (*lengths, len(self.training.q_min))
        if lengths != (n,) * 5 or not 0 < self.cutoff < np.inf:
            raise ShapeError(
                f"Expected friction, ripple, covariance, bound and training of {n} joints and a cut-off above 0 Hz, "
                f"got {lengths} joints and {self.cutoff:g} Hz."
            )
        _ = self.drive  # refuses parts of another number of joints

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.rotor)

    @cached_property
    def chain(self) -> Chain:
        """Kinematics and dynamics kernel of the robot."""
        return Chain(self.frames, self.prismatic)

    @property
    def _weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Gravity and link parameters as the kernels take them.

        The torque of gravity is linear in both, that of motion in the link parameters alone: a quasi-static model moves
        a factor of 1e9 from one to the other, and what is left of the torque of motion is below rounding.
        """
        share = WEIGHTLESS if self.quasi_static else 1.0
        return self.gravity / share, share * self.link_parameters

    @property
    def drive(self) -> Drive:
        """Kernel of friction, ripple and warm-up: the one place that evaluates them."""
        return Drive(
            self.friction.rows,
            self.ripple.rows,
            None if self.lines is None else self.lines.kernel_rows(),
            None if self.friction_map is None else self.friction_map.kernel_rows(),
            None if self.warm_up is None else self.warm_up.kernel_rows(),
        )

    def check_robot(self, robot: Robot) -> None:
        """Raise `ModelMismatchError` unless `robot` is the one of this model, `RobotError` when it is none."""
        if not isinstance(robot, Robot):
            raise RobotError.no_robot(robot)
        if robot.hash != self.robot_hash:
            raise ModelMismatchError(
                f"Expected robot {self.robot_name!r} ({self.robot_hash[:12]}), got {robot.name!r} ({robot.hash[:12]}). "
                "A torque model is bound to one robot description: identify again for this one."
            )

    def rigid_torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return gravity, inertial and rotor torque (..., n) [N m], true; all inputs (..., n)."""
        torque = self.chain.rnea(q, qd, qdd, *self._weights) + self.rotor * qdd
        return torque if self.coupled is None else torque + self.coupled.inertial(qdd)

    def torque(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray | None = None, dt: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the torque (N, n) [N m] that is read along a record without contact: true torque times the gains.

        The presliding state runs through the rows in order, from 0 at the first. A row with a NaN gives NaN and leaves
        the state alone.

        Parameters
        ----------
        q, qd : (N, n) positions [rad] and velocities [rad/s] in time order.
        qdd : (N, n) accelerations [rad/s^2]; zero when left out.
        dt : (N,) steps [s] over which the drives warm up; they stay as warm as at the start when left out.
        """
        q, qd = np.atleast_2d(q), np.atleast_2d(qd)
        qdd = np.zeros_like(q) if qdd is None else np.atleast_2d(qdd)
        torque = model_torque(self.chain, *self._weights, self.rotor, self.drive, q, qd, qdd, dt)
        return self.gains * (torque if self.coupled is None else torque + self.coupled.torque(qd, qdd))

    def estimator_kernel(
        self, prior: np.ndarray, method: int = 0, point: np.ndarray | None = None
    ) -> WrenchEstimator | CoupledKernel:
        """Return a fresh estimator kernel with this model's numbers.

        Parameters
        ----------
        prior : (6,) prior variances of the wrench [N^2, (N m)^2].
        method : 0 map, 1 bounded, 2 clip, 3 interval, 4 ls, 5 lund.
        point : (3,) known contact in tool axes [m], or None.
        """
        b = self.bound
        kernel = WrenchEstimator(
            self.chain,
            *self._weights,
            self.rotor,
            self.drive,
            self.gains,
            self._gain_variance,
            self._covariance_rows(self.covariance.alpha2),
            np.stack([b.torque, b.speed, b.floor]),
            np.asarray(prior, dtype=float),
            self.cutoff,
            method,
            point,
        )
        return kernel if self.coupled is None else CoupledKernel(kernel, self.coupled, self.gains)

    def momentum_kernel(
        self,
        prior: np.ndarray,
        rate: np.ndarray,
        leak: np.ndarray | None = None,
        gain: float = 30.0,
        filters: bool = True,
        biased: bool = False,
        point: np.ndarray | None = None,
    ) -> MomentumEstimator | CoupledKernel:
        """Return a fresh momentum estimator kernel with this model's numbers.

        The factor alpha^2 of the filter is on everything that is random in it, so that it changes the covariance and
        not the estimate; what the torques do not show keeps its prior.

        Parameters
        ----------
        prior : (6,) prior variances of the wrench [N^2, (N m)^2].
        rate : (6,) intensity of its random walk [N^2/s, (N m)^2/s]. leak : (6,) [1/s], or None for the one that
            keeps the prior: ``alpha^2 rate / (2 prior)``.
        gain : of the observer [1/s].
        filters : Kalman filter, else the observer. biased : with a friction error per joint.
        point : (3,) known contact in tool axes [m], or None.

        Raises
        ------
        ModelMismatchError : when the model has no momentum noise.
        """
        noise = self.momentum
        if noise is None:
            raise ModelMismatchError(
                "Expected a model with the noise of torque and velocity that momentum estimators need, got one without "
                "(of an older file?). Identify again, or take a static method."
            )
        alpha2 = noise.alpha2_kf if filters else noise.alpha2_observer
        prior, rate = np.asarray(prior, dtype=float), alpha2 * np.asarray(rate, dtype=float)
        kernel = MomentumEstimator(
            self.chain,
            *self._weights,
            self.rotor,
            self.drive,
            self.gains,
            self._gain_variance,
            self._covariance_rows(alpha2),
            prior,
            noise.memory,
            np.sqrt(alpha2) * noise.qd_noise,
            rate,
            rate / (2.0 * prior) if leak is None else leak,
            gain,
            filters,
            biased,
            point,
        )
        return kernel if self.coupled is None else CoupledKernel(kernel, self.coupled, self.gains)

    @property
    def _gain_variance(self) -> float:
        """Of the common share by which the gains may be off, and every force with them.

        The mean of their variances stands for it: less where they are independent, more for the one known worst. The
        torque of a joint without one is not measured, or its gain is known.
        """
        variances = np.diag(self.gain_cov)
        return float(np.sum(variances) / max(np.count_nonzero(variances), 1))

    def _covariance_rows(self, alpha2: float) -> np.ndarray:
        c = self.covariance
        kind = float(KINDS.index(c.kind))
        return np.stack([alpha2 * c.C0, alpha2 * c.Cinf, c.shape, np.full(self.n, kind)])
