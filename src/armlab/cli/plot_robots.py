"""Figures of robots: the arm, where its tool can be, how fast it can move there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from armlab.cli.picture import BESIDE, WHOLE, Part, Picture

if TYPE_CHECKING:
    import numpy as np

__all__ = ["manipulability", "robot", "workspace"]


def robot(
    robot: str, log: Path | None = None, *, tool_path: bool = False, part: Part = WHOLE, picture: Picture = BESIDE
) -> int:
    """Draw an arm as a stick figure: at home, or through a log, its end in full.

    Parameters
    ----------
    robot : str
        Name in the library, or robot file.
    log : Path
        Recording with q.
    tool_path : bool
        Draw the path of the tool through the log.
    """
    from armlab import plots, robots

    path = picture.path(robot if log is None else log, "robot")
    return picture.save(plots.robot(robots.load(robot), _positions(log, robot, part), path=tool_path), path)


def workspace(robot: str, *, picture: Picture = BESIDE) -> int:
    """Draw where the tool of an arm can be: from the side, from above, in space.

    Parameters
    ----------
    robot : str
        Name in the library, or robot file.
    """
    from armlab import plots, robots

    path = picture.path(robot, "workspace")
    return picture.save(plots.workspace(robots.load(robot)), path)


def manipulability(
    robot: str,
    log: Path | None = None,
    *,
    of: Literal["position", "rotation"] = "position",
    part: Part = WHOLE,
    picture: Picture = BESIDE,
) -> int:
    """Draw how fast the tool can move in which direction: at home, or at up to eight places of a log.

    Parameters
    ----------
    robot : str
        Name in the library, or robot file.
    log : Path
        Recording with q.
    of : str
        position: velocity of the tool point. rotation: its angular velocity.
    """
    from armlab import plots, robots

    path = picture.path(robot if log is None else log, "manipulability")
    return picture.save(plots.manipulability(robots.load(robot), _positions(log, robot, part), of), path)


def _positions(log: Path | None, robot: str, part: Part) -> np.ndarray | None:
    """Return the joint positions (N, n) of a robot in a log, rows in which none is missing."""
    import numpy as np

    if log is None:
        return None
    q = part.read(log, robot)["q"]
    return q[np.isfinite(q).all(axis=1)]
