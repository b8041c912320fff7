"""Inverse and forward dynamics of a `Robot` or a `TorqueModel`, with their parts and derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ModelMismatchError, RobotError
from armlab.kernels import RigidBody
from armlab.models import TorqueModel
from armlab.robots import Robot


def inverse_dynamics(
    robot: Robot | TorqueModel,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    *,
    f_ext: ArrayLike | None = None,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Return the joint torques of a motion: ``tau = M qdd + C qd + g - J^T f_ext``.

    Uses the recursive Newton-Euler algorithm (Siciliano et al., Robotics, 2009, section 7.5).

    Parameters
    ----------
    robot : Robot or TorqueModel
        An arm with inertias, or an identified model, whose friction is ignored.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    qd : array_like, shape (..., n), rad/s or m/s
        Joint velocities.
    qdd : array_like, shape (..., n), rad/s^2 or m/s^2
        Joint accelerations.
    f_ext : array_like, shape (..., 6), N and N m, optional
        Wrench [f; m] exerted by the environment on the robot at the tool point, in base axes. Default: none.
    out : array, shape (..., n), optional
        Array to write into. Default: a new one.

    Returns
    -------
    tau : array, shape (..., n), N m or N

    Raises
    ------
    RobotError : for a robot without inertias.
    ModelMismatchError : for a model without inertias, or with a subset of the joints.
    ShapeError : if shapes are wrong or do not broadcast.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.rnea(q, qd, qdd, f_ext, out)


def inverse_dynamics_derivatives(
    robot: Robot | TorqueModel,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    *,
    f_ext: ArrayLike | None = None,
    out: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives of `inverse_dynamics` with respect to position, velocity and acceleration.

    Analytical, in O(n^2). A wrench `f_ext` keeps its components in base axes while the joints move.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    qd : array_like, shape (..., n), rad/s or m/s
        Joint velocities.
    qdd : array_like, shape (..., n), rad/s^2 or m/s^2
        Joint accelerations.
    f_ext : array_like, shape (..., 6), N and N m, optional
        Wrench [f; m] exerted by the environment on the robot at the tool point, in base axes. Default: none.
    out : tuple of three arrays, shape (..., n, n), optional
        Arrays to write into. Default: new ones.

    Returns
    -------
    dtau_dq : array, shape (..., n, n)
        Row i, column j: derivative of torque i with respect to position j.
    dtau_dqd : array, shape (..., n, n)
        With respect to velocity; twice the `coriolis_matrix`.
    dtau_dqdd : array, shape (..., n, n)
        With respect to acceleration: the `mass_matrix`.

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.

    References
    ----------
    Singh, Russell and Wensing (2022), Efficient analytical derivatives of rigid-body dynamics using spatial vector
    algebra.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.rnea_derivatives(q, qd, qdd, f_ext, out)


def gravity(robot: Robot | TorqueModel, q: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the joint torques that hold the arm at rest, ``g(q) = inverse_dynamics(robot, q, 0, 0)``.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`; a model from `identify.fit_gravity` is also accepted.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    out : array, shape (..., n), optional
        Array to write into. Default: a new one.

    Returns
    -------
    g : array, shape (..., n), N m or N

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    try:
        body = robot.rigid_body
    except AttributeError:
        return gravity(_identified(robot), q, out)
    except ModelMismatchError:
        if not isinstance(robot, TorqueModel) or not robot.quasi_static:
            raise
        body = RigidBody(robot.chain, robot.gravity, robot.link_parameters)
    return body.gravity_torque(q, out)


def mass_matrix(robot: Robot | TorqueModel, q: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the mass matrix M(q), whose column j contains the torques for a unit acceleration of joint j alone.

    Uses the composite-rigid-body algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.2); the
    result is exactly symmetric.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    out : array, shape (..., n, n), optional
        Array to write into. Default: a new one.

    Returns
    -------
    M : array, shape (..., n, n), kg m^2, kg m or kg

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.mass_matrix(q, out)


def coriolis(robot: Robot | TorqueModel, q: ArrayLike, qd: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the vector of Coriolis and centrifugal torques, ``C(q, qd) qd``; the matrix is `coriolis_matrix`.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    qd : array_like, shape (..., n), rad/s or m/s
        Joint velocities.
    out : array, shape (..., n), optional
        Array to write into. Default: a new one.

    Returns
    -------
    tau : array, shape (..., n), N m or N

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.coriolis_torque(q, qd, out)


def coriolis_matrix(
    robot: Robot | TorqueModel, q: ArrayLike, qd: ArrayLike, out: np.ndarray | None = None
) -> np.ndarray:
    """Return the Coriolis matrix C(q, qd) of Christoffel symbols, ``C_ij = sum of Gamma_ijk qd_k``.

    ``dM/dt = C + C^T``, so ``dM/dt - 2 C`` is skew. If only the vector ``C qd`` is needed, use `coriolis`.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    qd : array_like, shape (..., n), rad/s or m/s
        Joint velocities.
    out : array, shape (..., n, n), optional
        Array to write into. Default: a new one.

    Returns
    -------
    C : array, shape (..., n, n)

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.coriolis_matrix(q, qd, out)


