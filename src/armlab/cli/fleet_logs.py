"""``armlab fleet identify``, ``estimate`` and ``export``: the same job over many logs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["estimate", "export", "identify"]


def identify(
    *logs: Path,
    output: Annotated[Path, Parameter(alias="-o")],
    robot: str | None = None,
    workers: int = 1,
    dask: str | None = None,
    no_cache: bool = False,
    json: bool = False,
    force: bool = False,
) -> int:
    """Identify gravity, inertia and friction from many logs of one arm; save the model.

    The result has the same bits with any number of workers. Logs that cannot be used are named, and the command ends
    with status 3. Sums of each log are kept, so that ten logs more cost ten logs.

    Parameters
    ----------
    logs
        Recordings of free motion without contact, and folders of such.
    output
        Model file to write, ends in .toml.
    robot
        Name in the library, or a robot file; the one that the recordings name when not given.
    workers
        Processes on this computer.
    dask
        Address of a Dask scheduler, tcp://HOST:PORT; its workers must see the files by the same paths.
    no_cache
        Keep no sums, and use none.
    json
        Print JSON for scripts.
    force
        Replace an existing file.
    """
    from armlab import fleet
    from armlab.cli import SKIPPED
    from armlab.cli.output import check_output, note, print_json, progress, result
    from armlab.fleet.cache import default_folder
    from armlab.fleet.workers import workers as at_work

    check_output(output, force, [".toml"])
    arm = _arm(logs, robot)
    cache = None if no_cache else default_folder()
    with at_work(workers, dask) as executor, progress("identify") as tell:
        found = fleet.identify(logs, arm, executor, tell, cache)
    if json:
        fit = found.fit
        parameters = [
            {"name": name, "value": value, "sd": sd, "unit": unit}
            for name, value, sd, unit in zip(fit.names, fit.parameters, fit.sd, fit.units)
        ]
        print_json({"model": str(output), "parameters": parameters, "used": found.used, "skipped": found.skipped})
    else:
        result(found.report())
    found.fit.save(output)
    note(f"model: {output}")
    return SKIPPED if found.skipped else 0


def estimate(
    *logs: Path,
    model: Path,
    output: Annotated[Path, Parameter(alias="-o")],
    robot: str | None = None,
    method: Literal["map", "bounded", "interval", "observer", "kf", "clip", "ls", "lund"] = "map",
    csv: bool = False,
    workers: int = 1,
    dask: str | None = None,
    json: bool = False,
    force: bool = False,
) -> int:
    """Estimate the contact force in many logs of one arm; write a file of it for each.

    Prints a line per log: its length, how often and how long there was contact, the largest force and the mean 2-sigma
    band. Logs that cannot be used are named, and the command ends with status 3.

    Parameters
    ----------
    logs
        Recordings with positions, velocities and torques, and folders of such.
    model
        Model file of armlab identify.
    output
        Folder for the estimates.
    robot
        Name in the library, or a robot file; the one that the recordings name when not given.
    method
        As of armlab estimate.
    csv
        Write text instead of recordings.
    workers
        Processes on this computer.
    dask
        Address of a Dask scheduler, tcp://HOST:PORT; its workers must see the files by the same paths.
    json
        Print JSON for scripts.
    force
        Replace existing files.
    """
    from armlab import fleet, models
    from armlab.cli import SKIPPED
    from armlab.cli.output import aligned, note, print_json, progress, result
    from armlab.fleet.workers import workers as at_work

    arm, known = _arm(logs, robot), models.load(model)
    about = {"method": method, "ending": ".csv" if csv else ".mcap", "force": force}
    with at_work(workers, dask) as executor, progress("estimate") as tell:
        done = fleet.estimate(logs, known, arm, output, executor, tell, **about)
    if json:
        told = {name: {**vars(one), "path": str(one.path)} for name, one in done.results.items()}
        print_json({"logs": told, "skipped": done.skipped})
    else:
        rows = [
            [name, f"{one.seconds:.1f}", f"{one.contacts}", *_fixed(one.contact_seconds, one.peak, one.band)]
            for name, one in done.results.items()
        ]
        head = ["log", "seconds", "contacts", "in contact [s]", "largest [N]", "2-sigma [N]"]
        result(aligned([head, *rows], right=range(1, len(head))))
        _skipped(done.skipped)
    note(f"estimates: {output}")
    return SKIPPED if done.skipped else 0


def export(
    *logs: Path,
    format: Literal["csv", "mat", "parquet", "h5", "mcap", "rosbag2"],
    output: Annotated[Path, Parameter(alias="-o")],
    robot: str | None = None,
    workers: int = 1,
    dask: str | None = None,
    json: bool = False,
    force: bool = False,
) -> int:
    """Write many logs in another format.

    Logs that cannot be read or written are named, and the command ends with status 3.

    Parameters
    ----------
    logs
        Files of any format that armlab reads, and folders of such.
    format
        To write: csv, mat, parquet, h5, mcap or rosbag2.
    output
        Folder for the files.
    robot
        Of recordings in mcap: name in the library, or a robot file; the one that the logs name when not given.
    workers
        Processes on this computer.
    dask
        Address of a Dask scheduler, tcp://HOST:PORT; its workers must see the files by the same paths.
    json
        Print JSON for scripts.
    force
        Replace existing files.
    """
    from armlab import fleet
    from armlab.cli import SKIPPED
    from armlab.cli.output import note, print_json, progress, result
    from armlab.fleet.workers import workers as at_work

    arm = _arm(logs, robot) if format == "mcap" else None
    with at_work(workers, dask) as executor, progress("export") as tell:
        done = fleet.export(logs, output, f".{format}", executor, tell, robot=arm, force=force)
    if json:
        print_json({"files": {name: str(path) for name, path in done.results.items()}, "skipped": done.skipped})
    else:
        result("\n".join(map(str, done.results.values())))
        _skipped(done.skipped)
    note(f"{len(done.results)} files in {output}")
    return SKIPPED if done.skipped else 0


def _fixed(*values: float) -> list[str]:
    """Return numbers with two digits, a dash for what is not there."""
    return [f"{value:.2f}" if math.isfinite(value) else "-" for value in values]


def _skipped(reasons: Mapping[str, str]) -> None:
    """Say which logs were not used."""
    from armlab.cli.output import note

    for name, reason in reasons.items():
        note(f"skipped {name}: {reason}")


def _arm(logs: tuple[Path, ...], robot: str | None) -> Robot:
    """Return the arm that is named, or else the one that the first recording names."""
    from armlab import robots
    from armlab.errors import ArmlabError, ConfigError
    from armlab.fleet.logs import named
    from armlab.log import inspect

    if robot is not None:
        return robots.load(robot)
    for log in named(logs):
        if not log.endswith(".mcap"):
            continue
        try:
            return robots.load(inspect(log).metadata["armlab"]["robot"])
        except (ArmlabError, OSError, KeyError):
            continue
    raise ConfigError("Expected recordings that name a robot of the library, got none. Name it with --robot.")
