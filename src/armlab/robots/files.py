"""Robots as TOML files: the library and the user's own."""

from __future__ import annotations

import math
import tomllib
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from armlab.errors import RobotError, UnknownName
from armlab.lie import quaternion
from armlab.robots.build import GRAVITY, Details, from_dh
from armlab.robots.robot import Robot

__all__ = ["load", "names"]


class _Pose(msgspec.Struct, forbid_unknown_fields=True):
    """A constant pose: position [m] and a quaternion wxyz or a rotation matrix."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] | None = None
    rotation: list[list[float]] | None = None


class _Joint(msgspec.Struct, forbid_unknown_fields=True):
    """One row of the joint table."""

    name: str
    alpha: float = 0.0
    a: float = 0.0
    d: float = 0.0
    offset: float = 0.0
    kind: Literal["revolute", "prismatic"] = "revolute"
    limits: tuple[float, float] = (-math.inf, math.inf)
    speed: float = math.inf
    acceleration: float | None = None
    home: float | None = None
    gear_ratio: float = 1.0


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """A robot file."""

    name: str
    source: str | dict[str, str]
    joint: list[_Joint]
    convention: Literal["standard", "modified"] = "standard"
    side: Literal["left", "right", ""] = ""
    gravity: tuple[float, float, float] = GRAVITY
    abb_axes: list[int] | None = None
    mount: _Pose = msgspec.field(default_factory=_Pose)
    tool: _Pose = msgspec.field(default_factory=_Pose)


def names() -> tuple[str, ...]:
    """Return the names of the library's robots, sorted."""
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in _library().iterdir() if entry.name.endswith(".toml"))
    )


def load(name: str | Path) -> Robot:
    """Return a robot of the library by name, or the one described by a TOML file.

    Parameters
    ----------
    name : a name of `names()`, or the path of a file that ends in ``.toml``.

    Raises
    ------
    UnknownName : when the library has no such robot; lists those it has.
    RobotError : when the file is missing or its description is inconsistent; names the file, the joint and the value.
    """
    if isinstance(name, str) and not name.endswith(".toml"):
        if name not in names():
            raise UnknownName.among("robot", name, names())
        return _from_library(name)
    try:
        text = Path(name).read_text(encoding="utf-8")
    except OSError as error:
        raise RobotError(f"Expected a robot file at {name}, got: {error.strerror}.") from None
    return _read(text, str(name))


@cache
def _from_library(name: str) -> Robot:
    return _read((_library() / f"{name}.toml").read_text(encoding="utf-8"), f"{name}.toml")


def _library():
    return files("armlab.robots") / "library"


def _read(text: str, path: str) -> Robot:
    try:
        file = msgspec.convert(_in_radians(tomllib.loads(text)), _File)
        return _build(file)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise RobotError(f"Robot file {path}: {error}.") from None
    except RobotError as error:
        raise RobotError(f"Robot file {path}: {error}") from None


def _in_radians(value: Any) -> Any:
    """Replace every ``x_deg`` by ``x`` in radians."""
    if isinstance(value, list):
        return [_in_radians(item) for item in value]
    if not isinstance(value, dict):
        return value
    result = {}
    for key, item in value.items():
        name = key.removesuffix("_deg")
        if name in result:
            raise RobotError(f"Expected {name} or {name}_deg, got both.")
        result[name] = _in_radians(item) if name == key else _radians(item)
    return result


def _radians(value: Any) -> Any:
    if isinstance(value, list):
        return [_radians(item) for item in value]
    return math.radians(value) if isinstance(value, int | float) else value


def _build(file: _File) -> Robot:
    joints = file.joint
    source = file.source if isinstance(file.source, str) else "\n".join(f"{k}: {v}" for k, v in file.source.items())
    limits = np.array([joint.limits for joint in joints])
    details: Details = {
        "q_min": limits[:, 0],
        "q_max": limits[:, 1],
        "qd_max": [joint.speed for joint in joints],
        "joint_names": [joint.name for joint in joints],
        "T_base_mount": _pose(file.mount),
        "T_flange_tool": _pose(file.tool),
        "gravity": file.gravity,
        "coupling": np.diag([1.0 / joint.gear_ratio for joint in joints]),
        "side": file.side,
        "source": source,
    }
    if file.abb_axes is not None:
        details["abb_axes"] = file.abb_axes
    if all(joint.home is not None for joint in joints):
        details["q_home"] = [joint.home for joint in joints]
    return from_dh(
        file.name,
        [joint.alpha for joint in joints],
        [joint.a for joint in joints],
        [joint.d for joint in joints],
        [joint.offset for joint in joints],
        prismatic=[joint.kind == "prismatic" for joint in joints],
        modified=file.convention == "modified",
        **details,
    )


def _pose(pose: _Pose) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = pose.position
    if pose.quaternion is not None:
        T[:3, :3] = quaternion.to_matrix(np.array(pose.quaternion))
    elif pose.rotation is not None:
        T[:3, :3] = np.array(pose.rotation)
    return T
