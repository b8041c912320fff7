"""Torque model of one robot: rigid body, friction, ripple, and uncertainty.

    tau / gains = x + rotor qdd + F_f(qd, z) + load s |x| + ripple(q) + e,   x = Y(q, qd, qdd) pi - J^T F

The error e has covariance ``C_tau = diag(s^2(qd) + doubt^2 (J^T F)^2)``. tau is the measured torque of each joint; all
other terms are in true newton metres. F is the wrench exerted by the environment on the robot, in base axes, at the
tool point. `link_parameters` is the minimum-norm parameter vector for the identified base parameters: it reproduces the
model torques exactly, but its masses are not physical.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from armlab._display import Shown, html_table
from armlab._numbers import still
from armlab.errors import ModelMismatchError, RobotError, ShapeError
from armlab.kernels import Chain, Drive, MomentumEstimator, RigidBody, WrenchEstimator, model_torque
from armlab.models.friction import Friction, FrictionBound, FrictionMap, Ripple, RippleLines, WarmUp, freeze_arrays
from armlab.models.uncertainty import KINDS, OF_FRICTION, MomentumNoise, ParameterCovariance, VelocityCovariance
from armlab.robots import Robot, inertia
from armlab.robots.comparison import check_same

# Coupled motors, as in wrists: each motor moves several joints, so its inertia and friction act on all of them.
#
# Motor k rotates by ``theta_k = c_k q`` (in units of its joint), so power conservation gives::
#
#     tau = sum_k c_k^T (inertia_k c_k qdd + viscous_k c_k qd + coulomb_k tanh(c_k qd / smooth_speed_k))
#
# No combination of link parameters and joint friction produces these torques, so they are separate terms.


@dataclass(frozen=True, eq=False)
class CoupledMotors:
    """K coupled motors of an arm with n joints.

    `ratios`: (K, n) with one row c_k of transmission ratios per motor. `inertia`: (K,) [kg m^2]. `viscous`: (K,) [N m
    s/rad]. `coulomb`: (K,) [N m]. `smooth_speed`: (K,) [rad/s].
    """

    ratios: np.ndarray
    inertia: np.ndarray
    viscous: np.ndarray
    coulomb: np.ndarray
    smooth_speed: np.ndarray

    def __post_init__(self) -> None:
        ratios = np.atleast_2d(still(self.ratios, "ratios of coupled motors"))
        shapes = dict.fromkeys(("inertia", "viscous", "coulomb", "smooth_speed"), (len(ratios),))
        freeze_arrays(self, f"{len(ratios)} coupled motors", {"ratios": ratios.shape, **shapes})
        if np.any(self.smooth_speed <= 0):
            raise ShapeError("Expected smooth_speed > 0 for coupled motors, got a value <= 0. Pass positive values.")

    def torque(self, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the joint torque (..., n) [N m] required by the motors at a velocity and acceleration."""
        speed = self._turned(qd)
        own = self.inertia * self._turned(qdd) + self.viscous * speed
        return self._spread(own + self.coulomb * np.tanh(speed / self.smooth_speed))

    def inertial(self, qdd: np.ndarray) -> np.ndarray:
        """Return the inertial part of the motor torque (..., n) [N m] at acceleration (..., n)."""
        return self._spread(self.inertia * self._turned(qdd))

    def _turned(self, x: np.ndarray) -> np.ndarray:
        # avoids @, so that the result of a row is bit-identical in any batch
        return np.sum(self.ratios * np.asarray(x, dtype=float)[..., None, :], axis=-1)

    def _spread(self, own: np.ndarray) -> np.ndarray:
        return np.sum(self.ratios * own[..., None], axis=-2)


