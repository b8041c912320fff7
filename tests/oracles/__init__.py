# ruff: noqa: F401  the oracles by the names of the kernels
"""The mathematics of the compiled kernels in plain NumPy: what `armlab.kernels` is held to.

Same names, same parameters, the same results to 1e-12. They are written to be read, and are ten to a thousand times
slower; they check no arguments and have neither `out` nor `threads`. Searches have none: their results are checked, not
their steps (tests/kinematics).
"""

from __future__ import annotations

from .chain import Chain
from .drive import Drive, basis_weights, model_torque, presliding
from .estimator import WrenchEstimator
from .lie import (
    euler_from_rpy,
    euler_to_rpy,
    quaternion_from_matrix,
    quaternion_multiply,
    quaternion_slerp,
    quaternion_to_matrix,
    se3_adjoint,
    se3_exp,
    se3_interpolate,
    se3_inv,
    se3_left_jacobian,
    se3_left_jacobian_inv,
    se3_log,
    se3_transform_wrench,
    so3_angle,
    so3_exp,
    so3_interpolate,
    so3_left_jacobian,
    so3_left_jacobian_inv,
    so3_log,
)
from .limits import limit_reference
from .momentum import MomentumEstimator, momentum_step
from .obstacles import Obstacles
from .primitive import Primitive, PrimitiveStepper
from .signals import SignalOperator
from .two_dof import TwoDof
from .wrench import solve_wrench, wrench_interval
