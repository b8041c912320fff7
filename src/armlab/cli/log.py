"""``armlab log``: what a log holds, its export, and the repair of one that was cut off."""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cyclopts import App

if TYPE_CHECKING:
    from armlab.log import Table
    from armlab.log.inspection import Inspection

__all__ = ["export", "log", "recover", "show"]

_EVENTS_SHOWN = 20

log = App(name="log", help="Show, export and repair logs.")


@log.command
def show(file: Path, *, json: bool = False, parameters: bool = False) -> None:
    """Show what a log holds: rows, rate, columns with units and ranges; of a recording also metadata and events.

    Parameters
    ----------
    file
        A recording, finished or not, or a log in another format.
    json
        Print JSON for scripts.
    parameters
        Show only the parameters of the run: who set what when, and what was in force at the end.
    """
    import warnings

    from armlab import log as logs
    from armlab.cli.output import print_json, result
    from armlab.log.formats import format_at

    kind = format_at(file)
    held = logs.inspect(file) if kind in ("MCAP", "") else None  # of no file it says why
    if parameters:
        result(_parameters(held) if held else "This log has no parameters.")
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the notes of the table say the same and are shown below
        table = logs.read(file)
    if json:
        print_json({"file": str(file), **_table_data(table), **(_recording_data(held) if held else {"format": kind})})
    else:
        result(_text(held, table) if held else _exchanged_text(file, kind, table))


@log.command
def export(
    file: Path,
    output: Path,
    *,
    robot: str | None = None,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    force: bool = False,
) -> None:
    """Write a log in another format, which the ending of the new name tells.

    .csv for spreadsheets, .mat for MATLAB, .parquet for pandas and databases, .h5 for HDF5, .rosbag2 for ROS 2, .mcap
    for a recording of armlab. armlab reads all of them back as they were.

    Parameters
    ----------
    file
        A log in any of these formats, finished or not.
    output
        The new file; of a rosbag2 the new folder.
    robot
        Which one, of a recording of several; the arm of the log, for .mcap.
    storage
        Of a rosbag2: sqlite3 for releases of ROS 2 that are older than Iron.
    force
        Replace an existing file.
    """
    from armlab import log as logs
    from armlab import robots
    from armlab.cli.output import check_output, note, progress, refuse_overwrite, result
    from armlab.log.formats import format_at
    from armlab.log.mat_table import matlab_names
    from armlab.log.sidecar import sidecar_path
    from armlab.log.writing import ENDINGS

    check_output(output, force, ENDINGS)
    ending = output.suffix.lower()
    if ending == ".csv":
        refuse_overwrite(sidecar_path(output), force)
    arm = robots.load(robot) if robot is not None and ending == ".mcap" else None
    with progress("export") as tell:
        tell(0, 1, f"reading {file.name}")
        table = logs.read(file, robot=robot if format_at(file) == "MCAP" else None)
        logs.write(
            table,
            output,
            arm,
            storage=storage,
            progress=lambda done, total, _: tell(done, total, f"writing {output.name}"),
        )
    if ending == ".mat":
        changed = [f"{name} is {own}" for name, own in matlab_names(table.names).items() if own != name]
        if changed:
            note(f"Names that MATLAB does not allow: {', '.join(changed)}. The struct names in the file has them, too.")
    result(str(output))


@log.command
def recover(file: Path, *, output: Path | None = None) -> None:
    """Write a whole copy of a log that was cut off or damaged. The original stays as it is.

    Parameters
    ----------
    file
        The recording.
    output
        The copy; <name>.recovered.mcap beside the file when not given.
    """
    from armlab import log as logs
    from armlab.cli.output import note, progress, result

    with progress("recover") as tell:
        done = logs.recover(file, output, progress=tell)
    note(
        f"{done.messages} messages over {done.seconds:.3f} s; lost: {done.torn} bytes at the end, "
        f"{done.lost_chunks} damaged chunks"
    )
    result(str(done.path))


def _parameters(held: Inspection) -> str:
    """Return the history of the parameters."""
    from datetime import UTC, datetime

    told = [
        (one.stamp_ns, f"{one.name} = {one.value}, {f'set by {one.who} ({one.sequence})' if one.sequence else one.who}")
        for one in held.parameters
    ]
    told += [(event.stamp_ns, event.text) for event in held.events if event.text.startswith("A setting of ")]
    lines = [
        f"{datetime.fromtimestamp(stamp_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S.%f} UTC  {text}"
        for stamp_ns, text in sorted(told, key=itemgetter(0))
    ]
    last = (held.summary or {}).get("parameters") or {}
    ends = [f"At the end: {', '.join(f'{name} = {value}' for name, value in last.items())}."] if last else []
    return "\n".join([*lines, *ends]) or "This log has no parameters."


