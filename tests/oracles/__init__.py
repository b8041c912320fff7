# ruff: noqa: F401  the oracles by the names of the kernels
"""The mathematics of the compiled kernels in plain NumPy: what `armlab.kernels` is held to.

Same names, same parameters, the same results to 1e-12. They are written to be read, and are ten to a thousand times
slower; they check no arguments and have neither `out` nor `threads`. Searches have none: their results are checked, not
their steps (tests/kinematics). Lie groups and obstacles are held by exact tables alone (tests/numerics).
"""

from __future__ import annotations

from .chain import Chain
from .drive import Drive, basis_weights, model_torque, presliding
from .estimator import WrenchEstimator
from .limits import filtered_velocity, following_error, implausible, limit_reference
from .momentum import MomentumEstimator, momentum_step
from .primitive import Primitive, PrimitiveStepper
from .signals import SignalOperator
from .two_dof import TwoDof
from .wrench import solve_wrench, wrench_interval
