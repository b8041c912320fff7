"""Sensor models: force sensors, accelerometers, laser line scanners, and cameras with markers."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite, isnan
from typing import Literal

import numpy as np

from armlab import kernels
from armlab._display import Shown
from armlab._numbers import still
from armlab.errors import FrameError, ShapeError, UnknownName
from armlab.lie import so3
from armlab.models.friction import freeze_arrays

_SHAPES = {"R_tool_sensor": (3, 3), "centre": (3,), "bias": (6,), "gravity": (3,), "position": (3,)}
_MOMENTS = {"centre": slice(0, 3), "bias": slice(3, 6)}  # NaN if the fit had no torques
_FRAMES = ("base", "tool")


@dataclass(frozen=True, eq=False, repr=False)
class ForceSensor(Shown):
    """Force sensor at the tool, with its load and bias.

    Without contact, the sensor reads, in its own axes, ``f = s m g_s + b_f`` and ``tau = c x (s m g_s) + b_tau``, with
    ``g_s = R_tool_sensor^T R_base_tool^T g``.

    Attributes
    ----------
    R_tool_sensor : (3, 3) rotation from sensor axes to tool axes.
    mass : m, load on the sensor [kg].
    centre : c (3,) centre of mass of the load, sensor axes [m].
    bias : (6,) reading without load, sensor axes [N, N m].
    sign : s, +1 if the sensor reads the weight of its load, -1 if it reads the reaction.
    gravity : g (3,) base axes [m/s^2].
    position : (3,) sensor origin in the tool frame [m].
    robot_name, robot_hash : the robot that carries the sensor; empty for any robot.
    sources : logs used for the fit.

    Raises
    ------
    ShapeError : an invalid shape, rotation, mass or sign. After a calibration with forces only, `centre` and the
        moments of `bias` may be NaN; contact moments are then NaN.
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
                raise ShapeError(
                    f"Expected a finite {name} of shape {shape} for a force sensor, got {values.tolist()}."
                )
            object.__setattr__(self, name, values)
        try:
            so3.log(self.R_tool_sensor)
        except ShapeError:
            R = self.R_tool_sensor.tolist()
            raise ShapeError(f"Expected R_tool_sensor of a force sensor to be a rotation, got {R}.") from None
        if self.sign not in (1, -1):
            raise ShapeError(f"Expected the sign of a force sensor to be +1 or -1, got {self.sign!r}.")
        if not 0.0 <= self.mass < np.inf:
            raise ShapeError(f"Expected a mass of at least 0 kg on a force sensor, got {self.mass!r}.")

    def unloaded(self, T_base_tool: np.ndarray) -> np.ndarray:
        """Return the reading at rest without contact: weight and bias (..., 6) in sensor axes [N, N m].

        Parameters
        ----------
        T_base_tool : (..., 4, 4) pose of the tool.

        Raises
        ------
        ShapeError : poses of the wrong shape.
        """
        R_base_tool = _poses(T_base_tool)[..., :3, :3]
        weight = (self.sign * self.mass) * (self.gravity @ (R_base_tool @ self.R_tool_sensor))
        return np.concatenate([weight, np.cross(self.centre, weight)], axis=-1) + self.bias

    def contact(self, raw: np.ndarray, T_base_tool: np.ndarray, frame: Literal["base", "tool"] = "base") -> np.ndarray:
        """Return the wrench exerted by the environment on the robot at the sensor's origin.

        ``[f; m] = s R (raw - unloaded)``, where R rotates both forces and moments from sensor axes to the axes of
        `frame`.

        Parameters
        ----------
        raw : (..., 6) reading, sensor axes [N, N m]; NaN stays NaN.
        T_base_tool : (..., 4, 4) pose of the tool at that time.
        frame : axes of the result, "base" or "tool".

        Raises
        ------
        ShapeError : readings or poses of the wrong shape.
        UnknownName : unknown frame.
        """
        if frame not in _FRAMES:
            raise UnknownName.among("frame of a contact", frame, _FRAMES)
        poses, raw = _poses(T_base_tool), np.asarray(raw, dtype=np.float64)
        if raw.shape[-1:] != (6,):
            raise ShapeError(f"Expected readings (..., 6) of a force sensor, forces first, got shape {raw.shape}.")
        R = self.R_tool_sensor if frame == "tool" else poses[..., :3, :3] @ self.R_tool_sensor
        own = self.sign * (raw - self.unloaded(poses))
        pairs = own.reshape(*own.shape[:-1], 2, 3)  # rows of force and moment: (R v)^T = v^T R^T
        return (pairs @ np.swapaxes(R, -1, -2)).reshape(own.shape)

    def wrench(self, raw: np.ndarray, T_base_tool: np.ndarray) -> np.ndarray:
        """Return the environment's wrench on the robot at the tool point in base axes, as in `State.wrench`.

        ``m_tool = m_sensor + p x f``, with p from the tool point to the sensor's origin.

        Parameters
        ----------
        raw, T_base_tool : see `contact`.

        Raises
        ------
        ShapeError : readings or poses of the wrong shape.
        """
        found = self.contact(raw, T_base_tool)
        p = _poses(T_base_tool)[..., :3, :3] @ self.position
        found[..., 3:] += np.cross(p, found[..., :3])
        return found


