"""Lossless reader and writer of robot files in TOML. docs/decisions describes the format."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from typing import Any, Literal

import msgspec
import numpy as np

from armlab._files import parsed
from armlab.errors import RobotError, ShapeError
from armlab.lie import quaternion, se3
from armlab.robots.build import GRAVITY, RAMP_TIME, Details, from_dh, from_links
from armlab.robots.robot import Mesh, Robot

Vector = tuple[float, float, float]
Parameters = tuple[float, float, float, float, float, float, float, float, float, float]
ANGLES = ("alpha", "offset", "limits", "speed", "acceleration", "home")
Fields = dict[str, str]


class Pose(msgspec.Struct, forbid_unknown_fields=True):
    """Constant pose: position [m], and a quaternion wxyz or a rotation matrix."""

    position: Vector = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] | None = None
    rotation: tuple[Vector, Vector, Vector] | None = None


class Joint(msgspec.Struct, forbid_unknown_fields=True):
    """Joint with its DH row or the pose of the next joint, limits, home and gear."""

    name: str
    kind: Literal["revolute", "prismatic"] = "revolute"
    alpha: float = 0.0
    a: float = 0.0
    d: float = 0.0
    offset: float = 0.0
    next: Pose | None = None
    limits: tuple[float, float] = (-math.inf, math.inf)
    speed: float = math.inf
    acceleration: float | None = None
    home: float | None = None
    gear_ratio: float | None = None
    effort: float = math.inf


class LinkMesh(Pose, kw_only=True, forbid_unknown_fields=True):
    """Mesh of link 1 ... n, or of the mount (link 0)."""

    link: int
    file: str
    kind: Literal["visual", "collision"] = "visual"
    scale: Vector = (1.0, 1.0, 1.0)


class File(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    source: str | dict[str, str]
    joint: list[Joint]
    convention: Literal["standard", "modified"] = "standard"
    first: Pose | None = None
    side: Literal["left", "right", ""] = ""
    gravity: Vector = GRAVITY
    abb_axes: list[int] | None = None
    coupling: list[list[float]] | None = None
    mount: Pose = msgspec.field(default_factory=Pose)
    tool: Pose = msgspec.field(default_factory=Pose)
    inertias: list[Parameters] | None = None
    mesh: list[LinkMesh] = []
    drives: dict[str, list[float]] = {}


def read_robot(text: str, path: str) -> Robot:
    fields: dict[str, Any] = {}
    try:
        fields = parsed(text)
        if isinstance(meta := fields.get("meta"), dict) and "kind" in meta:
            raise RobotError(_no_robot_file(str(meta["kind"])))
        return _build(msgspec.convert(_in_radians(fields), File))
    except RobotError as error:
        raise RobotError(f"The robot file {path} does not describe a robot. {error}") from None
    except (ValueError, ArithmeticError, RecursionError) as error:  # invalid TOML, wrong fields, float overflow
        raise RobotError(
            f"Expected a robot file in {path}, got a file that cannot be read: {_as_written(str(error), fields)}. "
            "The documentation page 'Robot files' lists the fields."
        ) from None


def _no_robot_file(kind: str) -> str:
    text = f"This is a model file of kind {kind!r}; read it with armlab.models.load."
    if kind == "kinematic_correction":
        text += " To extract its robot: armlab.robots.save(armlab.models.load(path).robot, 'arm.toml')."
    return text


def _as_written(message: str, fields: dict[str, Any]) -> str:
    """Return the msgspec message with the field name used in the file, such as ``limits_deg`` for ``limits``."""
    place = re.search(r"\$\.joint\[(\d+)\]\.(\w+)", message)
    if place is None or f"{place[2]}_deg" not in fields["joint"][int(place[1])]:
        return message
    return message.replace(place[0], f"{place[0]}_deg")


def _in_radians(value: Any) -> Any:
    """Replace every ``x_deg`` by ``x`` in radians."""
    if isinstance(value, list):
        return [_in_radians(item) for item in value]
    if not isinstance(value, dict):
        return value
    for key in ("limits_deg", "speed_deg", "acceleration_deg", "home_deg"):
        if key in value and value.get("kind") == "prismatic":
            raise RobotError(f"Expected metres for the prismatic joint {value.get('name')!r}, got {key}.")

    def radians(item: Any) -> Any:
        if isinstance(item, list):
            return [radians(one) for one in item]
        return math.radians(item) if type(item) in (int, float) else item

    result = {}
    for key, item in value.items():
        name = key.removesuffix("_deg") if key.removesuffix("_deg") in ANGLES else key
        if name in result:
            raise RobotError(f"Expected either {name} or {name}_deg, got both in {value.get('name', 'the file')!r}.")
        result[name] = _in_radians(item) if name == key else radians(item)
    return result


def _build(file: File) -> Robot:
    joints = file.joint
    if not joints:
        raise RobotError("Expected at least one joint, got none.")
    prismatic = [joint.kind == "prismatic" for joint in joints]
    details = _details(file)
    if any(joint.next for joint in joints):
        for joint in joints:
            if joint.next is None or joint.alpha or joint.a or joint.d or joint.offset:
                raise RobotError(f"Expected DH numbers or `next` in all joints, got a mixture at {joint.name!r}.")
        poses = [("first", file.first or Pose()), *((f"next of {joint.name!r}", joint.next) for joint in joints)]
        links = [_matrix(pose, where) for where, pose in poses if pose]
        return from_links(file.name, links, prismatic, **details)
    if file.first:
        raise RobotError("Expected `first` only together with `next`, got DH numbers.")
    columns = np.array([(joint.alpha, joint.a, joint.d, joint.offset) for joint in joints]).T
    return from_dh(file.name, *columns, prismatic=prismatic, modified=file.convention == "modified", **details)


def _details(file: File) -> Details:
    joints, source = file.joint, file.source
    homes = [(joint.home, joint.limits) for joint in joints]
    details: Details = {
        "q_min": [joint.limits[0] for joint in joints],
        "q_max": [joint.limits[1] for joint in joints],
        "qd_max": [joint.speed for joint in joints],
        "qdd_max": [joint.speed / RAMP_TIME if joint.acceleration is None else joint.acceleration for joint in joints],
        "q_home": [min(max(0.0, low), high) if home is None else home for home, (low, high) in homes],
        "joint_names": [joint.name for joint in joints],
        "T_base_mount": _matrix(file.mount, "mount"),
        "T_flange_tool": _matrix(file.tool, "tool"),
        "gravity": file.gravity,
        "coupling": _coupling(file),
        "side": file.side,
        "source": source if isinstance(source, str) else "\n".join(f"{key}: {text}" for key, text in source.items()),
        "tau_max": [joint.effort for joint in joints],
        "inertias": file.inertias,
        "meshes": _meshes(file),
        "drives": file.drives,
    }
    if file.abb_axes is not None:
        details["abb_axes"] = file.abb_axes
    return details


def _meshes(file: File) -> list[list[Mesh]]:
    if not file.mesh:
        return []
    meshes: list[list[Mesh]] = [[] for _ in range(len(file.joint) + 1)]
    for mesh in file.mesh:
        if not 0 <= mesh.link < len(meshes):
            raise RobotError(
                f"Expected mesh {mesh.file!r} on a link from 0 (the mount) to {len(file.joint)}, got {mesh.link}."
            )
        T_link_mesh = _matrix(mesh, f"mesh {mesh.file!r}")
        meshes[mesh.link].append(Mesh(mesh.kind, mesh.file, T_link_mesh, np.array(mesh.scale)))
    return meshes


def _coupling(file: File) -> np.ndarray:
    ratios = [joint.gear_ratio for joint in file.joint]
    if file.coupling is not None:
        if any(ratio is not None for ratio in ratios):
            raise RobotError("Expected gears either as coupling or as gear_ratio, got both.")
        lengths = [len(row) for row in file.coupling]
        if set(lengths) != {len(ratios)}:
            raise RobotError(f"Expected {len(ratios)} numbers in every row of coupling, got {lengths}.")
        return np.array(file.coupling)
    for joint in file.joint:
        if joint.gear_ratio == 0:
            raise RobotError(f"Expected a gear_ratio other than zero, got 0 in joint {joint.name!r}.")
    return np.diag([1.0 if ratio is None else 1.0 / ratio for ratio in ratios])


def _matrix(pose: Pose, where: str) -> np.ndarray:
    """Return the pose as a matrix; rounded rotations are orthonormalised."""
    if pose.quaternion is not None and pose.rotation is not None:
        raise RobotError(f"Expected either quaternion or rotation in {where}, got both.")
    R = np.eye(3) if pose.rotation is None else np.array(pose.rotation)
    try:
        if pose.quaternion is not None:
            R = quaternion.to_matrix(pose.quaternion)
        return se3.from_rp(R, pose.position)
    except ShapeError as error:
        raise RobotError(f"Expected a pose in {where}, got an invalid pose. {error}") from None


def write_robot(robot: Robot) -> str:
    """Return the TOML text of a robot, with DH rows if they are exact, otherwise with the pose of each joint relative
    to the previous one."""
    rows = [{"name": _text(name)} for name in robot.joint_names]
    dh = _dh_columns(robot)
    head: Fields = {"name": _text(robot.name)}
    if robot.side:
        head["side"] = _text(robot.side)
    if robot.abb_axes != tuple(range(1, robot.n + 1)):
        head["abb_axes"] = str(list(robot.abb_axes))
    if tuple(robot.gravity) != GRAVITY:
        head["gravity"] = _list(robot.gravity)
    if dh is None and not np.array_equal(robot.links[0], np.eye(4)):
        head["first"] = _inline(_pose_fields(robot.links[0]))
    ratios = _gear_ratios(robot)
    if ratios is None:
        head["coupling"] = _matrix_text(robot.coupling)
    for i, row in enumerate(rows):
        if robot.prismatic[i]:
            row["kind"] = '"prismatic"'
        row |= _link(robot, i, dh) | _limits(robot, i)
        if np.isfinite(robot.tau_max[i]):
            row["effort"] = _number(robot.tau_max[i])
        if ratios is not None and ratios[i] != 1:
            row["gear_ratio"] = _number(ratios[i])
    return _document(robot, head, rows)


def _document(robot: Robot, head: Fields, rows: list[Fields]) -> str:
    lines = [f"{key} = {value}" for key, value in head.items()]
    lines += ["", *_rows("joint", map(_inline, rows))]
    if robot.inertias is not None:
        lines += ["", "# m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz of each link about the origin of its frame"]
        lines += _rows("inertias", map(_list, robot.inertias))
    meshes = [_mesh(i, mesh) for i, meshes in enumerate(robot.meshes) for mesh in meshes]
    if meshes:
        lines += ["", *_rows("mesh", meshes)]
    if robot.drives:
        lines += ["", "[drives]", *(f"{key} = {_list(values)}" for key, values in robot.drives)]
    for key, T in (("mount", robot.T_base_mount), ("tool", robot.T_flange_tool)):
        if not np.array_equal(T, np.eye(4)):
            lines += ["", f"[{key}]", *(f"{name} = {value}" for name, value in _pose_fields(T).items())]
    table = _source_table(robot.source)
    if table is None:
        lines.insert(1, f"source = {_text(robot.source)}")
    else:
        bare = re.compile(r"[A-Za-z0-9_-]+")
        named = ((key if bare.fullmatch(key) else _text(key), _text(value)) for key, value in table.items())
        lines += ["", "[source]", *(f"{key} = {value}" for key, value in named)]
    return "\n".join(lines) + "\n"


def _rows(name: str, rows: Iterable[str]) -> list[str]:
    return [f"{name} = [", *(f"  {row}," for row in rows), "]"]


def _mesh(i: int, mesh: Mesh) -> str:
    fields = {"link": str(i), "kind": _text(mesh.kind), "file": _text(mesh.file)} | _pose_fields(mesh.T_link_mesh)
    if not np.array_equal(mesh.scale, np.ones(3)):
        fields["scale"] = _list(mesh.scale)
    return _inline(fields)


def _dh_columns(robot: Robot) -> np.ndarray | None:
    """Return the columns alpha, a, d, offset (4, n) of the standard DH table that reproduces the links exactly."""
    L = robot.links
    alpha = [_restore(-link[1, 2], link[2, 2]) for link in L[1:]]
    offset = [_restore(-link[0, 1], link[0, 0]) for link in L[:-1]]
    columns = np.array([alpha, L[1:, 0, 3], L[1:, 2, 3], offset])
    same = np.array_equal(from_dh(robot.name, *columns, prismatic=robot.prismatic).links, L)
    return columns if same else None


def _restore(sine: float, cosine: float) -> float:
    """Return the angle with the same sine and cosine, preferably with few digits in degrees or radians."""
    angle = math.atan2(sine, cosine)
    for short in (math.radians(float(f"{math.degrees(angle):.10g}")), float(f"{angle:.10g}")):
        if np.sin(short) == sine and np.cos(short) == cosine:
            return short
    return angle


def _link(robot: Robot, i: int, dh: np.ndarray | None) -> Fields:
    if dh is None:
        return {"next": _inline(_pose_fields(robot.links[i + 1]))}
    alpha, a, d, offset = dh[:, i]
    return _angles("alpha", alpha) | {"a": _number(a), "d": _number(d)} | _angles("offset", offset)


def _limits(robot: Robot, i: int) -> Fields:
    slides = bool(robot.prismatic[i])
    fields = {}
    if np.isfinite(robot.q_min[i]) or np.isfinite(robot.q_max[i]):
        fields |= _angles("limits", robot.q_min[i], robot.q_max[i], slides=slides)
    if np.isfinite(robot.qd_max[i]):
        fields |= _angles("speed", robot.qd_max[i], slides=slides)
    if robot.qdd_max[i] != robot.qd_max[i] / RAMP_TIME:
        fields |= _angles("acceleration", robot.qdd_max[i], slides=slides)
    return fields | _angles("home", robot.q_home[i], slides=slides)


def _gear_ratios(robot: Robot) -> list[float] | None:
    """Return motor revolutions per joint revolution if they reproduce G exactly."""
    gears = np.diag(robot.coupling)
    ratios = [float(f"{1 / gear:.10g}") if gear else 1.0 for gear in gears]
    same = np.array_equal(np.diag([1.0 / ratio for ratio in ratios]), robot.coupling)
    return ratios if same else None


def _angles(name: str, *values: float, slides: bool = False) -> Fields:
    """Return the field in degrees if a short decimal number of degrees converts back to exactly the same value,
    otherwise in SI units."""
    degrees = tuple(float(f"{math.degrees(value):.10g}") for value in values)
    if not slides and all(math.radians(short) == value for short, value in zip(degrees, values)):
        name, values = f"{name}_deg", degrees
    return {name: _list(values) if len(values) > 1 else ", ".join(map(_number, values))}


def _pose_fields(T: np.ndarray) -> Fields:
    fields = {"position": _list(T[:3, 3])}
    if not np.array_equal(T[:3, :3], np.eye(3)):
        fields["rotation"] = _matrix_text(T[:3, :3])
    return fields


def _source_table(source: str) -> dict[str, str] | None:
    """Return ``key: text`` lines as a table if all lines have that form."""
    pairs = [line.split(": ", 1) for line in source.split("\n")]
    if any(len(pair) != 2 for pair in pairs) or len({pair[0] for pair in pairs}) < len(pairs):
        return None
    return dict(pairs)


def _inline(fields: Fields) -> str:
    return "{ " + ", ".join(f"{key} = {value}" for key, value in fields.items()) + " }"


def _matrix_text(M: np.ndarray) -> str:
    return "[" + ", ".join(_list(row) for row in M) + "]"


def _list(values: np.ndarray | tuple[float, ...]) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _number(value: float) -> str:
    return repr(float(value) + 0.0).removesuffix(".0")  # + 0.0 turns -0.0 into 0.0


def _text(value: str) -> str:
    """Return a TOML basic string: a JSON string with the delete character escaped."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
