"""Browser scene: arms, tool paths, forces with uncertainty, and named frames.

Links without meshes are drawn as capsules derived from the kinematics, and joints as cylinders about their axes.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import COLORS, GREY, VERMILION
from armlab._numbers import numbers, positive
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.kinematics import forward, link_transforms
from armlab.lie import quaternion, se3
from armlab.robots import Mesh, Robot
from armlab.robots.robot import arm_length, bends

if TYPE_CHECKING:
    from trimesh import Trimesh
    from viser import ViserServer

_THICK = (0.042, 0.020)  # radii of the first and last link relative to the arm length
_DRUM = (1.25, 2.6)  # radius and length of a joint relative to the radius of its link
_STROKE = 0.3  # default stroke of a prismatic joint without limits, relative to the arm length
_SIDES = 20
_SHAFT, _HEAD = 0.008, (0.02, 0.72)  # arrow: shaft radius [m]; head radius [m] and relative position of the head's base


def capsule(a: np.ndarray, b: np.ndarray, radius: float) -> Trimesh:
    """Return a capsule of the given radius [m] around the line segment from a to b (3,)."""
    from trimesh import creation

    length = float(np.linalg.norm(b - a))
    body = creation.capsule(length, radius, count=[_SIDES, _SIDES])
    body.apply_translation([0.0, 0.0, length / 2.0 - body.bounds[:, 2].mean()])
    return body.apply_transform(along(a, b))


def box(a: np.ndarray, b: np.ndarray, width: float) -> Trimesh:
    """Return a rod from a to b (3,) with a square cross-section of the given width [m]."""
    from trimesh import creation

    T = along(a, b)
    T[:3, 3] = 0.5 * (a + b)
    return creation.box((width, width, float(np.linalg.norm(b - a))), transform=T)


def arrow() -> Trimesh:
    """Return an arrow from the origin to (0, 0, 1), to be scaled by force."""
    from trimesh import creation

    radius, begin = _HEAD
    shaft, head = creation.cylinder(_SHAFT, begin, sections=_SIDES), creation.cone(radius, 1.0 - begin, sections=_SIDES)
    shaft.apply_translation([0.0, 0.0, begin / 2.0])
    head.apply_translation([0.0, 0.0, begin])
    return shaft + head


def bodies(robot: Robot) -> list[Trimesh]:
    """Return n + 1 shapes: the mount from base to joint 1 in base axes, and each link in its own frame.

    A link follows its joint axes and their common normal, as in `plots.robot`; links become thinner towards the tool. A
    prismatic joint is drawn as a rod along its axis, as long as its stroke. The last shape includes the tool.
    """
    from trimesh.util import concatenate

    length = arm_length(robot)
    radii = length * np.linspace(*_THICK, robot.n + 1)
    shapes = []
    for i, E in enumerate(robot.frames):
        start = robot.T_base_mount[:3, 3] if i == 0 else np.zeros(3)
        axis = robot.T_base_mount[:3, 2] if i == 0 else np.array([0.0, 0.0, 1.0])
        end, towards = E[:3, 3], E[:3, 2]
        points = [start, *bends(start, axis, end, towards), end] if i < robot.n else [start, end]
        points = [np.zeros(3), *points] if i == 0 else points
        parts = [capsule(a, b, radii[i]) for a, b in pairwise(points) if np.linalg.norm(b - a) > 1e-6]
        if i and robot.prismatic[i - 1]:
            limits = np.array([robot.q_min[i - 1], robot.q_max[i - 1]])
            low, high = np.where(np.isfinite(limits), limits, [0.0, _STROKE * length])
            parts.append(box(-max(high, 0.0) * axis, -min(low, 0.0) * axis, 2.0 * radii[i]))
        shapes.append(concatenate(parts or [capsule(start, start, radii[i])]))
    return shapes


def drums(robot: Robot) -> list[Trimesh]:
    """Return the n joint shapes, each about the z axis of its link frame."""
    from trimesh import creation

    radii = arm_length(robot) * np.linspace(*_THICK, robot.n + 1)[1:]
    return [creation.cylinder(_DRUM[0] * radius, _DRUM[1] * radius, sections=_SIDES) for radius in radii]


def along(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) at point a (3,) whose z axis points to b (3,), or along the base's z axis if b equals a."""
    z = b - a
    z = z / np.linalg.norm(z) if z.any() else np.array([0.0, 0.0, 1.0])
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return se3.from_rp(np.stack([x, np.cross(z, x), z], axis=1), a)


