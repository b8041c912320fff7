"""From `Robot` to the text of a robot file that reads back to the same bits."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable

import numpy as np

from armlab.robots.build import GRAVITY, RAMP_TIME, from_dh
from armlab.robots.mesh import Mesh
from armlab.robots.robot import Robot

__all__ = ["write_robot"]

Fields = dict[str, str]


def write_robot(robot: Robot) -> str:
    """Return the TOML text of a robot: DH rows where they give the same bits, else the pose of each next joint.

    Parameters
    ----------
    robot : any robot.
    """
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
        head["first"] = _pose(robot.links[0])
    ratios = _gear_ratios(robot)
    if ratios is None:
        head["coupling"] = _matrix(robot.coupling)
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
    for key, T in (("mount", robot.T_base_mount), ("tool", robot.T_flange_tool)):
        if not np.array_equal(T, np.eye(4)):
            lines += ["", f"[{key}]", *(f"{name} = {value}" for name, value in _pose_fields(T).items())]
    table = _source_table(robot.source)
    if table is None:
        lines.insert(1, f"source = {_text(robot.source)}")
    else:
        lines += ["", "[source]", *(f"{_key(key)} = {_text(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _rows(name: str, rows: Iterable[str]) -> list[str]:
    return [f"{name} = [", *(f"  {row}," for row in rows), "]"]


def _mesh(i: int, mesh: Mesh) -> str:
    fields = {"link": str(i), "kind": _text(mesh.kind), "file": _text(mesh.file)} | _pose_fields(mesh.T_link_mesh)
    if not np.array_equal(mesh.scale, np.ones(3)):
        fields["scale"] = _list(mesh.scale)
    return _inline(fields)


def _dh_columns(robot: Robot) -> np.ndarray | None:
    """Return the columns alpha, a, d, offset (4, n) of the standard DH table that gives the links to the last bit."""
    L = robot.links
    alpha = [_restore(-link[1, 2], link[2, 2]) for link in L[1:]]
    offset = [_restore(-link[0, 1], link[0, 0]) for link in L[:-1]]
    columns = np.array([alpha, L[1:, 0, 3], L[1:, 2, 3], offset])
    same = np.array_equal(from_dh(robot.name, *columns, prismatic=robot.prismatic).links, L)
    return columns if same else None


def _restore(sine: float, cosine: float) -> float:
    """Return the angle, preferring one of few digits, in degrees or radians, with the same sine and cosine."""
    angle = math.atan2(sine, cosine)
    for short in (math.radians(float(f"{math.degrees(angle):.10g}")), float(f"{angle:.10g}")):
        if np.sin(short) == sine and np.cos(short) == cosine:
            return short
    return angle


def _link(robot: Robot, i: int, dh: np.ndarray | None) -> Fields:
    if dh is None:
        return {"next": _pose(robot.links[i + 1])}
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
    """Return motor turns per joint turn if they say all that G says."""
    gears = np.diag(robot.coupling)
    ratios = [float(f"{1 / gear:.10g}") if gear else 1.0 for gear in gears]
    same = np.array_equal(np.diag([1.0 / ratio for ratio in ratios]), robot.coupling)
    return ratios if same else None


def _angles(name: str, *values: float, slides: bool = False) -> Fields:
    """Return the field in degrees when a short number of degrees reads back to the same bits, else in SI."""
    degrees = tuple(float(f"{math.degrees(value):.10g}") for value in values)
    if not slides and all(math.radians(short) == value for short, value in zip(degrees, values)):
        name, values = f"{name}_deg", degrees
    return {name: _list(values) if len(values) > 1 else ", ".join(map(_number, values))}


def _pose_fields(T: np.ndarray) -> Fields:
    fields = {"position": _list(T[:3, 3])}
    if not np.array_equal(T[:3, :3], np.eye(3)):
        fields["rotation"] = _matrix(T[:3, :3])
    return fields


def _pose(T: np.ndarray) -> str:
    return _inline(_pose_fields(T))


def _source_table(source: str) -> dict[str, str] | None:
    """Return ``key: text`` lines as a table if all lines are such."""
    pairs = [line.split(": ", 1) for line in source.split("\n")]
    if any(len(pair) != 2 for pair in pairs) or len({pair[0] for pair in pairs}) < len(pairs):
        return None
    return dict(pairs)


def _inline(fields: Fields) -> str:
    return "{ " + ", ".join(f"{key} = {value}" for key, value in fields.items()) + " }"


def _matrix(M: np.ndarray) -> str:
    return "[" + ", ".join(_list(row) for row in M) + "]"


def _list(values: np.ndarray | tuple[float, ...]) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _number(value: float) -> str:
    return repr(float(value) + 0.0).removesuffix(".0")  # + 0.0 turns -0.0 into 0.0


def _key(value: str) -> str:
    return value if re.fullmatch(r"[A-Za-z0-9_-]+", value) else _text(value)


def _text(value: str) -> str:
    """TOML's basic string is JSON's, but for the delete character."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