def _restore_digits(sensor: object, name: str) -> None:
    """Reject a field that is not a rotation or pose; orthonormalise rounded values."""
    check = kernels.poses if name.startswith("T") else kernels.rotations
    object.__setattr__(sensor, name, still(check(getattr(sensor, name), name), name))


def _poses(T_base_tool: np.ndarray) -> np.ndarray:
    poses = np.asarray(T_base_tool, dtype=np.float64)
    if poses.shape[-2:] != (4, 4):
        raise ShapeError(f"Expected poses T_base_tool (..., 4, 4), got shape {poses.shape}.")
    return kernels.poses(poses, "T_base_tool")


# Calibrated accelerometer on the tool: axes, scale and bias.


@dataclass(frozen=True, eq=False, repr=False)
class Accelerometer(Shown):
    """Accelerometer on the tool; at rest, its reading is g, directed upwards.

    The reading at acceleration a is::

        y = scale R_tool_sensor^T R_base_tool^T (a - g) + b

    Attributes
    ----------
    R_tool_sensor : (3, 3) rotation from sensor axes to tool axes.
    bias : b (3,) sensor axes [m/s^2].
    scale : scale factor of the readings; 1 is ideal.
    gravity : g (3,) base axes [m/s^2].
    robot_name, robot_hash : the robot that carries the sensor; empty for any.
    sources : logs used for the fit.

    Raises
    ------
    ShapeError : an invalid shape, rotation or scale.
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
        _restore_digits(self, "R_tool_sensor")
        if not 0.0 < self.scale < np.inf:
            raise ShapeError(f"Expected an accelerometer scale above zero, got {self.scale!r}.")

    def acceleration(self, raw: np.ndarray, T_base_tool: np.ndarray) -> np.ndarray:
        """Return the acceleration of the sensor (..., 3) in base axes [m/s^2]; zero at rest.

        Parameters
        ----------
        raw : (..., 3) reading, sensor axes [m/s^2]; NaN stays NaN.
        T_base_tool : (..., 4, 4) pose of the tool at that time.

        Raises
        ------
        ShapeError : readings or poses of the wrong shape, or invalid poses.
        """
        poses, raw = np.asarray(T_base_tool, dtype=np.float64), np.asarray(raw, dtype=np.float64)
        if poses.shape[-2:] != (4, 4) or raw.shape[-1:] != (3,):
            raise ShapeError(
                f"Expected readings (..., 3) and poses T_base_tool (..., 4, 4), got {raw.shape} and {poses.shape}."
            )
        felt = (raw - self.bias) / self.scale
        R_base_sensor = _poses(poses)[..., :3, :3] @ self.R_tool_sensor
        return (R_base_sensor @ felt[..., None])[..., 0] + self.gravity


# Laser line scanner on a tool, and its calibration plates.


@dataclass(frozen=True, eq=False, repr=False)
class LaserSensor(Shown):
    """Laser line scanner on the tool, and the planes ``n . x = d`` of its calibration.

    Attributes
    ----------
    T_tool_sensor : (4, 4) pose of the sensor; the laser plane is its xy plane.
    normals : n (P, 3) unit normals, base axes.
    offsets : d (P,) at least 0 [m].
    planes : labels of the planes.
    robot_name, robot_hash : the robot that carries the sensor; empty for any.
    sources : logs used for the fit.

    Raises
    ------
    ShapeError : an invalid pose or normal, or inconsistent numbers of planes.
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
        _restore_digits(self, "T_tool_sensor")
        if np.abs(np.linalg.norm(self.normals, axis=1) - 1.0).max(initial=0.0) > 1e-9:
            raise ShapeError(
                "Expected unit normals for a laser sensor's planes, got other vectors. Normalise the normals."
            )

    def points(self, p: np.ndarray, T_base_tool: np.ndarray) -> np.ndarray:
        """Return points (..., 3) in base axes.

        Parameters
        ----------
        p : (..., 2) measured points, laser plane [m]; NaN stays NaN.
        T_base_tool : (..., 4, 4) pose of the tool at that time.

        Raises
        ------
        ShapeError : points or poses of the wrong shape, or invalid poses.
        """
        p, poses = np.asarray(p, dtype=np.float64), np.asarray(T_base_tool, dtype=np.float64)
        if p.shape[-1:] != (2,) or poses.shape[-2:] != (4, 4):
            raise ShapeError(f"Expected points (..., 2) and poses (..., 4, 4), got {p.shape} and {poses.shape}.")
        T = _poses(poses) @ self.T_tool_sensor
        return (T[..., :3, :2] @ p[..., None])[..., 0] + T[..., :3, 3]


