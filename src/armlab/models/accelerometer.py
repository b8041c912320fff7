"""A calibrated accelerometer on the tool: its axes, scale and bias."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError

__all__ = ["Accelerometer"]

_SHAPES = {"R_tool_sensor": (3, 3), "bias": (3,), "gravity": (3,)}


@dataclass(frozen=True, eq=False)
class Accelerometer:
    """An accelerometer on the tool; at rest it reads g upwards.

        y = scale R_tool_sensor^T R_base_tool^T (a - g) + b

    Attributes
    ----------
    R_tool_sensor : (3, 3) turns sensor axes into tool axes.
    bias : b (3,) sensor axes [m/s^2]. scale : of its readings, 1 for one that is right.
    gravity : g (3,) base axes [m/s^2].
    robot_name, robot_hash : the robot that carries it; empty for any. sources : what it was fitted to.

    Raises
    ------
    ShapeError : a shape, a rotation or a scale that cannot be.

    References
    ----------
    The model of `calibrate.fit_accelerometer`.
    """

    R_tool_sensor: np.ndarray
    bias: np.ndarray
    scale: float = 1.0
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -9.80665]))
    robot_name: str = ""
    robot_hash: str = ""
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and freeze the arrays."""
        for name, shape in _SHAPES.items():
            values = still(getattr(self, name), f"{name} of an accelerometer")
            if values.shape != shape or not np.isfinite(values).all():
                raise ShapeError(f"Expected finite {name} of shape {shape} of an accelerometer, got {values.tolist()}.")
            object.__setattr__(self, name, values)
        R = self.R_tool_sensor
        if np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
            raise ShapeError(f"Expected a rotation as R_tool_sensor of an accelerometer, got {R.tolist()}.")
        if not 0.0 < self.scale < np.inf:
            raise ShapeError(f"Expected a scale above zero of an accelerometer, got {self.scale!r}.")

    def acceleration(self, raw: np.ndarray, T_base_tool: np.ndarray) -> np.ndarray:
        """Return how the sensor is accelerated (..., 3), base axes [m/s^2]; zero at rest.

        Parameters
        ----------
        raw : (..., 3) as read, sensor axes [m/s^2]; NaN stays NaN.
        T_base_tool : (..., 4, 4) pose of the tool at that time.

        Raises
        ------
        ShapeError : readings or poses of another shape.
        """
        poses, raw = np.asarray(T_base_tool, dtype=np.float64), np.asarray(raw, dtype=np.float64)
        if poses.shape[-2:] != (4, 4) or raw.shape[-1:] != (3,):
            raise ShapeError(
                f"Expected readings (..., 3) and poses T_base_tool (..., 4, 4), got {raw.shape} and {poses.shape}."
            )
        felt = (raw - self.bias) / self.scale
        R_base_sensor = poses[..., :3, :3] @ self.R_tool_sensor
        return (R_base_sensor @ felt[..., None])[..., 0] + self.gravity
