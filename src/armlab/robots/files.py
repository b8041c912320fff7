"""Robots as files: the library, and the user's own TOML and URDF."""

from __future__ import annotations

from functools import cache
from os import PathLike
from pathlib import Path
from reprlib import repr as shortened

from armlab._whole_files import whole_file
from armlab.errors import RobotError, UnknownName
from armlab.robots.robot import Robot

__all__ = ["from_toml", "load", "names", "save", "to_toml"]

_LIBRARY = Path(__file__).with_name("library")


def names() -> tuple[str, ...]:
    """Return the names of the library's robots, sorted."""
    return tuple(sorted(path.stem for path in _LIBRARY.glob("*.toml")))


def load(name: str | Path, *, base: str | None = None, tip: str | None = None) -> Robot:
    """Return a robot of the library by its name, or the one that a TOML or URDF file describes.

    Parameters
    ----------
    name : a name of `names()`, or the path of a file that ends in ``.toml`` or ``.urdf``.
    base, tip : links of a URDF between which the arm is, see `urdf.Tree.chain`: the root, and the only end that moves,
        unless said.

    Raises
    ------
    UnknownName : when the library has no such robot, or the URDF no such link; lists those it has.
    RobotError : when the file is missing or describes no consistent robot; names file, joint or line, and value.
        When several branches of a URDF move and the tip is not said; lists them.
    """
    if not isinstance(name, str | Path):
        raise UnknownName.among("robot", str(name), names())
    suffix = Path(str(name)).suffix.lower()
    if suffix == ".urdf":
        from armlab.robots import urdf

        return urdf.read(name).chain(base, tip)
    if base is not None or tip is not None:
        raise RobotError(f"Expected base and tip with a URDF file only, got them with {name}. Leave them out.")
    if suffix == ".toml":
        return _from_file(Path(name))
    if suffix == ".xacro":
        raise RobotError(f"Expected a URDF, got {name}. Expand it first: xacro {name} > robot.urdf.")
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
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    if not isinstance(path, str | PathLike):
        raise RobotError(f"Expected the path of a file for robot {robot.name!r}, got {path!r}.")
    from armlab.robots.urdf.writing import write_urdf

    path = Path(path)
    writers = {".toml": to_toml, ".urdf": write_urdf}
    if path.suffix.lower() not in writers:
        raise RobotError(f"Expected a path that ends in .toml or .urdf for robot {robot.name!r}, got {path}.")
    text = writers[path.suffix.lower()](robot)
    try:
        with whole_file(path) as part:
            part.write_bytes(text.encode("utf-8"))
    except (OSError, ValueError) as error:  # ValueError: a character that no file or path can hold
        raise RobotError(f"Expected to write robot {robot.name!r} to {path}, got: {error}.") from None


def to_toml(robot: Robot) -> str:
    """Return the text of a robot file, for a program that has no file of it; `from_toml` reads back the same bits.

    Parameters
    ----------
    robot : any robot.

    Raises
    ------
    RobotError : no robot, or a name that cannot stand in the file.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    from armlab.robots.toml import write_robot

    return write_robot(robot)


def from_toml(text: str, origin: str) -> Robot:
    """Return the robot that the text of a robot file describes.

    Parameters
    ----------
    text : as `to_toml` writes it. origin : where it comes from, for messages.

    Raises
    ------
    RobotError : the text describes no consistent robot; names origin, joint or line, and value.
    """
    if not isinstance(text, str):
        raise RobotError(f"Expected the text of a robot file, got {shortened(text)}. Of a file: robots.load.")
    from armlab.robots.toml import read_robot  # it brings msgspec, which kinematics alone does not need

    return read_robot(text, origin)


@cache
def _from_library(name: str) -> Robot:
    return _from_file(_LIBRARY / f"{name}.toml")


def _from_file(path: Path) -> Robot:
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors on Windows put a mark before the text
    except (OSError, ValueError) as error:
        raise RobotError(f"Expected a robot file at {path}, got: {error}.") from None
    return from_toml(text, str(path))