def _table_data(table: Table) -> dict[str, Any]:
    """Return what is shown of any log, for scripts."""
    from armlab.log.text import component_names, statistics, timing

    holes = table.missing()
    columns = {}
    for name in table.names:
        about, stats = table.columns[name], statistics(table[name])
        columns[name] = {"shape": list(about.shape), "unit": about.unit, "frame": about.frame, "kind": about.kind}
        columns[name] |= {"missing": holes.get(name, (0, ()))[0], "components": component_names(table, name)}
        columns[name] |= {key: stats[key] for key in ("min", "max", "mean", "sigma")}
    return {
        **timing(table),
        "clock": table.clock,
        "t0_ns": table.t0_ns,
        "sha256": table.sha256,
        "columns": columns,
        "notes": table.notes,
        "source": table.source,
    }


def _recording_data(held: Inspection) -> dict[str, Any]:
    """Return what is shown of a recording besides, for scripts."""
    return {
        "format": "MCAP",
        "bytes": held.size,
        "finished": held.finished,
        "torn_bytes": held.torn,
        "metadata": held.metadata,
        "topics": [{"name": t.name, "type": t.type, "messages": t.messages} for t in held.topics],
        "attachments": {name: len(data) for name, data in held.attachments.items()},
        "events": [{"stamp_ns": event.stamp_ns, "text": event.text} for event in held.events],
        "summary": held.summary,
    }


def _exchanged_text(file: Path, kind: str, table: Table) -> str:
    """Return what is shown of a log that is no recording."""
    from armlab.cli.output import aligned
    from armlab.log.text import table_text

    first, *rest = table_text(table).splitlines()
    source = [f"source: {entry}" for entry in table.source]
    head = [
        f"{file}: {kind}, began {_began(table)}",
        first,
        *(line for line in rest if line.startswith("note:")),
        *source,
    ]
    return "\n".join(head) + "\n\n" + aligned(_column_rows(table), right=(4, 5, 6))


def _began(table: Table) -> str:
    from datetime import UTC, datetime

    if not table.t0_ns:
        return "-"
    return datetime.fromtimestamp(table.t0_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _text(held: Inspection, table: Table) -> str:
    from armlab.cli.output import aligned
    from armlab.log.text import table_text

    state = "finished" if held.finished else f"not finished, {held.torn} bytes torn"
    blocks = [f"{held.path}: {held.size / 1e6:.2f} MB, {state}, began {_began(table)}"]
    about = held.metadata.get("armlab", {})
    blocks.append(aligned([(key, value) for key, value in about.items() if value and key != "attachments"]))
    first, *rest = table_text(table).splitlines()
    blocks.append("\n".join([first, *(line for line in rest if line.startswith("note:"))]))
    blocks.append(aligned(_column_rows(table), right=(4, 5, 6)))
    blocks.append(aligned([("attachment", "bytes"), *((n, str(len(d))) for n, d in held.attachments.items())], (1,)))
    lines = [f"{_when(event.stamp_ns, table.t0_ns):>12}  {event.text}" for event in held.events[:_EVENTS_SHOWN]]
    more = len(held.events) - len(lines)
    blocks.append("\n".join(["events", *lines, *([f"and {more} more (--json shows all)"] if more > 0 else [])]))
    return "\n\n".join(block for block in blocks if block)


def _when(stamp_ns: int, t0_ns: int) -> str:
    """Return seconds since the first row; "-" where the stamp is on another clock, as in lockstep."""
    seconds = (stamp_ns - t0_ns) / 1e9
    return f"{seconds:.3f} s" if abs(seconds) < 30 * 86_400 else "-"


def _column_rows(table: Table) -> list[tuple[str, ...]]:
    """Return one row per column: shape of a row, unit, frame, missing, minimum and maximum over its components."""
    import numpy as np

    from armlab.log.text import statistics

    holes = table.missing()
    rows: list[tuple[str, ...]] = [("column", "shape", "unit", "frame", "missing", "min", "max")]
    for name in table.names:
        column, stats = table.columns[name], statistics(table[name])
        known = ~np.isnan(stats["min"])
        numbers = [f"{f(stats[k][known]):.6g}" if known.any() else "-" for k, f in (("min", np.min), ("max", np.max))]
        shape = "x".join(map(str, column.shape)) or "1"
        rows.append((name, shape, column.unit or "", column.frame or "-", str(holes.get(name, (0,))[0]), *numbers))
    return rows