def forward_dynamics(
    robot: Robot | TorqueModel,
    q: ArrayLike,
    qd: ArrayLike,
    tau: ArrayLike,
    *,
    f_ext: ArrayLike | None = None,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Return the joint accelerations caused by torques: ``qdd = M^-1 (tau + J^T f_ext - C qd - g)``.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    qd : array_like, shape (..., n), rad/s or m/s
        Joint velocities.
    tau : array_like, shape (..., n), N m or N
        Joint torques without friction.
    f_ext : array_like, shape (..., 6), N and N m, optional
        Wrench [f; m] exerted by the environment on the robot at the tool point, in base axes. Default: none.
    out : array, shape (..., n), optional
        Array to write into. Default: a new one.

    Returns
    -------
    qdd : array, shape (..., n), rad/s^2 or m/s^2

    Raises
    ------
    RobotError : for a robot without inertias, or when the mass matrix is not positive definite: a massless link, or
        identified parameters that are not physically consistent.
    ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.forward_dynamics(q, qd, tau, f_ext, out)


def forward_dynamics_derivatives(
    robot: Robot | TorqueModel,
    q: ArrayLike,
    qd: ArrayLike,
    tau: ArrayLike,
    *,
    f_ext: ArrayLike | None = None,
    out: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives of `forward_dynamics` with respect to position, velocity and torque.

    ``dqdd/dx = -M^-1 dtau/dx``, with the derivatives of `inverse_dynamics` at the resulting acceleration, and ``M^-1``.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    qd : array_like, shape (..., n), rad/s or m/s
        Joint velocities.
    tau : array_like, shape (..., n), N m or N
        Joint torques.
    f_ext : array_like, shape (..., 6), N and N m, optional
        Wrench [f; m] exerted by the environment on the robot at the tool point, constant in base axes. Default: none.
    out : tuple of three arrays, shape (..., n, n), optional
        Arrays to write into. Default: new ones.

    Returns
    -------
    dqdd_dq : array, shape (..., n, n)
        Row i, column j: derivative of acceleration i with respect to position j.
    dqdd_dqd : array, shape (..., n, n)
        With respect to velocity.
    dqdd_dtau : array, shape (..., n, n)
        With respect to torque: the inverse of the mass matrix.

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `forward_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.forward_dynamics_derivatives(q, qd, tau, f_ext, out)


def energy(
    robot: Robot | TorqueModel, q: ArrayLike, qd: ArrayLike, out: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return kinetic and potential energy: ``1/2 qd^T M qd`` and ``-sum of m gravity . p`` over the links.

    Parameters
    ----------
    robot : Robot or TorqueModel
        As in `inverse_dynamics`.
    q : array_like, shape (..., n), rad or m
        Joint positions.
    qd : array_like, shape (..., n), rad/s or m/s
        Joint velocities.
    out : tuple of two arrays, shape (...), optional
        Arrays to write into. Default: new ones.

    Returns
    -------
    kinetic : array, shape (...), J
        Kinetic energy.
    potential : array, shape (...), J
        Potential energy. For a robot, it is zero for masses at the origin of the base; for a model, at q = 0.

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    kinetic, potential = body.energy(q, qd, out)
    if not isinstance(robot, Robot):
        at_zero = np.zeros(np.shape(q)[-1])
        potential -= body.energy(at_zero, at_zero)[1]
    return kinetic, potential


def _identified(robot: Any) -> TorqueModel:
    """Return the torque model of a fit; other values are returned unchanged."""
    model = getattr(robot, "value", None)
    if not isinstance(model, TorqueModel):
        raise RobotError.no_robot(robot)
    return model
