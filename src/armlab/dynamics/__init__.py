"""Rigid-body dynamics: torques, accelerations, mass and Coriolis matrices, energy, regressors and derivatives.

The equation of motion is::

    M(q) qdd + C(q, qd) qd + g(q) = tau + J(q)^T f_ext

All functions are compiled and broadcast over leading axes. Joints are ordered from base to tool; they are revolute
[rad, N m] or prismatic [m, N]. The mount, tool and gravity are those of the robot. For motors behind coupled gears,
convert torques with ``couplings.joint_torque_to_motor(robot, tau)``; the motor-side mass matrix is ``G^T M G`` with
G = `Robot.coupling`.

The first argument is a `Robot` with inertias, or an identified `TorqueModel`. A model contains base parameters only, so
results that are linear in them are exact, including rotors and coupled motors but without friction. The potential
energy of a model is zero at q = 0. The constant weight on a vertical prismatic joint is omitted, because it is
indistinguishable from a torque offset. A model from `identify.fit_gravity` supports only `gravity`. `regressor` and
`base_regressor` need no masses.

This package is separate from `kinematics`, because it imports `TorqueModel`. Simulation, estimators and identification
call the same kernels (native/math/arm/rigid_body.h).
"""

from armlab.dynamics.base_parameters import BaseParameters, base_parameters, base_regressor, regressor
from armlab.dynamics.rigid_body import (
    coriolis,
    coriolis_matrix,
    energy,
    forward_dynamics,
    forward_dynamics_derivatives,
    gravity,
    inverse_dynamics,
    inverse_dynamics_derivatives,
    mass_matrix,
)

__all__ = [
    "BaseParameters", "base_parameters", "base_regressor", "coriolis", "coriolis_matrix", "energy", "forward_dynamics",
    "forward_dynamics_derivatives", "gravity", "inverse_dynamics", "inverse_dynamics_derivatives", "mass_matrix",
    "regressor",
]  # fmt: skip
