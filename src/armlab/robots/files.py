"""Robots as TOML files: the library and the user's own."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from armlab.errors import RobotError, UnknownName
from armlab.robots.robot import Robot

__all__ = ["load", "names", "save"]

_LIBRARY = Path(__file__).with_name("library")


def names() -> tuple[str, ...]:
    """Return the names of the library's robots, sorted."""
    return tuple(sorted(path.stem for path in _LIBRARY.glob("*.toml")))


def load(name: str | Path) -> Robot:
    """Return a robot of the library by its name, or the one that a TOML file describes.

    Parameters
    ----------
    name : a name of `names()`, or the path of a file that ends in ``.toml``.

    Raises
    ------
    UnknownName : when the library has no such robot; lists those it has.
    RobotError : when the file is missing or describes no consistent robot; names file, joint and value.
    """
    if Path(name).suffix == ".toml":
        return _from_file(Path(name))
    if name not in names():
        raise UnknownName.among("robot", str(name), names())
    return _from_library(str(name))


def save(robot: Robot, path: str | Path) -> None:
    """Write a robot to a TOML file that `load` reads back to the same bits, or to a URDF file for other programs.

    URDF holds geometry, limits, inertias and meshes, to the last digits. Gravity, gears, home and accelerations stand
    in a comment of it, which no program reads.

    Parameters
    ----------
    robot : any robot.
    path : file to write, ending in ``.toml`` or ``.urdf``; an existing one is replaced.

    Raises
    ------
    RobotError : when the path ends in neither or cannot be written, or a name cannot stand in the file.
    """
    from armlab.robots._urdf_writing import write_urdf
    from armlab.robots._writing import write_robot

    path = Path(path)
    writers = {".toml": write_robot, ".urdf": write_urdf}
    if path.suffix not in writers:
        raise RobotError(f"Expected a path that ends in .toml or .urdf for robot {robot.name!r}, got {path}.")
    text = writers[path.suffix](robot)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RobotError(f"Expected to write robot {robot.name!r} to {path}, got: {error}.") from None


@cache
def _from_library(name: str) -> Robot:
    return _from_file(_LIBRARY / f"{name}.toml")


def _from_file(path: Path) -> Robot:
    from armlab.robots._reading import read_robot  # it brings msgspec, which kinematics alone does not need

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RobotError(f"Expected a robot file at {path}, got: {error}.") from None
    return read_robot(text, str(path))
