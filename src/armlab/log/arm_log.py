"""`read_arm`: the log of one arm, refused when it is of another or has no torques."""

from __future__ import annotations

from pathlib import Path

from armlab.errors import LogError, ModelMismatchError
from armlab.log.description import Progress
from armlab.log.inspection import inspect
from armlab.log.messages import topic_name
from armlab.log.reading import read
from armlab.log.table import Table
from armlab.log.topic_reading import is_foreign, read_joints
from armlab.robots import Robot

__all__ = ["read_arm"]


def read_arm(path: str | Path, robot: Robot, progress: Progress | None = None) -> Table:
    """Return the log of an arm with q and tau (N, n), in its order of joints; qd where it was recorded.

    Parameters
    ----------
    path : of the log, see `read`. robot : that was logged. progress : as there.

    Raises
    ------
    LogError : it cannot be read, or has no positions or torques.
    ModelMismatchError : a recording of another robot, or another number of joints.
    """
    path = Path(path)
    several = _is_of_several(path, robot)
    if is_foreign(path):
        table = read_joints(path, robot, progress)
    else:
        table = read(path, robot=robot.name if several else None, progress=progress)
    missing = [name for name in ("q", "tau") if name not in table]
    if missing:
        raise LogError(
            f"Expected positions and torques, columns q and tau, in {path}, got none for {' and '.join(missing)} among "
            f"{', '.join(table.names)}. {_advice(missing)}"
        )
    if table["q"].shape[1:] != (robot.n,):
        raise ModelMismatchError(
            f"Expected a log of {robot.name!r} with {robot.n} joints, got q of shape {table['q'].shape} in {path}. "
            "Name the robot that was logged."
        )
    return table


def _advice(missing: list[str]) -> str:
    """Say where columns that are missing may come from."""
    if missing == ["tau"]:
        return "Record with the research extension, which sends torques."
    return "Name a log of the joints: armlab log show tells what one holds."


def _is_of_several(path: Path, robot: Robot) -> bool:
    """Refuse a recording without rows of a robot of this name; True when it holds several. Text knows none."""
    if path.suffix != ".mcap" or not path.is_file():
        return False
    told = inspect(path)
    several = len(told.robots) > 1  # named by their topics, in which some letters cannot stand
    names = told.robots if several else (told.metadata.get("armlab", {}).get("robot", robot.name),)
    if (topic_name(robot.name) if several else robot.name) not in names:
        raise ModelMismatchError(
            f"Expected a recording of {robot.name!r}, got one of {' and '.join(map(repr, names))} in {path}. Name the "
            "robot that was recorded."
        )
    return several
