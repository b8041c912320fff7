"""Models of sensors: force sensors, accelerometers, laser distance sensors, cameras with their marker."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite, isnan
from typing import Literal

import numpy as np

from armlab import kernels
from armlab._numbers import still
from armlab.errors import FrameError, ShapeError, UnknownName
from armlab.lie import so3
from armlab.models.friction import freeze_arrays

_SHAPES = {"R_tool_sensor": (3, 3), "centre": (3,), "bias": (6,), "gravity": (3,), "position": (3,)}
_MOMENTS = {"centre": slice(0, 3), "bias": slice(3, 6)}  # NaN where the fit had no torques
_FRAMES = ("base", "tool")


@dataclass(frozen=True, eq=False)
class ForceSensor:
    """A force sensor at the tool, with the weight that hangs on it and its bias.

    Without contact it reads, in its own axes, ``f = s m g_s + b_f`` and ``tau = c x (s m g_s) + b_tau``, with
    ``g_s = R_tool_sensor^T R_base_tool^T g``.

    Attributes
    ----------
    R_tool_sensor : (3, 3) turns sensor axes into tool axes.
    mass : m, what hangs on the sensor [kg]. centre : c (3,) of that mass, sensor axes [m].
    bias : (6,) what it reads without weight, sensor axes [N, N m].
    sign : s, +1 when it reads the weight that hangs on it, -1 when it reads the reaction.
    gravity : g (3,) base axes [m/s^2].
    position : (3,) of the sensor's origin in the tool frame [m].
    robot_name, robot_hash : the robot that carries it; empty for any. sources : what it was fitted to.

    Raises
    ------
    ShapeError : a shape, a rotation, a mass or a sign that cannot be. `centre` and the moments of `bias` may be NaN
        where only forces were calibrated; the moments of a contact then are NaN.
    """

    R_tool_sensor: np.ndarray
    mass: float
    centre: np.ndarray
    bias: np.ndarray
    sign: int = 1
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -9.80665]))
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    robot_name: str = ""
    robot_hash: str = ""
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            values = still(getattr(self, name), f"{name} of a force sensor")
            known = values.ravel().tolist()
            if name in _MOMENTS and values.shape == shape and all(map(isnan, known[_MOMENTS[name]])):
                known = known[: 3 * (name == "bias")]
            if values.shape != shape or not all(map(isfinite, known)):
                raise ShapeError(f"Expected finite {name} of shape {shape} of a force sensor, got {values.tolist()}.")
            object.__setattr__(self, name, values)
        try:
            so3.log(self.R_tool_sensor)
        except ShapeError:
            R = self.R_tool_sensor.tolist()
            raise ShapeError(f"Expected a rotation as R_tool_sensor of a force sensor, got {R}.") from None
        if self.sign not in (1, -1):
            raise ShapeError(f"Expected the sign +1 or -1 of a force sensor, got {self.sign!r}.")
        if not 0.0 <= self.mass < np.inf:
            raise ShapeError(f"Expected a mass of 0 kg or more on a force sensor, got {self.mass!r}.")

    def unloaded(self, T_base_tool: np.ndarray) -> np.ndarray:
        """Return what the sensor reads without contact, at rest: weight and bias (..., 6), sensor axes [N, N m].

        Parameters
        ----------
        T_base_tool : (..., 4, 4) pose of the tool.

        Raises
        ------
        ShapeError : poses of another shape.
        """
        R_base_tool = _poses(T_base_tool)[..., :3, :3]
        weight = (self.sign * self.mass) * (self.gravity @ (R_base_tool @ self.R_tool_sensor))
        return np.concatenate([weight, np.cross(self.centre, weight)], axis=-1) + self.bias

    def contact(self, raw: np.ndarray, T_base_tool: np.ndarray, frame: Literal["base", "tool"] = "base") -> np.ndarray:
        """Return the wrench of the environment on the robot, at the sensor's origin.

        ``[f; m] = s R (raw - unloaded)``, with R from sensor axes to those of `frame`, for forces and moments alike.

        Parameters
        ----------
        raw : (..., 6) as read, sensor axes [N, N m]; NaN stays NaN.
        T_base_tool : (..., 4, 4) pose of the tool at that time.
        frame : axes of the result, "base" or "tool".

        Raises
        ------
        ShapeError : readings or poses of another shape. UnknownName : another frame.
        """
        if frame not in _FRAMES:
            raise UnknownName.among("frame of a contact", frame, _FRAMES)
        poses, raw = _poses(T_base_tool), np.asarray(raw, dtype=np.float64)
        if raw.shape[-1:] != (6,):
            raise ShapeError(f"Expected readings (..., 6) of a force sensor, forces first, got shape {raw.shape}.")
        R = self.R_tool_sensor if frame == "tool" else poses[..., :3, :3] @ self.R_tool_sensor
        own = self.sign * (raw - self.unloaded(poses))
        pairs = own.reshape(*own.shape[:-1], 2, 3)  # force and moment as rows: (R v)^T = v^T R^T
        return (pairs @ np.swapaxes(R, -1, -2)).reshape(own.shape)

    def wrench(self, raw: np.ndarray, T_base_tool: np.ndarray) -> np.ndarray:
        """Return the wrench of the environment on the robot at the tool point, base axes, as `State.wrench` is.

        ``m_tool = m_sensor + p x f``, with p from the tool point to the sensor's origin.

        Parameters
        ----------
        raw, T_base_tool : see `contact`.

        Raises
        ------
        ShapeError : readings or poses of another shape.
        """
        found = self.contact(raw, T_base_tool)
        p = _poses(T_base_tool)[..., :3, :3] @ self.position
        found[..., 3:] += np.cross(p, found[..., :3])
        return found


def _poses(T_base_tool: np.ndarray) -> np.ndarray:
    poses = np.asarray(T_base_tool, dtype=np.float64)
    if poses.shape[-2:] != (4, 4):
        raise ShapeError(f"Expected poses T_base_tool (..., 4, 4), got shape {poses.shape}.")
    return poses


# A calibrated accelerometer on the tool: its axes, scale and bias.


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
    """

    R_tool_sensor: np.ndarray
    bias: np.ndarray
    scale: float = 1.0
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -9.80665]))
    robot_name: str = ""
    robot_hash: str = ""
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze_arrays(self, "an accelerometer", {"R_tool_sensor": (3, 3), "bias": (3,), "gravity": (3,)})
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


