"""`export`: many logs into another format, on any executor."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Executor
from pathlib import Path

from armlab.errors import ConfigError
from armlab.fleet.logs import Log, named
from armlab.fleet.mapping import Done, Progress, each
from armlab.fleet.targets import targets
from armlab.log import Table, read, write
from armlab.robots import Robot

__all__ = ["export"]


def export(
    logs: Iterable[str | Path] | str | Path,
    folder: Path,
    ending: str,
    executor: Executor | None = None,
    progress: Progress | None = None,
    *,
    robot: Robot | None = None,
    force: bool = False,
) -> Done[Path]:
    """Write many logs in another format, each as ``armlab log export`` does.

    Parameters
    ----------
    logs : files or folders. folder : where the files go, each whole or not at all.
    ending : of the format, see `log.write`. executor, progress : see `identify`.
    robot : the arm, for MCAP. force : replace files that exist.

    Returns
    -------
    Done: path by name of the log; logs that cannot be read or written are skipped with a sentence.

    Raises
    ------
    LogError : there are no logs, or all were skipped.
    ConfigError : another format, no robot for MCAP, or a file exists.
    """
    if ending == ".mcap" and robot is None:
        raise ConfigError("Expected the robot of recordings in MCAP, got none. Name it with robot= (--robot).")
    jobs = named(logs)
    paths = targets(jobs, Path(folder), ending, force=force)
    work = {name: (log, paths[name]) for name, log in jobs.items()}
    tell = progress or (lambda done, total, what: None)
    done = each(_work, work, robot, executor=executor, progress=tell, rows=lambda one: one[1]).some()
    return Done({name: path for name, (path, _) in done.results.items()}, done.skipped)


def _work(job: tuple[Log, Path], robot: Robot | None) -> tuple[Path, int]:
    """Return the file that was written, and its rows."""
    log, path = job
    table = log if isinstance(log, Table) else read(log)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(table, path, robot), len(table)