def mesh_bodies(robot: Robot, folders: Sequence[Path] = ()) -> list[Trimesh | None]:
    """Return n + 1 shapes from the robot's visual meshes, in the axes of `bodies`; None for a link without meshes.

    A single warning lists all missing or unreadable files. ``package://maker/a/b.stl`` is searched for as
    ``maker/a/b.stl`` and ``a/b.stl`` in each folder, then in the folders of ROS_PACKAGE_PATH and AMENT_PREFIX_PATH.
    """
    from trimesh.util import concatenate

    missing: list[str] = []
    folders = [*(folders or [Path()]), *ros_folders()]
    shapes: list[Trimesh | None] = []
    for i, link in enumerate(robot.meshes):
        visual = [mesh for mesh in link if mesh.kind == "visual"]
        found = [_read(mesh, folders) for mesh in visual]
        missing += [mesh.file for mesh, one in zip(visual, found) if one is None and mesh.file not in missing]
        parts = [one for one in found if one is not None]
        whole: Any = concatenate(parts) if parts and len(parts) == len(visual) else None
        shapes.append(whole.apply_transform(robot.T_base_mount) if whole is not None and i == 0 else whole)
    if missing:
        packages = any(file.startswith("package://") for file in missing)
        advice = " Pass the folder that contains the package with --package-path FOLDER." if packages else ""
        collada = any(file.lower().endswith(".dae") for file in missing) and find_spec("collada") is None
        advice += " A .dae file requires pycollada: pip install 'armlab[live]'." if collada else ""
        more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
        said = f"Expected readable meshes of {robot.name}, but cannot read {', '.join(missing[:5])}{more}"
        warnings.warn(f"{said}: capsules are drawn instead.{advice}", stacklevel=2)
    return shapes or [None] * (robot.n + 1)


def ros_folders() -> list[Path]:
    """Return the folders that ROS searches for packages."""
    found = [Path(word) for word in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if word]
    return found + [Path(word) / "share" for word in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if word]


def _read(mesh: Mesh, folders: Sequence[Path]) -> Trimesh | None:
    """Return the mesh of a file in its link frame, or None if it is missing, empty or unreadable."""
    import trimesh

    name = mesh.file.removeprefix("file://").removeprefix("package://")
    names = (name, name.partition("/")[2]) if mesh.file.startswith("package://") else (name,)
    for path in (folder / name for folder in folders for name in names):
        if path.is_file():
            try:
                read = trimesh.load_mesh(path)
                return read.apply_scale(mesh.scale).apply_transform(mesh.T_link_mesh) if len(read.faces) else None
            except Exception:  # mesh readers raise different exception types
                return None
    return None


def solid(scene: Any, name: str, body: Trimesh, color: str) -> Any:
    body = body.smooth_shaded  # keeps sharp edges
    return scene.add_mesh_simple(name, body.vertices.astype(np.float32), body.faces.astype(np.uint32), color=rgb(color))


def rgb(color: str) -> tuple[int, int, int]:
    """Return the red, green and blue values (0 to 255) of a colour such as "#0072B2"."""
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue


_ZERO_OUTSIDE = 7.81  # 95 % quantile of chi-square with 3 degrees of freedom
_SURE = 1e-6  # N, minimum half-axis of an ellipsoid
_SHORTEST, _FULL = 1e-3, 0.15  # m: shortest arrow drawn, and shortest arrow drawn at full width


