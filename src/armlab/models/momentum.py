"""What the momentum estimators of the contact wrench need to know of a robot's torques and velocities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError

__all__ = ["FORCE_RATES", "PRIOR", "MomentumNoise"]

PRIOR = (20.0, 20.0, 20.0, 2.0, 2.0, 2.0)
"""Standard deviations of a contact wrench before any measurement [N, N m]."""
FORCE_RATES = {
    "smooth": (2.0, 2.0, 2.0, 0.2, 0.2, 0.2),
    "normal": (5.0, 5.0, 5.0, 0.5, 0.5, 0.5),
    "fast": (20.0, 20.0, 20.0, 2.0, 2.0, 2.0),
}
"""How fast a contact wrench wanders, by name [N/sqrt(s), N m/sqrt(s)]."""


@dataclass(frozen=True, eq=False)
class MomentumNoise:
    """Noise of torque and velocity as the momentum estimators see it.

    Attributes
    ----------
    memory : (n,) correlation time of the torque error [s]; its intensity is ``2 s^2 memory``.
    qd_noise : (n,) deviation of the measured velocity [rad/s].
    alpha2_observer, alpha2_kf : factors on the torque covariance, set so that 2-sigma coverage on held-out data is
        95.4 %: of the residual of the observer, and of the wrench of the Kalman filter in free motion.
    """

    memory: np.ndarray
    qd_noise: np.ndarray
    alpha2_observer: float = 1.0
    alpha2_kf: float = 1.0

    def __post_init__(self) -> None:
        """Check and freeze."""
        for name in ("memory", "qd_noise"):
            values = still(getattr(self, name), f"{name} of the momentum noise")
            object.__setattr__(self, name, values)
        memory, noise = self.memory, self.qd_noise
        regular = memory.ndim == 1 and memory.shape == noise.shape and np.isfinite([memory, noise]).all()
        factors = (self.alpha2_observer, self.alpha2_kf)
        if not regular or np.any(memory <= 0) or np.any(noise < 0) or not all(0 < a < np.inf for a in factors):
            raise ShapeError(
                "Expected memory > 0 and qd_noise >= 0, finite and both of shape (n,), and positive factors, got "
                f"shapes {memory.shape} and {noise.shape}, factors {factors}. Give one number per joint."
            )
