"""The kernels in plain NumPy: the specification that the compiled ones are held to.

Every name here exists in `armlab.kernels._native` with the same signature and the same results to 1e-12.
"""

from __future__ import annotations

from armlab.kernels._reference.chain import Chain
from armlab.kernels._reference.estimator import WrenchEstimator
from armlab.kernels._reference.limits import limit_reference
from armlab.kernels._reference.presliding import presliding

__all__ = ["Chain", "WrenchEstimator", "limit_reference", "presliding"]
