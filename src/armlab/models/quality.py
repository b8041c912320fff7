"""How well a torque model fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError

__all__ = ["Quality"]


@dataclass(frozen=True, eq=False)
class Quality:
    """How well the model fits, per joint (n,).

    Attributes
    ----------
    torque_sd : standard deviation of the measured torque [N m].
    rms : residual in the data it was fitted to [N m]; rms_cv : in held-out blocks [N m]; both in motion, after the
        causal filter of the estimator.
    coverage : share of held-out causal residuals inside 2 sigma.
    seconds : length of the training data.
    """

    torque_sd: np.ndarray
    rms: np.ndarray
    rms_cv: np.ndarray
    coverage: np.ndarray
    seconds: float

    def __post_init__(self) -> None:
        """Check shapes and freeze the arrays; NaN stands for joints that could not be judged."""
        for name in ("torque_sd", "rms", "rms_cv", "coverage"):
            values = still(getattr(self, name), f"{name} of the quality")
            if values.ndim != 1 or values.shape != np.shape(self.torque_sd):
                raise ShapeError(f"Expected {name} of one number per joint, got shape {values.shape}. Identify again.")
            object.__setattr__(self, name, values)