class ForceArrow:
    """Arrow of a force and its uncertainty ellipsoid; both are grey while the 95 % ellipsoid contains zero."""

    def __init__(self, scene: Any, root: str) -> None:
        self._arrow = solid(scene, f"{root}/force", arrow(), VERMILION)
        self._spread = scene.add_icosphere(
            f"{root}/uncertainty", 1.0, rgb(VERMILION), opacity=0.3, visible=False, cast_shadow=False
        )
        self.hide()

    def hide(self) -> None:
        self._arrow.visible = self._spread.visible = False

    def show(self, tool: np.ndarray, force: np.ndarray | None, covariance: np.ndarray | None, unit: float) -> None:
        """Draw a force (3,) [N] and its ellipsoid at the tool, at a scale `unit` [m/N]; hide a NaN force."""
        if force is None or not np.isfinite(force).all():
            self.hide()
            return
        covariance = np.full((3, 3), np.nan) if covariance is None else covariance
        known = bool(np.isfinite(covariance).all())
        axes, half = ellipsoid_axes(covariance) if known else (np.eye(3), np.zeros(3))
        color = rgb(VERMILION if is_significant(force, axes, half) else GREY)
        tip = unit * force
        length = math.hypot(*tip)
        self._arrow.visible = length >= _SHORTEST
        if length >= _SHORTEST:
            thick = min(max(length / _FULL, 0.3), 1.0)
            self._arrow.position, self._arrow.wxyz = tool, _towards(*(tip / length).tolist())
            self._arrow.scale, self._arrow.color = (thick, thick, length), color
        self._spread.visible = known
        if known:
            self._spread.position, self._spread.wxyz = tool + tip, quaternion.from_matrix(axes)
            self._spread.scale, self._spread.color = tuple(unit * np.maximum(half, _SURE)), color


def ellipsoid_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes (columns of a rotation matrix) and half-axes of the 2-sigma ellipsoid ``x^T C^-1 x = 4``."""
    size, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    return axes, 2.0 * np.sqrt(np.maximum(size, 0.0))


def is_significant(force: np.ndarray, axes: np.ndarray, half: np.ndarray) -> bool:
    """Return whether zero is outside the 95 % ellipsoid of a force f (3,): ``f^T C^-1 f >= 7.81``."""
    return bool(4.0 * np.sum((force @ axes / np.maximum(half, _SURE)) ** 2) >= _ZERO_OUTSIDE)


def _towards(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return the quaternion (wxyz) of the smallest rotation from the z axis to a unit vector."""
    w = 1.0 + z if z > 0.0 else (x * x + y * y) / (1.0 - z)  # equivalent expression that is accurate near -z
    size = math.hypot(w, x, y)
    return (w / size, -y / size, x / size, 0.0) if size else (0.0, 1.0, 0.0, 0.0)


ARROW = 0.2 / 20.0
"""Default arrow length per unit force [m/N]."""
LINK_COLORS = ("#8FB4D9", "#E2BE8C")
"""Link colours of the first arm, the second arm, and so on."""
TOOL_COLOR = "#C800C8"
"""Colour reserved for the tool point."""

_TOOL, _AXES = 0.03, 0.1  # radius of the tool sphere and length of its axes, relative to the arm length
_MOST_POINTS = 300  # maximum number of points drawn per path


