"""What is free in a run of a movement primitive of poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.motion._setting import Setting

__all__ = ["PoseRun"]


@dataclass(frozen=True)
class PoseRun:
    """One run of both parts, in the axes of the forcing; A (3, 3) turns those into base axes."""

    A: np.ndarray
    position: Setting
    rotation: Setting
    q0: np.ndarray
    q1: np.ndarray

    @property
    def turning(self) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What the kernel of orientations takes: time constant, q0, angular velocity, goal, map of the forcing."""
        return self.position.tau, self.q0, self.A @ self.rotation.v0, self.q1, self.A * self.rotation.scale
