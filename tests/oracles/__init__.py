# ruff: noqa: F401  the oracles by the names of the kernels
"""Mathematics of the compiled kernels in plain NumPy, with which the tests compare `armlab.kernels`.

Names and parameters are those documented in `armlab/kernels/_native.pyi`, and results agree to 1e-12. Readability
matters more than speed, so oracles are ten to a thousand times slower. They check no arguments and have neither `out`
nor `threads`. Searches have no oracle; their results are checked, not their steps (tests/kinematics). Lie groups and
obstacles are compared with exact tables only (tests/numerics).
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
