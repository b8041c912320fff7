"""Batch processing of logs: `export` converts formats, and `estimate` computes contact forces."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armlab.contact import Estimator, contacts
from armlab.contact.estimator import Method
from armlab.errors import ConfigError, LogError, ShapeError
from armlab.estimation.fit import Fit, value_of
from armlab.fleet.mapping import Done, Progress, map_logs
from armlab.identify import with_velocity
from armlab.log import Table, read, read_arm, write
from armlab.log.writing import ENDINGS
from armlab.models import TorqueModel
from armlab.robots import Robot


@dataclass(frozen=True)
class Estimated:
    """Summary of the force estimate of one log.

    Attributes
    ----------
    path : file with the columns of the estimate, one row per row of the log.
    rows, seconds : number of rows and duration [s] of the log.
    left_out : number of rows without an estimate.
    contacts : number of contact intervals.
    contact_seconds : total duration of contact [s].
    peak : largest estimated force in contact [N], NaN without contact.
    band : mean two-sigma band of the axis with the widest band [N].
    """

    path: Path
    rows: int
    seconds: float
    left_out: int
    contacts: int
    contact_seconds: float
    peak: float
    band: float


def estimate(
    logs: Iterable[str | Path] | str | Path,
    model: TorqueModel | Fit[TorqueModel],
    robot: Robot,
    folder: Path,
    executor: Executor | None = None,
    progress: Progress | None = None,
    *,
    method: Method = "map",
    ending: str = ".mcap",
    force: bool = False,
    columns: str | None = None,
) -> Done[Estimated]:
    """Estimate the contact force in many logs of one arm, as ``armlab estimate`` does for one log.

    Parameters
    ----------
    logs : files or folders.
    model : torque model of the arm, or its fit.
    robot : the arm.
    folder : output folder; files are written atomically.
    executor, progress : as in `identify`.
    method : as in `contact.Estimator`.
    ending : file extension of the output.
    force : replace existing files.
    columns : column names in files from other programs, see `log.read`.

    Returns
    -------
    `Done`, which maps log names to `Estimated`; unusable logs are skipped with a reason.

    Raises
    ------
    LogError : no logs were given, or all of them were skipped.
    ConfigError : an output file already exists.
    ModelMismatchError : the model belongs to another arm.
    UnknownName : the method is unknown.
    """
    model = value_of(model)
    Estimator(model, robot, method)  # raises an error before any work starts
    jobs = named(logs)
    paths = targets(jobs, Path(folder), ending, "_estimate", force)
    work = {name: (log, paths[name]) for name, log in jobs.items()}
    shared = model, robot, method, columns
    return map_logs(_estimate, work, *shared, executor=executor, progress=progress, rows=lambda one: one.rows).some()


def _estimate(
    job: tuple[Log, Path], model: TorqueModel, robot: Robot, method: Method, columns: str | None
) -> Estimated:
    log, path = job
    given = with_velocity(as_table(log, robot, columns))
    table = Estimator(model, robot, method).run(given)
    known = np.isfinite(table["wrench_hat"]).all(axis=1)
    if not known.any():
        raise LogError(
            f"Expected rows with finite q, qd and tau in {log}, got none in {len(table)} rows. Pass another log."
        )
    found = contacts(table)
    inside = np.zeros(len(table), dtype=bool)
    for one in found:
        inside |= (table.t >= one.start) & (table.t <= one.end)
    size = np.linalg.norm(table["wrench_hat"][:, :3], axis=1)
    sigma = np.sqrt(np.diagonal(table["wrench_hat_cov"][known, :3, :3], axis1=1, axis2=2))
    path.parent.mkdir(parents=True, exist_ok=True)
    write(table.select(*(name for name in table.names if name not in given.names or name in _MOTION)), path, robot)
    return Estimated(
        path=path,
        rows=len(table),
        seconds=float(table.t[-1] - table.t[0]),
        left_out=int(np.count_nonzero(~known)),
        contacts=len(found),
        contact_seconds=sum(one.end - one.start for one in found),
        peak=float(np.nanmax(size[inside])) if (inside & known).any() else float("nan"),
        band=float(2.0 * sigma.mean(axis=0).max()),
    )


Log = Table | Path

_MOTION = ("q", "qd", "tau")  # log columns stored with the estimate for viewing
_ENDINGS = {".mcap", ".csv", ".parquet", ".h5", ".hdf5", ".mat", ".db3", ".bag"}


def named(logs: Iterable[Table | str | Path] | str | Path) -> Mapping[str, Log]:
    """Return logs by name; a folder contributes all log files in it and its subfolders, sorted by name."""
    found: dict[str, Log] = {}
    files: set[Path] = set()
    given = [logs] if isinstance(logs, str | Path) else list(logs)
    for number, one in enumerate(given):
        for name, log in _expanded(one, number):
            if isinstance(log, Path):
                if (file := log.resolve()) in files:
                    raise ShapeError(f"Expected each log only once, got {name} twice. Remove the duplicate.")
                files.add(file)
            found[name] = log
    if not found:
        raise LogError("Expected at least one log, got an empty list. Pass files, or a folder of recordings.")
    return found


def as_table(log: Log, robot: Robot, columns: str | None = None) -> Table:
    """Return a log as a table; a file is read with the joint order of the robot."""
    return log if isinstance(log, Table) else read_arm(log, robot, columns=columns)


def _expanded(one: Table | str | Path, number: int) -> list[tuple[str, Log]]:
    if isinstance(one, Table):
        return [(f"{one.source or 'table'} #{number + 1}", one)]
    if not isinstance(one, str | Path):
        raise ShapeError.no_table(one)
    path = Path(one)
    if path.is_dir() and not (path / "metadata.yaml").exists():  # a rosbag2 folder is a single log
        files = sorted(file for file in path.rglob("*") if file.suffix in _ENDINGS and file.is_file())
        if not files:
            raise LogError(f"Expected logs in {path}, got no {', '.join(sorted(_ENDINGS))} file. Pass another folder.")
        return [(str(file), file) for file in files]
    if not path.exists():
        raise LogError(f"Expected a log or a folder of logs, but {path} does not exist. Correct the path.")
    return [(str(path), path)]


def targets(jobs: Mapping[str, Log], folder: Path, ending: str, mark: str = "", force: bool = False) -> dict[str, Path]:
    """Return the output file of each log, preserving the folder structure; existing files require `force`."""
    if ending not in ENDINGS:
        raise ConfigError(f"Expected a file extension among {', '.join(ENDINGS)}, got {ending!r}.")
    paths = {name: log for name, log in jobs.items() if isinstance(log, Path)}
    if len(paths) < len(jobs):
        raise ShapeError("Expected log files, got a table without a file name. Write the table to a file first.")
    common = Path(os.path.commonpath([log.absolute().parent for log in paths.values()]))
    found: dict[str, Path] = {}
    owners: dict[Path, str] = {}
    for name, log in paths.items():
        path = folder / log.absolute().relative_to(common).with_name(f"{log.stem}{mark}{ending}")
        if path in owners:
            both = f"{owners[path]} and {name}"
            raise ShapeError(f"Expected distinct output files, got {path} for {both}. Rename one log.")
        found[name], owners[path] = path, name
    read = {log.resolve() for log in paths.values()}
    if over := [path for path in found.values() if path.resolve() in read]:
        raise ConfigError(
            f"Expected new output files, but {len(over)} are inputs, the first being {over[0]}. "
            "Choose another folder or format."
        )
    there = [path for path in found.values() if path.exists()]
    if there and not force:
        raise ConfigError(
            f"Expected new output files, but {len(there)} already exist, "
            f"the first being {there[0]}. Choose another folder, or "
            "replace the files (--force)."
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
    columns: str | None = None,
) -> Done[Path]:
    """Convert many logs to another format, as ``armlab log export`` does for one log.

    Parameters
    ----------
    logs : files or folders.
    folder : output folder; files are written atomically.
    ending : file extension of the format, see `log.write`.
    executor, progress : as in `identify`.
    robot : the arm, for MCAP.
    force : replace existing files.
    columns : column names in files from other programs, see `log.read`.

    Returns
    -------
    `Done`, which maps log names to paths; unreadable logs are skipped, and the reason is stated.

    Raises
    ------
    LogError : no logs were given, or all of them were skipped.
    ConfigError : the format is unknown, MCAP output has no robot, or an output file already exists.
    """
    if ending == ".mcap" and robot is None:
        raise ConfigError("Expected a robot for MCAP recordings, got none. Pass robot= (--robot).")
    jobs = named(logs)
    paths = targets(jobs, Path(folder), ending, force=force)
    work = {name: (log, paths[name]) for name, log in jobs.items()}
    done = map_logs(_export, work, robot, columns, executor=executor, progress=progress, rows=lambda one: one[1]).some()
    return Done({name: path for name, (path, _) in done.results.items()}, done.skipped)


def _export(job: tuple[Log, Path], robot: Robot | None, columns: str | None) -> tuple[Path, int]:
    log, path = job
    table = log if isinstance(log, Table) else read(log, columns=columns)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(table, path, robot), len(table)
