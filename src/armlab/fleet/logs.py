"""Many logs as one argument: files, folders and tables, by name and in order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from armlab.errors import LogError, ShapeError
from armlab.log import Table, read_arm
from armlab.robots import Robot

__all__ = ["Log", "as_table", "named"]

Log = Table | Path

_ENDINGS = {".mcap", ".csv", ".parquet", ".h5", ".hdf5", ".mat", ".db3", ".bag"}


def named(logs: Iterable[Table | str | Path] | str | Path) -> Mapping[str, Log]:
    """Return logs by name: of a folder all files of logs in it and below, in the order of their names.

    Parameters
    ----------
    logs : tables, files or folders, or one of the latter.

    Raises
    ------
    LogError : nothing there, or a folder without logs. ShapeError : something else than logs, or one name twice.
    """
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
    """Return a log as a table; a file is read with the robot's joints in their order.

    Parameters
    ----------
    log : table or file. robot : the arm.

    Raises
    ------
    LogError, ModelMismatchError : see `log.read_arm`.
    """
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