class CoupledKernel:
    """Estimator kernel whose torque input excludes the torques of coupled motors.

    The acceleration is computed from the velocity change since the last valid sample, as in the kernel itself.

    `kernel`: kernel of the model without coupled motors, with the methods step, run and reset. `gains`: (n,) ratio of
    measured to true torque.
    """

    def __init__(self, kernel: Any, motors: CoupledMotors, gains: np.ndarray) -> None:
        self._kernel, self._motors, self._gains = kernel, motors, gains
        self._qd: np.ndarray | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)

    def reset(self) -> None:
        """Clear all samples."""
        self._qd = None
        self._kernel.reset()

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> Any:
        """Process one sample: q, qd, tau (n,), dt [s]."""
        if not np.shape(q) == np.shape(qd) == np.shape(tau):
            return self._kernel.step(q, qd, tau, dt)  # raises an error that states the cause
        whole = bool(np.isfinite(q).all() and np.isfinite(qd).all() and np.isfinite(tau).all() and np.isfinite(dt))
        if not whole or not dt > 0:
            return self._kernel.step(q, qd, tau, dt)
        last = qd if self._qd is None else self._qd
        self._qd = np.array(qd, dtype=float)
        return self._kernel.step(q, qd, tau - self._gains * self._motors.torque(qd, (qd - last) / dt), dt)

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> Any:
        """Process samples in order: q, qd, tau (N, n), dt (N,) [s]; equivalent to repeated steps."""
        if not np.shape(q) == np.shape(qd) == np.shape(tau) == (*np.shape(dt), len(self._gains)):
            return self._kernel.run(q, qd, tau, dt)  # raises with the cause
        whole = np.isfinite(np.concatenate([q, qd, tau], axis=1)).all(axis=1) & np.isfinite(dt)
        rows = np.flatnonzero(whole & (np.where(whole, dt, 0.0) > 0))
        relieved = np.array(tau, dtype=float)
        if len(rows):
            first = qd[rows[:1]] if self._qd is None else self._qd[None]
            last = np.concatenate([first, qd[rows[:-1]]])
            relieved[rows] -= self._gains * self._motors.torque(qd[rows], (qd[rows] - last) / dt[rows, None])
            self._qd = np.array(qd[rows[-1]], dtype=float)
        return self._kernel.run(q, qd, relieved, dt)


@dataclass(frozen=True, eq=False, repr=False)
class Quality(Shown):
    """Quality of the fit of a torque model per joint.

    Attributes
    ----------
    torque_sd : array, shape (n,), N m
        Standard deviation of the measured torque.
    rms : array, shape (n,), N m
        RMS residual of the training data in motion, after the causal filter of the estimator.
    rms_cv : array, shape (n,), N m
        RMS residual of held-out blocks in motion, after the same filter.
    coverage : array, shape (n,)
        Fraction of held-out causal residuals within 2 sigma.
    seconds : float, s
        Length of the training data.
    """

    torque_sd: np.ndarray
    rms: np.ndarray
    rms_cv: np.ndarray
    coverage: np.ndarray
    seconds: float

    def __post_init__(self) -> None:
        """Validate shapes and freeze the arrays; NaN marks joints that could not be assessed."""
        for name in ("torque_sd", "rms", "rms_cv", "coverage"):
            values = still(getattr(self, name), f"{name} of the quality")
            if values.ndim != 1 or values.shape != np.shape(self.torque_sd):
                raise ShapeError(
                    f"Expected {name} with one number per joint, got shape {values.shape}. Repeat the fit."
                )
            object.__setattr__(self, name, values)


# Training data of a model: ranges of position and speed, share of rest.


SPEED_EDGES = np.array([0.0, 0.01, 0.03, 0.1, 0.3, 1.0])
"""Lower edges of the speed bins as fractions of the peak speed in training; the last bin is beyond the training
range."""
SPEED_EDGES.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Training:
    """Ranges of the training data of a model; its quality figures are valid only inside these ranges.

    `q_min`, `q_max`: (n,) limits of the position range [rad]. `qd_peak`: (n,) largest speed [rad/s]. `speed_share`: (n,
    12) fraction of samples per bin of `SPEED_EDGES`: six for negative velocities, then six for positive velocities,
    slowest first. `rest_share`: fraction of samples with every joint below 1 % of its peak speed. `longest_rest`:
    duration of the longest segment at rest [s].
    """

    q_min: np.ndarray
    q_max: np.ndarray
    qd_peak: np.ndarray
    speed_share: np.ndarray
    rest_share: float
    longest_rest: float

    def __post_init__(self) -> None:
        n = len(self.q_min)
        shapes = {"q_min": (n,), "q_max": (n,), "qd_peak": (n,), "speed_share": (n, 2 * len(SPEED_EDGES))}
        freeze_arrays(self, "the training", shapes)
        if not (0.0 <= self.rest_share <= 1.0 and 0.0 <= self.longest_rest < np.inf):
            raise ShapeError(
                f"Expected a rest share from 0 to 1 and a duration of at least 0 s, got {self.rest_share:g} and "
                f"{self.longest_rest:g} s. Identify the model again."
            )


