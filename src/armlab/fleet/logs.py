"""Many logs as one argument, the files that they become, and `export` of them into another format."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from pathlib import Path

from armlab.errors import ConfigError, LogError, ShapeError
from armlab.fleet.mapping import Done, Progress, map_logs
from armlab.log import Table, read, read_arm, write
from armlab.log.writing import ENDINGS
from armlab.robots import Robot

Log = Table | Path

_ENDINGS = {".mcap", ".csv", ".parquet", ".h5", ".hdf5", ".mat", ".db3", ".bag"}


def named(logs: Iterable[Table | str | Path] | str | Path) -> Mapping[str, Log]:
    """Return logs by name; a folder stands for all log files in it and below, sorted by name."""
    found: dict[str, Log] = {}
    files: set[Path] = set()
    given = [logs] if isinstance(logs, str | Path) else list(logs)
    for number, one in enumerate(given):
        for name, log in _expanded(one, number):
            if isinstance(log, Path):
                if (file := log.resolve()) in files:
                    raise ShapeError(f"Expected each log once, got {name} twice. Leave one out.")
                files.add(file)
            found[name] = log
    if not found:
        raise LogError("Expected at least one log, got none. Give files, or a folder of recordings.")
    return found


def as_table(log: Log, robot: Robot) -> Table:
    """Return a log as a table; a file is read with the robot's joints in their order."""
    return log if isinstance(log, Table) else read_arm(log, robot)


def _expanded(one: Table | str | Path, number: int) -> list[tuple[str, Log]]:
    if isinstance(one, Table):
        return [(f"{one.source or 'table'} #{number + 1}", one)]
    if not isinstance(one, str | Path):
        raise ShapeError.no_table(one)
    path = Path(one)
    if path.is_dir() and not (path / "metadata.yaml").exists():  # that is a log of rosbag2 by itself
        files = sorted(file for file in path.rglob("*") if file.suffix in _ENDINGS and file.is_file())
        if not files:
            raise LogError(f"Expected logs in {path}, got none ({', '.join(sorted(_ENDINGS))}).")
        return [(str(file), file) for file in files]
    if not path.exists():
        raise LogError(f"Expected a log or a folder of logs, got {path}, which does not exist.")
    return [(str(path), path)]


def targets(jobs: Mapping[str, Log], folder: Path, ending: str, mark: str = "", force: bool = False) -> dict[str, Path]:
    """Return the new file of each log: below `folder` as the logs below what they share; existing ones need `force`."""
    if ending not in ENDINGS:
        raise ConfigError(f"Expected a format among {', '.join(ENDINGS)}, got {ending!r}.")
    paths = {name: log for name, log in jobs.items() if isinstance(log, Path)}
    if len(paths) < len(jobs):
        raise ShapeError("Expected files of logs, got a table, which has no name for what it becomes. Write it first.")
    common = Path(os.path.commonpath([log.absolute().parent for log in paths.values()]))
    found: dict[str, Path] = {}
    owners: dict[Path, str] = {}
    for name, log in paths.items():
        path = folder / log.absolute().relative_to(common).with_name(f"{log.stem}{mark}{ending}")
        if path in owners:
            both = f"{owners[path]} and {name}"
            raise ShapeError(f"Expected logs of different names, got {both}, which would both be {path}. Rename one.")
        found[name], owners[path] = path, name
    read = {log.resolve() for log in paths.values()}
    if over := [path for path in found.values() if path.resolve() in read]:
        raise ConfigError(
            f"Expected new files, got {len(over)} that are read, first {over[0]}. Name another folder or format."
        )
    there = [path for path in found.values() if path.exists()]
    if there and not force:
        raise ConfigError(
            f"Expected new files, got {len(there)} that exist, first {there[0]}. Name another folder, or replace them "
            "by force (--force)."
        )
    return found


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
    logs : files or folders.
    folder : where the files go, each whole or not at all.
    ending : of the format, see `log.write`.
    executor, progress : see `identify`.
    robot : the arm, for MCAP.
    force : replace files that exist.

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
    done = map_logs(_export, work, robot, executor=executor, progress=tell, rows=lambda one: one[1]).some()
    return Done({name: path for name, (path, _) in done.results.items()}, done.skipped)


def _export(job: tuple[Log, Path], robot: Robot | None) -> tuple[Path, int]:
    """Return the file that was written, and its rows."""
    log, path = job
    table = log if isinstance(log, Table) else read(log)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(table, path, robot), len(table)
