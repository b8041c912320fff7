"""A laser line scanner on a tool, and the plates by which it was calibrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab import kernels
from armlab._numbers import still
from armlab.errors import ShapeError

__all__ = ["LaserSensor"]


@dataclass(frozen=True, eq=False)
class LaserSensor:
    """Where a scanner measures, and the planes ``n . x = d`` it was calibrated on.

    Attributes
    ----------
    T_tool_sensor : (4, 4); the laser plane is the xy plane of the sensor.
    normals : n (P, 3) unit, base axes. offsets : d (P,) not negative [m].
    planes : their labels. robot_name, robot_hash : the robot that carries it; empty for any. sources : what it was
        fitted to.

    Raises
    ------
    ShapeError : a pose, a normal or a number of planes that cannot be.

    References
    ----------
    The model of `calibrate.fit_laser_plane`.
    """

    T_tool_sensor: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    planes: tuple[str, ...]
    robot_name: str = ""
    robot_hash: str = ""
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check and freeze."""
        P = len(self.planes)
        shapes = {"T_tool_sensor": (4, 4), "normals": (P, 3), "offsets": (P,)}
        for name, shape in shapes.items():
            values = still(getattr(self, name), f"{name} of a laser sensor")
            if values.shape != shape or not np.isfinite(values).all():
                raise ShapeError(f"Expected finite {name} of shape {shape} of a laser sensor, got {values.tolist()}.")
            object.__setattr__(self, name, values)
        kernels.poses(self.T_tool_sensor, "T_tool_sensor")
        if np.abs(np.linalg.norm(self.normals, axis=1) - 1.0).max(initial=0.0) > 1e-9:
            raise ShapeError("Expected unit normals of a laser sensor's planes, got others. Divide by their length.")

    def points(self, p: np.ndarray, T_base_tool: np.ndarray) -> np.ndarray:
        """Return points (..., 3) in base axes.

        Parameters
        ----------
        p : (..., 2) as measured, laser plane [m]; NaN stays NaN.
        T_base_tool : (..., 4, 4) pose of the tool at that time.

        Raises
        ------
        ShapeError : points or poses of another shape.
        """
        p, poses = np.asarray(p, dtype=np.float64), np.asarray(T_base_tool, dtype=np.float64)
        if p.shape[-1:] != (2,) or poses.shape[-2:] != (4, 4):
            raise ShapeError(f"Expected points (..., 2) and poses (..., 4, 4), got {p.shape} and {poses.shape}.")
        T = poses @ self.T_tool_sensor
        return (T[..., :3, :2] @ p[..., None])[..., 0] + T[..., :3, 3]
