"""`targets`: the file that each of many logs becomes, none of which is there yet."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from armlab.errors import ConfigError, ShapeError
from armlab.fleet.logs import Log
from armlab.log.writing import ENDINGS

__all__ = ["targets"]


def targets(jobs: Mapping[str, Log], folder: Path, ending: str, mark: str = "", force: bool = False) -> dict[str, Path]:
    """Return the file for each log: named as the log below what all logs have in common, and in folders as they are.

    Parameters
    ----------
    jobs : logs by name. folder : where the files go. ending : ".csv" and the like. mark : added to the name.
    force : files that exist may be replaced.

    Raises
    ------
    ConfigError : a format that cannot be written, a file exists already, or is one of the logs, also by force.
    ShapeError : a table, which has no name, or two logs that would become one file.
    """
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