# A laser line scanner on a tool, and the plates by which it was calibrated.


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
    """

    T_tool_sensor: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    planes: tuple[str, ...]
    robot_name: str = ""
    robot_hash: str = ""
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        P = len(self.planes)
        freeze_arrays(self, "a laser sensor", {"T_tool_sensor": (4, 4), "normals": (P, 3), "offsets": (P,)})
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


# A camera and a marker on a robot: which of the two is on the tool, and where both are.


FRAMES = {"eye_to_hand": ("T_tool_marker", "T_base_cam"), "eye_in_hand": ("T_base_marker", "T_tool_cam")}


@dataclass(frozen=True, eq=False)
class HandEye:
    """The two poses that close the loop of robot and camera.

        eye_to_hand:  T_base_tool T_tool_marker     = T_base_cam T_cam_marker
        eye_in_hand:  T_base_tool^-1 T_base_marker  = T_tool_cam T_cam_marker

    Read them by their names: `T_tool_marker` and `T_base_cam`, or `T_base_marker` and `T_tool_cam`.

    Attributes
    ----------
    setup : "eye_to_hand", the camera stands and the marker is on the tool, or "eye_in_hand".
    X : (4, 4) T_tool_marker or T_base_marker; None where only points of a marker of unknown shape were seen.
    Y : (4, 4) T_base_cam or T_tool_cam.
    points : (K, 3) points of the marker in the frame that carries it, tool or base [m]; None where poses were measured.
    """

    setup: str
    X: np.ndarray | None
    Y: np.ndarray
    points: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.setup not in FRAMES:
            raise UnknownName.among("setup", self.setup, FRAMES)
        for name in ("X", "Y", "points"):
            given = getattr(self, name)
            if given is None and name != "Y":
                continue
            values = np.array(given, dtype=float)
            good = values.ndim == 2 and values.shape[1] == 3 if name == "points" else values.shape == (4, 4)
            if not good or not np.isfinite(values).all():
                what = "points (K, 3)" if name == "points" else f"a pose {name} (4, 4)"
                raise ShapeError(f"Expected {what} of a hand-eye calibration, finite, got {values.shape}. Correct it.")
            if name != "points":
                kernels.poses(values, name)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def T_tool_marker(self) -> np.ndarray:
        """Marker on the tool (4, 4); eye_to_hand only."""
        return self._named("T_tool_marker")

    @property
    def T_base_cam(self) -> np.ndarray:
        """Camera that stands (4, 4); eye_to_hand only."""
        return self._named("T_base_cam")

    @property
    def T_base_marker(self) -> np.ndarray:
        """Marker that stands (4, 4); eye_in_hand only."""
        return self._named("T_base_marker")

    @property
    def T_tool_cam(self) -> np.ndarray:
        """Camera on the tool (4, 4); eye_in_hand only."""
        return self._named("T_tool_cam")

    def _named(self, name: str) -> np.ndarray:
        names = FRAMES[self.setup]
        value = dict(zip(names, (self.X, self.Y))).get(name)
        if value is None:
            known = [other for other, pose in zip(names, (self.X, self.Y)) if pose is not None]
            raise FrameError(
                f"Expected a pose that setup {self.setup!r} has, {' or '.join(known)}, got {name}. "
                "Read that, or calibrate the other setup; a marker of unknown shape has points and no pose."
            )
        return value