SIGN = "environment_on_robot"
WEIGHTLESS = 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class TorqueModel(Shown):
    """Identified torque model, bound to one robot.

    Attributes
    ----------
    robot_name, robot_hash : the robot of the model; `check_robot` rejects any other robot.
    frames, prismatic, gravity : kinematics (n + 1, 4, 4), (n,), and gravity (3,) [m/s^2] in base axes.
    link_parameters : (n, 10) in link frames, order m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
    rotor : (n,) rotor inertia [kg m^2].
    friction, ripple, covariance : friction, torque ripple and torque covariance.
    bound : bound on the friction near rest, for bounded-friction estimators.
    cutoff : corner frequency [Hz] of the causal residual filter for which `covariance` holds.
    base_names, base_values, base_cov : identified base parameters with their covariance for given gains.
    gains : (n,) measured over true torque; default: 1.
    gain_cov : (n, n) covariance of the gains; default: 0.
    load_sd : (n,) standard deviation of the load friction; default: 0. `contact_doubt` combines this deviation with the
        uncertainty of the gains.
    quality : quality of the fit.
    training : ranges of the training data.
    sources : SHA-256 and name of each log.
    lines, friction_map, warm_up : drive terms that `identify.fit_friction` adds if they improve the fit; else None.
    momentum : noise of torque and velocity for the momentum estimators, or None if unavailable.
    coupled : motors that move several joints, or None.
    parameters : covariance of all parameters, which widens the torque covariance outside the identification motion; or
        None.
    quasi_static : True if the model contains only gravity, friction and offset, without torques from link motion.
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
    load_sd: np.ndarray = field(default_factory=lambda: np.zeros(0))
    parameters: ParameterCovariance | None = None

    def __post_init__(self) -> None:
        n, p = len(self.rotor), len(self.base_names)
        if not np.size(self.gains):
            object.__setattr__(self, "gains", np.ones(n))
        if not np.size(self.gain_cov):
            object.__setattr__(self, "gain_cov", np.zeros((n, n)))
        if not np.size(self.load_sd):
            object.__setattr__(self, "load_sd", np.zeros(n))
        shapes = {
            "frames": (n + 1, 4, 4), "prismatic": (n,), "gravity": (3,), "link_parameters": (n, 10), "rotor": (n,),
            "base_values": (p,), "base_cov": (p, p), "gains": (n,), "gain_cov": (n, n),
            "load_sd": (n,),
        }  # fmt: skip
        for name, shape in shapes.items():
            values = np.array(getattr(self, name), dtype=bool if name == "prismatic" else float)
            if values.shape != shape or not np.all(np.isfinite(values)):
                raise ShapeError(f"Expected finite {name} of shape {shape} for {n} joints, got shape {values.shape}.")
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if np.any(self.gains <= 0):
            raise ShapeError(f"Expected gains above 0, got {self.gains.tolist()}. Identify the model again.")
        if self.momentum is not None and len(self.momentum.memory) != n:
            raise ShapeError(f"Expected momentum noise for {n} joints, got {len(self.momentum.memory)}.")
        if self.coupled is not None and self.coupled.ratios.shape[1] != n:
            raise ShapeError(
                f"Expected coupled motors for {n} joints, got ratios of shape {self.coupled.ratios.shape}."
            )
        lengths = len(self.friction.delta), len(self.ripple.cycles), len(self.covariance.C0), len(self.bound.speed)
        lengths = (*lengths, len(self.training.q_min))
        if lengths != (n,) * 5 or not 0 < self.cutoff < np.inf:
            raise ShapeError(
                "Expected friction, ripple, covariance, bound and training "
                f"for {n} joints and a cut-off frequency above 0 Hz, "
                f"got {lengths} joints and {self.cutoff:g} Hz."
            )
        known = self.parameters or ParameterCovariance(np.zeros(0), np.zeros(0), np.zeros(n))
        columns = known.columns
        inside = (columns >= 0) & (columns < (11 + OF_FRICTION) * n) & (columns == np.floor(columns))
        if len(known.mean) != n or not inside.all():
            raise ShapeError(
                f"Expected parameter columns that belong to {n} joints, got invalid columns. Repeat the fit."
            )
        _ = self.drive  # rejects terms with a different number of joints

    def _repr_html_(self) -> str:
        friction, quality = self.friction, self.quality
        columns = (self.gains, friction.coulomb_pos, friction.coulomb_neg, friction.viscous, self.rotor, quality.rms_cv)
        rows = [(str(i + 1), *(f"{x[i]:.4g}" for x in columns)) for i in range(self.n)]
        head = (
            "joint",
            "gain",
            "Coulomb + [N m]",
            "Coulomb -",
            "viscous [N m s/rad]",
            "rotor [kg m^2]",
            "held-out rms",
        )
        return html_table(f"Torque model of {self.robot_name}, {quality.seconds:.0f} s", head, rows)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.rotor)

    @cached_property
    def chain(self) -> Chain:
        """Kinematics and dynamics kernel of the robot."""
        return Chain(self.frames, self.prismatic)

    @cached_property
    def rigid_body(self) -> RigidBody:
        """Dynamics kernel with rotors and coupled motors, for `armlab.dynamics`; `ModelMismatchError` if incomplete."""
        silent = np.flatnonzero(np.isnan(self.quality.rms))
        if self.quasi_static or len(silent):
            lacks = f"the torque of joint {silent[0] + 1}" if len(silent) else "inertias"
            raise ModelMismatchError(
                f"Expected a model with all inertias of robot {self.robot_name!r}, got a model without {lacks}. "
                "Use fit_dynamics with all torques; dynamics.gravity also accepts a model from fit_gravity."
            )
        coupled = 0.0 if self.coupled is None else self.coupled.inertial(np.eye(self.n))
        return RigidBody(self.chain, self.gravity, self.link_parameters, np.diag(self.rotor) + coupled)

    @property
    def _weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Return gravity and link parameters for the kernels, without torques from motion if quasi-static."""
        share = WEIGHTLESS if self.quasi_static else 1.0
        return self.gravity / share, share * self.link_parameters

    @property
    def drive(self) -> Drive:
        """Kernel of friction, ripple and warm-up."""
        return Drive(
            self.friction.rows,
            self.ripple.rows,
            None if self.lines is None else self.lines.kernel_rows(),
            None if self.friction_map is None else self.friction_map.kernel_rows(),
            None if self.warm_up is None else self.warm_up.kernel_rows(),
        )

    def check_robot(self, robot: Robot) -> None:
        """Raise `ModelMismatchError` if `robot` is not the model's robot, or `RobotError` if the argument is not a
        robot."""
        known = self._described(robot) if isinstance(robot, Robot) else None
        advice = "A torque model is bound to one robot description: repeat the identification for this description."
        check_same(robot, "the torque model", self.robot_name, self.robot_hash, known, advice)

    def moved_to(self, robot: Robot) -> TorqueModel:
        """Return the model with the frames, gravity and name of another description of the arm (tool, mount, limits).

        Identified parameters are kept. The result is exact if only limits, tool or names differ. With a different
        mount, the result is exact only if the motion determined all inertial parameters. The result is wrong if link
        lengths differ.

        Parameters
        ----------
        robot : Robot
            The new description.

        Raises
        ------
        ModelMismatchError
            Wrong number or type of joints.
        """
        if not isinstance(robot, Robot):
            raise RobotError.no_robot(robot)
        if not np.array_equal(robot.prismatic, self.prismatic):
            self.check_robot(robot)
        own = {"robot_name": robot.name, "robot_hash": robot.hash, "frames": robot.frames, "gravity": robot.gravity}
        return replace(self, **own)

    def _described(self, robot: Robot) -> Robot | None:
        """Return a robot with the geometry of the model and without limits, or None if the joint count differs."""
        if self.frames.shape != robot.frames.shape:
            return None
        links = np.concatenate([robot.links[:1], self.frames[1:-1], robot.links[-1:]])
        mount, tool = self.frames[0] @ np.linalg.inv(links[0]), np.linalg.inv(links[-1]) @ self.frames[-1]
        return replace(
            robot, links=links, T_base_mount=mount, T_flange_tool=tool, prismatic=self.prismatic, gravity=self.gravity,
            name=self.robot_name,
        )  # fmt: skip

    def rigid_torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the true gravity, inertial and rotor torque (..., n) [N m]; all inputs (..., n)."""
        torque = self.chain.rnea(q, qd, qdd, *self._weights) + self.rotor * qdd
        return torque if self.coupled is None else torque + self.coupled.inertial(qdd)

    def torque(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray | None = None, dt: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the predicted torque reading (N, n) [N m] along a record without contact: true torque times gains.

        The presliding state evolves over the rows, starting at 0. A row with a NaN yields NaN and does not change the
        state.

        Parameters
        ----------
        q, qd : (N, n) positions [rad] and velocities [rad/s] in time order.
        qdd : (N, n) accelerations [rad/s^2]; default: zero.
        dt : (N,) steps [s] for the warm-up of the drives; default: constant initial temperature.
        """
        q, qd = np.atleast_2d(q), np.atleast_2d(qd)
        qdd = np.zeros_like(q) if qdd is None else np.atleast_2d(qdd)
        torque = model_torque(self.chain, *self._weights, self.rotor, self.drive, q, qd, qdd, dt)
        return self.gains * (torque if self.coupled is None else torque + self.coupled.torque(qd, qdd))

    def estimator_kernel(
        self, prior: np.ndarray, method: int = 0, point: np.ndarray | None = None
    ) -> WrenchEstimator | CoupledKernel:
        """Return a new estimator kernel for this model.

        Parameters
        ----------
        prior : (6,) prior variances of the wrench [N^2, (N m)^2].
        method : index of a static method of `contact.Estimator`; 0 is "map".
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
            *self._parameter_rows,
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
        """Return a new momentum estimator kernel for this model.

        The filter's factor alpha^2 scales all noise, so it changes the covariance but not the estimate. Unobserved
        directions keep their prior.

        Parameters
        ----------
        prior : (6,) prior variances of the wrench [N^2, (N m)^2].
        rate : (6,) random-walk intensity of the wrench [N^2/s, (N m)^2/s].
        leak : (6,) decay rate [1/s], or None for the rate that preserves the prior: ``alpha^2 rate / (2 prior)``.
        gain : gain of the observer [1/s].
        filters : True for the Kalman filter, False for the observer.
        biased : add a friction error per joint.
        point : (3,) known contact in tool axes [m], or None.

        Raises
        ------
        ModelMismatchError : if the model has no momentum noise.
        """
        noise = self.momentum
        if noise is None:
            raise ModelMismatchError(
                "Expected a model with the torque and velocity noise that momentum estimators need, got a model "
                "without it (possibly from an older file). Repeat the identification, or use a static method."
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
            *self._parameter_rows,
        )
        return kernel if self.coupled is None else CoupledKernel(kernel, self.coupled, self.gains)

    @property
    def _gain_variance(self) -> float:
        """Return the variance of the mean of all uncertain gains, which is the scale error common to all forces."""
        return float(np.sum(self.gain_cov) / max(np.count_nonzero(np.diag(self.gain_cov)), 1) ** 2)

    @property
    def contact_doubt(self) -> np.ndarray:
        """Relative standard deviation (n,) of a contact torque due to gains (without their mean) and load friction.

        The residuals of the arm's own torque already include the uncertainties of the gains and of load friction.
        """
        uncertain = (np.diag(self.gain_cov) > 0).astype(float)
        apart = np.diag(uncertain) - np.outer(uncertain, uncertain) / max(uncertain.sum(), 1.0)
        return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", apart, self.gain_cov, apart), 0.0) + self.load_sd**2)

    @property
    def _parameter_rows(self) -> tuple[np.ndarray, ...]:
        """Return the parameter covariance as the kernels expect it; empty for exact parameters."""
        if self.parameters is None:
            return ()
        return self.parameters.kernel_rows(WEIGHTLESS if self.quasi_static else 1.0)

    def _covariance_rows(self, alpha2: float) -> np.ndarray:
        c = self.covariance
        kind = float(KINDS.index(c.kind))
        return np.stack([alpha2 * c.C0, alpha2 * c.Cinf, c.shape, np.full(self.n, kind), self.contact_doubt])


@dataclass(frozen=True, eq=False, repr=False)
class Payload(Shown):
    """Load fixed rigidly to the flange of one robot.

    Attributes
    ----------
    robot_name, robot_hash : the robot that carried the load.
    pi : (10,) m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the flange's origin, flange axes [kg, kg m, kg m^2].
    T_last_flange : (4, 4) flange pose in the last link's frame.
    sources : SHA-256 and name of each log.
    """

    robot_name: str
    robot_hash: str
    pi: np.ndarray
    T_last_flange: np.ndarray
    sources: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        freeze_arrays(self, "a payload", {"pi": (10,), "T_last_flange": (4, 4)})

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.pi[0])

    @property
    def centre(self) -> np.ndarray:
        """Centre of mass (3,) in flange axes [m]; zero without mass."""
        return inertia.to_body(self.pi).centre

    @property
    def inertia(self) -> np.ndarray:
        """Inertia (3, 3) about the centre of mass, flange axes [kg m^2]."""
        return inertia.to_body(self.pi).inertia

    def added_to(self, model: TorqueModel) -> TorqueModel:
        """Return the torque model of the arm with this load; only its last link differs.

        The identified base parameters and their covariance remain those of the arm alone.

        Parameters
        ----------
        model : torque model of the arm without the load.

        Raises
        ------
        ModelMismatchError : if the model belongs to another robot.
        """
        if model.robot_hash != self.robot_hash:
            raise ModelMismatchError(
                f"Expected a model of robot {self.robot_name!r} ({self.robot_hash[:12]}), got a model of "
                f"{model.robot_name!r} ({model.robot_hash[:12]}). Repeat the payload identification with this robot."
            )
        links = model.link_parameters.copy()
        links[-1] += inertia.transform(self.T_last_flange, self.pi)
        return replace(model, link_parameters=links)
