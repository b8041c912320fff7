"""Robot files: the library, and the user's TOML and URDF files."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from reprlib import repr as shortened

from armlab._files import whole_file
from armlab.errors import ConfigError, MissingExtra, RobotError, UnknownName
from armlab.robots.robot import Robot

__all__ = ["from_toml", "load", "names", "save", "to_toml"]

_LIBRARY = Path(__file__).with_name("library")


def names() -> tuple[str, ...]:
    """Return the sorted names of the library robots."""
    return tuple(sorted(path.stem for path in _LIBRARY.glob("*.toml")))


def load(
    name: str | Path, *, base: str | None = None, tip: str | None = None, lock: Mapping[str, float] | None = None
) -> Robot:
    """Load a robot from the library by name, or from a TOML or URDF file.

    Other names, such as ``panda_description``, are looked up in the packages ``robot_descriptions`` and
    ``example-robot-data`` if they are installed (extra ``robots``).

    Parameters
    ----------
    name : a name from `names()` or from these packages, or the path of a file that ends in ``.toml`` or ``.urdf``.
    base, tip : first and last link of the arm in a URDF, see `urdf.Tree.chain`; default: the root, and the only moving
        tip.
    lock : positions [rad or m] of locked URDF joints, by name; the links behind a locked joint keep their mass.

    Raises
    ------
    UnknownName : if the robot, or a link or joint of the URDF, does not exist; the message lists the available names.
    RobotError : if the file is missing or inconsistent, or if several branches of a URDF move and no tip is given. The
        message states the file, the joint or line, and the value, or lists the tips.
    """
    if not isinstance(name, str | Path):
        raise UnknownName.among("robot", str(name), names())
    path = description(name)
    if path is not None and path.suffix.lower() == ".urdf":
        from armlab.robots import urdf

        return urdf.read(path).chain(base, tip, lock=lock)
    if not (base is tip is lock is None):
        raise RobotError(
            f"Expected base, tip and lock only with a URDF, got base, tip or lock with {name}. Omit these options."
        )
    return _from_library(str(name)) if path is None else _from_file(path)


def load_chosen(name: str, options: Mapping[str, str]) -> Robot:
    """Load a robot; options base, tip and lock (``JOINT=VALUE,JOINT=VALUE``) select the arm of a URDF."""
    lock: dict[str, float] = {}
    for part in filter(None, options.get("lock", "").split(",")):
        joint, _, value = part.rpartition("=")
        try:
            lock[joint] = float(value)
        except ValueError:
            joint = ""
        if not joint:
            raise ConfigError(f"Expected a locked joint as JOINT=VALUE in rad or m, got {part!r}.")
    return load(name, base=options.get("base"), tip=options.get("tip"), lock=lock or None)


def description(name: str | Path) -> Path | None:
    """Return the description file of a robot, or None for a library robot; raise the same errors as `load`."""
    suffix = Path(str(name)).suffix.lower()
    if suffix in (".urdf", ".toml"):
        return Path(name)
    if suffix == ".xacro":
        raise RobotError(f"Expected a URDF, got {name}. Expand it first: xacro {name} > robot.urdf.")
    if name in names():
        return None
    found = _of_example_robot_data(str(name)) or _of_robot_descriptions(str(name))
    if found is None:
        raise UnknownName.among("robot", str(name), names())
    return found


def _of_robot_descriptions(name: str) -> Path | None:
    """Return the URDF of a module in the package robot_descriptions, downloading it on first use."""
    if not name.isidentifier() or not name.endswith("_description"):
        return None
    try:
        package = import_module("robot_descriptions")
    except ImportError:
        raise MissingExtra(
            f"Expected the package robot_descriptions, which may contain {name}, but it is not installed. Install it: "
            "pip install 'armlab[robots]'."
        ) from None
    if find_spec(f"{package.__name__}.{name}") is None:
        return None
    try:
        with redirect_stdout(sys.stderr):  # the package prints its downloads
            module = import_module(f"{package.__name__}.{name}")
            if not hasattr(module, "URDF_PATH") and hasattr(module, "XACRO_PATH"):
                return Path(import_module(f"{package.__name__}._xacro").get_urdf_path(module))
        return Path(module.URDF_PATH)
    except Exception as error:  # network errors have no common base class
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise RobotError(
            f"Expected a URDF of {name} from the package robot_descriptions, got: {reason}. The first use of a "
            "description needs network access. Alternatively, pass a file."
        ) from None


def _of_example_robot_data(name: str) -> Path | None:
    """Return a URDF by name, or by the name of a folder that contains a URDF of that name or a single URDF."""
    files = _example_robot_data()
    inside = [path for path in files.values() if f"/{name}/" in path.as_posix()]
    own = [path for path in inside if path.stem == name.removesuffix("_description")]
    if name in files or not inside:
        return files.get(name)
    if len(own or inside) > 1:
        raise UnknownName.among(f"robot of {name}", name, [path.stem for path in inside])
    return (own or inside)[0]


@cache
def _example_robot_data() -> dict[str, Path]:
    """Return the URDF files of the package example-robot-data by name; empty without the package."""
    from importlib.metadata import PackageNotFoundError, distribution  # lazy: saves a third of kinematics' import time

    try:
        files = distribution("example-robot-data").files or ()
    except PackageNotFoundError:
        return {}
    return {path.stem: Path(str(path.locate())) for path in files if path.suffix == ".urdf"}


def save(robot: Robot, path: str | Path) -> None:
    """Write a robot to a TOML file, which `load` reads back exactly, or to a URDF file for other programs.

    URDF stores geometry, limits, inertias and meshes with full precision. Gravity, gears, home and acceleration limits
    are written as a comment.

    Parameters
    ----------
    robot : any robot.
    path : output file, ending in ``.toml`` or ``.urdf``; an existing file is replaced.

    Raises
    ------
    RobotError : if the extension is unsupported, the file cannot be written, or a name contains invalid characters.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    if not isinstance(path, str | PathLike):
        raise RobotError(f"Expected a file path for robot {robot.name!r}, got {path!r}.")
    from armlab.robots.urdf.writing import write_urdf

    path = Path(path)
    writers = {".toml": to_toml, ".urdf": write_urdf}
    if path.suffix.lower() not in writers:
        raise RobotError(f"Expected a path that ends in .toml or .urdf for robot {robot.name!r}, got {path}.")
    text = writers[path.suffix.lower()](robot)
    try:
        with whole_file(path) as part:
            part.write_bytes(text.encode("utf-8"))
    except (OSError, ValueError) as error:  # ValueError: a character that is invalid in a file or path
        raise RobotError(f"Expected a writable path for robot {robot.name!r}, got {path}: {error}.") from None


def to_toml(robot: Robot) -> str:
    """Return the text of a robot file; `from_toml` reads it back exactly.

    Parameters
    ----------
    robot : any robot.

    Raises
    ------
    RobotError : if `robot` is not a `Robot`, or a name contains invalid characters.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    from armlab.robots.toml import write_robot

    return write_robot(robot)


def from_toml(text: str, origin: str) -> Robot:
    """Return the robot described by the text of a robot file.

    Parameters
    ----------
    text : text as written by `to_toml`.
    origin : source of the text, for messages.

    Raises
    ------
    RobotError : if the text is inconsistent; the message states the origin, the joint or line, and the value.
    """
    if not isinstance(text, str):
        raise RobotError(f"Expected the text of a robot file, got {shortened(text)}. For a file, call robots.load.")
    from armlab.robots.toml import read_robot  # imports msgspec, which kinematics alone does not need

    return read_robot(text, origin)


@cache
def _from_library(name: str) -> Robot:
    return _from_file(_LIBRARY / f"{name}.toml")


def _from_file(path: Path) -> Robot:
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors on Windows write a byte order mark
    except (OSError, ValueError) as error:
        raise RobotError(f"Expected a robot file at {path}, got: {error}.") from None
    return from_toml(text, str(path))