class RobotScene:
    """Arms in a common world, drawn by `show`. All other nodes of viser's ``server.scene`` are available for other
    purposes.

    Links are capsules in the colour of their arm, joints are cylinders in the colour of their curves, and the tool
    point is a sphere with axes. The arrow is the force exerted by the environment on the robot; the ellipsoid at its
    tip is the 2-sigma uncertainty. The arrow and the ellipsoid are grey while the 95 % ellipsoid contains zero.

    `T_world_base`: pose (4, 4) of each arm's base in the world, keyed by arm name; default: the identity. The mount is
    part of the robot. `meshes`: folders of the mesh files; default: the current folder. `arrow`: length of force arrows
    [m/N]; a change takes effect at the next `show`.
    """

    def __init__(
        self,
        server: ViserServer,
        robots: Iterable[Robot],
        T_world_base: Mapping[str, ArrayLike] | None = None,
        *,
        meshes: Sequence[Path] = (),
    ) -> None:
        arms = list(robots)
        for robot in arms:
            if not isinstance(robot, Robot):
                raise RobotError.no_robot(robot)
        names = [robot.name for robot in arms]
        if not arms or len(set(names)) < len(arms):
            raise RobotError(f"Expected robots with different names, got {', '.join(names) or 'none'}. Rename one.")
        self.arrow = ARROW
        self._server, self._meshes = server, meshes
        bases = dict(T_world_base or {})
        for name in bases:
            if name not in names:
                raise UnknownName.among("arm in this view", name, names)
        self.robots: dict[str, Robot] = {}
        self._arms: dict[str, _ArmNodes] = {}
        self._frames: dict[str, Any] = {}
        for robot in arms:
            self.add(robot, bases.get(robot.name))
        self._surround()

    def add(self, robot: Robot, T_world_base: ArrayLike | None = None) -> None:
        """Add an arm with its base at a pose (4, 4), by default the identity; replace any arm with the same name."""
        if robot.name in self.robots:
            self.remove(robot.name)
        T = _pose(np.eye(4) if T_world_base is None else T_world_base)
        self._arms[robot.name] = _ArmNodes(self._server.scene, robot, T, LINK_COLORS[len(self._arms) % 2], self._meshes)
        self.robots[robot.name] = robot

    def remove(self, name: str) -> None:
        self._robot(name)
        del self.robots[name]
        self._arms.pop(name).root.remove()

    def arrange(self, T_world_base: Mapping[str, ArrayLike]) -> None:
        """Move the bases to poses (4, 4), and centre the floor and the initial camera on them."""
        for name, T in T_world_base.items():
            self._robot(name)
            arm = self._arms[name]
            arm.T_world_base = _pose(T)
            _place(arm.root, arm.T_world_base)
        self._surround()

    def show(
        self, name: str, q: ArrayLike, wrench: ArrayLike | None = None, covariance: ArrayLike | None = None
    ) -> None:
        """Draw an arm at a configuration q (n,) [rad or m] and the force on it. Missing or NaN values are hidden.

        `wrench`: wrench (6,) or force (3,) exerted by the environment on the robot, in base axes at the tool point [N,
        N m]. `covariance`: covariance (6, 6) or (3, 3) of the wrench or force. Draw all arms of a frame inside ``with
        server.atomic():``.
        """
        robot = self._robot(name)
        q = _array(q, "q", ((robot.n,),))
        force = None if wrench is None else _array(wrench, "wrench", ((6,), (3,)))[:3]
        spread = None if covariance is None else _array(covariance, "covariance", ((6, 6), (3, 3)))[:3, :3]
        self._arms[name].show(q, force, spread, positive(self.arrow, "length of a force [m/N]"))

    def trace(self, name: str, points: ArrayLike) -> None:
        """Draw the thinned tool path (K, 3) of an arm in base axes [m]; hide it if fewer than two points are finite."""
        self._robot(name)
        points = numbers(points, "points of a path", ShapeError)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ShapeError(f"Expected path points of shape (K, 3), got {points.shape}.")
        self._arms[name].trace(points[np.isfinite(points).all(axis=1)])

    def frame(self, name: str, T_world_x: ArrayLike | None, length: float = 0.1) -> None:
        """Draw a named frame at a pose (4, 4), or move it there; None removes it. `length`: length of the frame's axes
        [m]."""
        if T_world_x is None:
            if name in self._frames:
                self._frames.pop(name).remove()
            return
        T = _pose(T_world_x)
        if name not in self._frames:
            path = f"/frames/{name}"
            self._frames[name] = self._server.scene.add_frame(path, axes_length=length, axes_radius=0.03 * length)
            self._server.scene.add_label(f"{path}/name", name)
        _place(self._frames[name], T)

    def _robot(self, name: str) -> Robot:
        if name not in self.robots:
            raise UnknownName.among("arm in this view", name, self.robots)
        return self.robots[name]

    def _surround(self) -> None:
        """Place a floor below the arms and the camera in front of them."""
        reach = max(arm_length(robot) for robot in self.robots.values())
        arms = zip(self._arms.values(), self.robots.values())
        bases = [(arm.T_world_base @ robot.T_base_mount)[:3, 3] for arm, robot in arms]
        low, high = np.min(bases, axis=0), np.max(bases, axis=0)
        centre, wide = (low + high) / 2.0, high - low
        floor, away = 4.0 * reach + wide, reach + 0.5 * float(np.linalg.norm(wide))
        place = (centre[0], centre[1], 0.0)
        self._server.scene.add_grid("/floor", floor[0], floor[1], cell_size=0.1, section_size=0.5, position=place)
        camera = self._server.initial_camera
        camera.look_at = tuple(centre + reach * np.array([0.25, 0.0, -0.05]))
        camera.position = tuple(centre + away * np.array([1.75, 0.9, 0.7]))
        camera.fov = np.deg2rad(45.0)


