"""Inverse and forward dynamics of a `Robot` or a `TorqueModel`, with their individual terms and derivatives."""

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
    """Return the joint torques (..., n) [N m or N] of a motion: ``tau = M qdd + C qd + g - J^T f_ext``.

    Computed by the recursive Newton-Euler algorithm (Siciliano et al., Robotics, 2009, section 7.5).

    Parameters
    ----------
    robot : an arm with inertias, or an identified model, whose friction is ignored.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    qdd : (..., n) joint accelerations [rad/s^2 or m/s^2].
    f_ext : (..., 6) wrench [f; m] of the environment on the robot at the tool point, in base axes [N, N m]; default: 0.
    out : (..., n) array for the result; default: newly allocated.

    Raises
    ------
    RobotError : for a robot without inertias.
    ModelMismatchError : for a model without inertias, or a model of only some of the joints.
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

    The derivatives are analytical, with O(n^2) complexity. A wrench `f_ext` stays constant in base axes.

    Parameters
    ----------
    robot : as in `inverse_dynamics`.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    qdd : (..., n) joint accelerations [rad/s^2 or m/s^2].
    f_ext : (..., 6) wrench [f; m] of the environment on the robot at the tool point, in base axes [N, N m]; default: 0.
    out : three arrays (..., n, n) for the results; default: newly allocated.

    Returns
    -------
    dtau_dq : (..., n, n) derivative of torque i with respect to position j, in row i and column j.
    dtau_dqd : (..., n, n) derivative with respect to velocity; twice the `coriolis_matrix`.
    dtau_dqdd : (..., n, n) derivative with respect to acceleration: the `mass_matrix`.

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
    """Return the joint torques (..., n) [N m or N] that hold the arm at rest.

    ``g(q) = inverse_dynamics(robot, q, 0, 0)``.

    Parameters
    ----------
    robot : as in `inverse_dynamics`, or a model from `identify.fit_gravity`.
    q : (..., n) joint positions [rad or m].
    out : (..., n) array for the result; default: newly allocated.

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
    """Return the mass matrix M(q) (..., n, n) [kg m^2, kg m or kg].

    Column j contains the torques for a unit acceleration of joint j alone. The composite-rigid-body algorithm
    (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.2) makes the result exactly symmetric.

    Parameters
    ----------
    robot : as in `inverse_dynamics`.
    q : (..., n) joint positions [rad or m].
    out : (..., n, n) array for the result; default: newly allocated.

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.mass_matrix(q, out)


def coriolis(robot: Robot | TorqueModel, q: ArrayLike, qd: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the Coriolis and centrifugal torques ``C(q, qd) qd`` (..., n) [N m or N]; `coriolis_matrix` returns the
    matrix itself.

    Parameters
    ----------
    robot : as in `inverse_dynamics`.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    out : (..., n) array for the result; default: newly allocated.

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `inverse_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.coriolis_torque(q, qd, out)


def coriolis_matrix(
    robot: Robot | TorqueModel, q: ArrayLike, qd: ArrayLike, out: np.ndarray | None = None
) -> np.ndarray:
    """Return the Coriolis matrix C(q, qd) (..., n, n) from Christoffel symbols, ``C_ij = sum of Gamma_ijk qd_k``.

    ``dM/dt = C + C^T``, so ``dM/dt - 2 C`` is skew-symmetric. For the vector ``C qd`` alone, use `coriolis`.

    Parameters
    ----------
    robot : as in `inverse_dynamics`.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    out : (..., n, n) array for the result; default: newly allocated.

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
    """Return the joint accelerations (..., n) [rad/s^2 or m/s^2]: ``qdd = M^-1 (tau + J^T f_ext - C qd - g)``.

    Parameters
    ----------
    robot : as in `inverse_dynamics`.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    tau : (..., n) joint torques or forces [N m or N], without friction.
    f_ext : (..., 6) wrench [f; m] of the environment on the robot at the tool point, in base axes [N, N m]; default: 0.
    out : (..., n) array for the result; default: newly allocated.

    Raises
    ------
    RobotError : for a robot without inertias, or if the mass matrix is not positive definite because of a massless link
        or physically inconsistent parameters.
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

    ``dqdd/dx = -M^-1 dtau/dx`` with the derivatives of `inverse_dynamics` at the resulting acceleration, for x = q, qd.

    Parameters
    ----------
    robot : as in `inverse_dynamics`.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    tau : (..., n) joint torques or forces [N m or N], without friction.
    f_ext : as in `inverse_dynamics`, constant in base axes while the joints move.
    out : three arrays (..., n, n) for the results; default: newly allocated.

    Returns
    -------
    dqdd_dq : (..., n, n) derivative of acceleration i with respect to position j, in row i and column j.
    dqdd_dqd : (..., n, n) derivative with respect to velocity.
    dqdd_dtau : (..., n, n) derivative with respect to torque: the inverse of the mass matrix.

    Raises
    ------
    RobotError, ModelMismatchError, ShapeError : as in `forward_dynamics`.
    """
    body = getattr(robot, "rigid_body", None) or _identified(robot).rigid_body
    return body.forward_dynamics_derivatives(q, qd, tau, f_ext, out)


def energy(
    robot: Robot | TorqueModel, q: ArrayLike, qd: ArrayLike, out: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the kinetic energy ``1/2 qd^T M qd`` and the potential energy, ``-m gravity . p`` summed over the links.

    Parameters
    ----------
    robot : as in `inverse_dynamics`.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s].
    out : two arrays (...) for the results; default: newly allocated.

    Returns
    -------
    kinetic : (...) kinetic energy [J].
    potential : (...) potential energy [J], relative to the base origin (robot) or to q = 0 (model).

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
    """Return the torque model of a fit; raise an error for any other object."""
    model = getattr(robot, "value", None)
    if not isinstance(model, TorqueModel):
        raise RobotError.no_robot(robot)
    return model