# Hand-eye setup of a camera and a marker, with both poses.


FRAMES = {"eye_to_hand": ("T_tool_marker", "T_base_cam"), "eye_in_hand": ("T_base_marker", "T_tool_cam")}


@dataclass(frozen=True, eq=False, repr=False)
class HandEye(Shown):
    """The two poses that close the hand-eye loop.

    The equation depends on the setup::

        eye_to_hand:  T_base_tool T_tool_marker     = T_base_cam T_cam_marker
        eye_in_hand:  T_base_tool^-1 T_base_marker  = T_tool_cam T_cam_marker

    Named access: `T_tool_marker` and `T_base_cam`, or `T_base_marker` and `T_tool_cam`.

    Attributes
    ----------
    setup : "eye_to_hand", a fixed camera and a marker on the tool, or "eye_in_hand".
    X : (4, 4) T_tool_marker or T_base_marker; None after a fit to points of a marker of unknown shape.
    Y : (4, 4) T_base_cam or T_tool_cam.
    points : (K, 3) points of the marker in its parent frame, tool or base [m]; None after a fit to poses.
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
                raise ShapeError(
                    f"Expected {what} with finite values for a hand-eye calibration, got NaN, Inf or shape "
                    f"{values.shape}. Correct the value."
                )
            if name != "points":
                values = kernels.poses(values, name)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def T_tool_marker(self) -> np.ndarray:
        """Pose of the marker on the tool (4, 4); eye_to_hand only."""
        return self._named("T_tool_marker")

    @property
    def T_base_cam(self) -> np.ndarray:
        """Pose of the fixed camera (4, 4); eye_to_hand only."""
        return self._named("T_base_cam")

    @property
    def T_base_marker(self) -> np.ndarray:
        """Fixed marker (4, 4); eye_in_hand only."""
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
                f"Expected a pose of setup {self.setup!r}, {' or '.join(known)}, got {name}. "
                "Use one of these poses, or calibrate the other setup. "
                "A marker of unknown shape has points but no pose."
            )
        return value