class _ArmNodes:
    """Scene nodes of one arm under ``/<name>``, in its base axes."""

    def __init__(self, scene: Any, robot: Robot, T_world_base: np.ndarray, color: str, meshes: Sequence[Path]) -> None:
        self.T_world_base = T_world_base
        self._robot = robot
        root, size = f"/{robot.name}", arm_length(robot)
        self.root = scene.add_frame(root, show_axes=False)
        _place(self.root, T_world_base)
        self._arm = scene.add_frame(f"{root}/arm", show_axes=False)
        shapes, given, joints = bodies(robot), mesh_bodies(robot, meshes), drums(robot)
        solid(scene, f"{root}/arm/mount", given[0] or shapes[0], color)
        self._links: list[Any] = []
        path = f"{root}/arm"
        for i in range(robot.n):
            path += f"/link_{i + 1}"
            self._links.append(solid(scene, path, given[i + 1] or shapes[i + 1], color))
            if given[i + 1] is None:
                solid(scene, f"{path}/joint", joints[i], COLORS[i % len(COLORS)])
        tool = scene.add_frame(f"{path}/tool", axes_length=_AXES * size, axes_radius=0.05 * _AXES * size)
        _place(tool, robot.frames[-1])
        scene.add_icosphere(f"{path}/tool/point", _TOOL * size, rgb(TOOL_COLOR), cast_shadow=False)
        self._force = ForceArrow(scene, root)
        self._path = scene.add_line_segments(
            f"{root}/path", np.zeros((1, 2, 3)), rgb(GREY), thickness=2.0, thickness_units="screen", visible=False
        )

    def show(self, q: np.ndarray, force: np.ndarray | None, spread: np.ndarray | None, unit: float) -> None:
        self._arm.visible = bool(np.isfinite(q).all())
        if not self._arm.visible:
            self._force.hide()
            return
        T = link_transforms(self._robot, q)
        local = np.concatenate([T[:1], se3.inv(T[:-1]) @ T[1:]])
        for link, T_link in zip(self._links, local):
            _place(link, T_link)
        self._force.show(forward(self._robot, q)[:3, 3], force, spread, unit)

    def trace(self, points: np.ndarray) -> None:
        points = points[:: max(1, -(-len(points) // _MOST_POINTS))]
        self._path.visible = len(points) > 1
        if len(points) > 1:
            self._path.points = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)


def arrow_slider(gui: Any, scene: RobotScene, changed: Callable[[], object] = lambda: None) -> Any:
    """Return a slider for the length of the force arrows; each change calls `changed`."""
    slider = gui.add_slider("force [mm/N]", 1.0, 50.0, 1.0, round(1e3 * scene.arrow))

    @slider.on_update
    def _(_: Any) -> None:
        scene.arrow = 1e-3 * float(slider.value)
        changed()

    return slider


def _place(handle: Any, T: np.ndarray) -> None:
    handle.position, handle.wxyz = T[:3, 3], quaternion.from_matrix(T[:3, :3])


def _pose(T: ArrayLike) -> np.ndarray:
    array = numbers(T, "a pose", ShapeError)
    if array.shape != (4, 4) or not se3.is_pose(array):
        raise ShapeError(f"Expected a pose (4, 4) to draw, got {np.array2string(array, precision=3)}.")
    return array


def _array(values: ArrayLike, what: str, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    array = numbers(values, what, ShapeError)
    if array.shape not in shapes:
        raise ShapeError(f"Expected {what} of shape {' or '.join(map(str, shapes))} to draw, got {array.shape}.")
    return array
