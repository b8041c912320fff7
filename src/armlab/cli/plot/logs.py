"""Figures of logs: columns, poses, loop latency, estimated forces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from armlab.cli.support.figure_options import BESIDE, WHOLE, FigureFile, Part, poses_in

if TYPE_CHECKING:
    from armlab.log import Table


def table(log: Path, *columns: str, split: bool = False, part: Part = WHOLE, picture: FigureFile = BESIDE) -> int:
    """Draw columns of a log over time; asked and sent values dashed, times when a limit acted shaded.

    Parameters
    ----------
    log : Path
        Recording, or any file that `armlab log show` reads.
    columns : tuple of str
        Names of columns; q, qd, tau and wrench_hat, as far as there are, when none is given.
    split : bool
        A panel for each joint.
    """
    from armlab import plots

    path = picture.path(log, "table")
    return picture.save(plots.table(part.read(log), *columns, split=split), path)


def poses(
    log: Path,
    *,
    column: str | None = None,
    robot: str | None = None,
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw position and rotation vector of the tool over time.

    Parameters
    ----------
    log : Path
        Recording with poses, or with q and --robot.
    column : str
        Of poses; T_base_tool or T_frame_tool when not given.
    robot : str
        Name in the library or robot file, whose kinematics make the poses of q.
    """
    from armlab import plots

    path = picture.path(log, "poses")
    read = part.read(log, robot)
    return picture.save(plots.poses(poses_in(read, log, column, robot), read.t), path)


def scene(
    *logs: Path,
    column: str | None = None,
    robot: str | None = None,
    cloud: list[Path] | None = None,
    plane: list[Path] | None = None,
    pose: list[Path] | None = None,
    frames: float = 0.0,
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw paths of the tool, measured points, planes and frames in space.

    Parameters
    ----------
    logs : tuple of Path
        Recordings with poses, or with q and --robot; one path each.
    column : str
        Of poses; T_base_tool or T_frame_tool when not given.
    robot : str
        Name in the library or robot file, whose kinematics make the poses of q.
    cloud : list of Path
        Measured points of a tracker.
    plane : list of Path
        A plane of a tracker.
    pose : list of Path
        A frame, MAT, with its name.
    frames : float
        Length of the frames along paths [m]; 0 for none.
    """
    from armlab import plots
    from armlab.errors import ConfigError
    from armlab.frames import Plane
    from armlab.log import nikon

    sources = [*logs, *(cloud or ()), *(plane or ()), *(pose or ())]
    if not sources:
        raise ConfigError("Expected something to draw, got none. Give logs, or --cloud, --plane or --pose with a file.")
    path = picture.path(sources[0], "scene")
    items: list[Any] = [poses_in(part.read(log, robot), log, column, robot) for log in logs]
    items += [nikon.read_cloud(one).p for one in cloud or ()]
    items += [Plane.of(read.normal, read.point) for read in map(nikon.read_plane, plane or ())]
    items += [{one.stem: nikon.read_matrix(one, project=True).T} for one in pose or ()]
    return picture.save(plots.scene(*items, frames=frames), path)


def latency(log: Path, *, part: Part = WHOLE, picture: FigureFile = BESIDE) -> int:
    """Draw how long the loop took to answer, and how often it was late.

    Parameters
    ----------
    log : Path
        Recording of a run.
    """
    from armlab import plots
    from armlab.errors import LogError, UnknownName

    path = picture.path(log, "latency")
    try:
        drawn = plots.latency(part.read(log))
    except UnknownName as error:  # the log has not what is drawn; nobody named a column
        raise LogError(str(error)) from error
    return picture.save(drawn, path)


def wrench(log: Path, *, part: Part = WHOLE, picture: FigureFile = BESIDE) -> int:
    """Draw the estimated contact wrench with its 2-sigma band; contact is shaded.

    Parameters
    ----------
    log : Path
        Output of `armlab estimate`, or recording of a run that estimated.
    """
    from armlab import plots

    path = picture.path(log, "wrench")
    return picture.save(plots.wrench(_estimated(log, part)), path)


def wrenches(*logs: Path, part: Part = WHOLE, picture: FigureFile = BESIDE) -> int:
    """Draw the estimated forces of several arms side by side, on one scale.

    Parameters
    ----------
    logs : tuple of Path
        Output of `armlab estimate`, or recordings of runs that estimated; one per arm.
    """
    from armlab import plots
    from armlab.errors import ConfigError

    if len({log.stem for log in logs}) < max(len(logs), 1):
        raise ConfigError(f"Expected logs of different names, one per arm, got {', '.join(map(str, logs)) or 'none'}.")
    path = picture.path(logs[0], "wrenches")
    return picture.save(plots.wrenches({log.stem: _estimated(log, part) for log in logs}), path)


def observability(log: Path, *, part: Part = WHOLE, picture: FigureFile = BESIDE) -> int:
    """Draw how well the torques showed each axis of the wrench; times when one is weak are shaded.

    Parameters
    ----------
    log : Path
        Output of `armlab estimate`, or recording of a run that estimated.
    """
    from armlab import plots

    path = picture.path(log, "observability")
    return picture.save(plots.observability(_estimated(log, part, "observability")), path)


def _estimated(log: Path, part: Part, column: str = "wrench_hat") -> Table:
    """Return part of a log in which a wrench was estimated."""
    from armlab.errors import LogError

    read = part.read(log)
    if column not in read:
        raise LogError(
            f"Expected an estimated wrench in {log}, column {column}, got {', '.join(read.names)}. "
            "Make one: armlab estimate ROBOT LOG --model MODEL -o force.mcap."
        )
    return read
