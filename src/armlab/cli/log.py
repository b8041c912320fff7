"""``armlab log``: show, export, cut, resample, merge, open and repair logs."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from glob import escape
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Columns, Force, Json, Output, load_robot, require_positive
from armlab.cli.support.output import aligned, check_output, note, print_json, progress, refuse_overwrite, result
from armlab.errors import ConfigError, LogError, MissingExtra

if TYPE_CHECKING:
    from collections.abc import Mapping

    from armlab.log import Table
    from armlab.log.recording.metadata import Inspection
    from armlab.robots import Robot

log: App = App(name="log", help="Show, export, cut, resample, merge, open and repair logs.")


@log.command(help_epilogue="Example: armlab log show run.mcap")
def show(file: Path, *, columns: Columns = None, json: Json = False, parameters: bool = False) -> None:
    """Show the contents of a log: rows, rate, columns with units and ranges; for a recording also metadata and events.

    Topics of an MCAP file or a bag not recorded by armlab are listed separately. The log name of a cell selects the
    files of all its arms.

    Parameters:
        file: A finished or unfinished recording, or a log in another format.
        parameters: Show only the parameters of the run: all changes with their authors, and the final values.
    """
    told = [_held(one, columns, json, parameters) for one in _files_of(file)]
    if json:
        print_json(told[0] if len(told) == 1 else told)
    else:
        result("\n\n".join(told))


def _held(file: Path, columns: str | None, json: bool, parameters: bool) -> Any:
    """Return the contents of a file as text, or as data for JSON."""
    import warnings

    from armlab.cli.support.log_input import reading_bar
    from armlab.log.file_formats.opening import format_at
    from armlab.log.topics.reader import is_foreign

    kind = format_at(file)
    held = armlab.log.inspect(file) if kind in ("MCAP", "") else None  # raises an error for other files
    if held and not held.topics:
        raise LogError(f"Expected messages in {file}, got no readable message in {held.size} bytes.")
    if parameters and json:
        return parameters_data(held) if held else {"parameters": [], "parameters_at_end": {}}
    if parameters:
        return parameters_text(held) if held else "This log has no parameters."
    robots = held.robots if held and len(held.robots) > 1 else (None,)
    with warnings.catch_warnings(), reading_bar(file) as tell:
        warnings.simplefilter("ignore")  # repeated by the notes of the table
        if is_foreign(file) and columns is None:
            tables = armlab.log.read_topics(file, progress=tell)
        else:
            tables = {name or "": armlab.log.read(file, columns, robot=name, progress=tell) for name in robots}
    if json:
        return _data(file, kind, held, tables)
    return _text(held, tables) if held else _exchanged_text(file, kind, tables)


def _files_of(file: Path) -> list[Path]:
    """Return the file, or the recordings of all arms of a cell with this log name, such as cellleft.mcap."""
    if file.exists():
        return [file]
    found = []
    for path in sorted(file.parent.glob(f"{escape(file.stem)}?*{file.suffix}")):
        end = re.sub(r"-\d+$", "", path.stem.removeprefix(file.stem))  # without the number appended to a repeated name
        with suppress(LogError, OSError):
            robot = armlab.log.inspect(path).metadata.get("armlab", {}).get("robot", "")
            if end in ("left", "right", f"-{robot}"):
                found.append(path)
    return found or [file]


@log.command(help_epilogue="Example: armlab log export run.mcap run.mat")
def export(
    file: Path,
    output: Path,
    *,
    robot: str | None = None,
    clock: str | None = None,
    columns: Columns = None,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    force: Force = False,
) -> None:
    """Convert a log; the output format follows the file extension.

    .csv for spreadsheets, .mat for MATLAB, .parquet for pandas and databases, .h5 for HDF5, .rosbag2 for ROS 2, .mcap
    for an armlab recording. armlab reads all of them back losslessly.

    Parameters:
        file: A log in any of these formats, finished or unfinished.
        output: The new file (for rosbag2, the new folder).
        robot: Robot to select from a recording of several robots. For a log not recorded by armlab: robot whose
            joints to read, or the prefix of its topic names. For .mcap and .rosbag2: library name or file of the arm if
            the log has no robot description.
        clock: For a log not recorded by armlab: the topic whose timestamps define the rows; see armlab log show.
        storage: Storage format of a rosbag2; use sqlite3 for ROS 2 releases before Iron.
    """
    from armlab.log.file_formats.delimited import sidecar_path
    from armlab.log.file_formats.mat import matlab_names
    from armlab.log.writing import ENDINGS

    check_output(output, force, ENDINGS, [file])
    ending = output.suffix.lower()
    if ending == ".csv":
        refuse_overwrite(sidecar_path(output), force)
    arm = _arm_for(ending, file, robot)
    with progress("export") as tell:
        reading, writing = f"reading {file.name}", f"writing {output.name}"
        tell(0, 1, reading)
        name = robot if arm is None else arm
        table = _table(file, columns, name, clock=clock, progress=lambda done, total, _: tell(done, total, reading))
        armlab.log.write(
            table, output, arm, storage=storage, progress=lambda done, total, _: tell(done, total, writing)
        )
    if ending == ".mat":
        changed = [f"{name} to {own}" for name, own in matlab_names(table.names).items() if own != name]
        if changed:
            note(
                f"Columns renamed for MATLAB: {', '.join(changed)}. The "
                "struct `names` in the file lists the renamed columns."
            )
    result(str(output))


def _table(file: Path, columns: str | None, robot: str | Robot | None, **options: Any) -> Table:
    """Return the table of a log; `robot` is ignored for formats without robot names."""
    from armlab.log.reading import names_robots

    return armlab.log.read(file, columns, robot=robot if names_robots(file) else None, **options)


def _arm_for(ending: str, file: Path, robot: str | None) -> Robot | None:
    """Return the recorded or given arm, which provides joint names for the new file; None if the format does not store
    joint names."""
    from armlab.log.file_formats.opening import format_at
    from armlab.log.recording.metadata import described
    from armlab.log.topics.reader import is_foreign

    if ending not in (".mcap", ".rosbag2") or (ending == ".rosbag2" and is_foreign(file)):
        return None
    if format_at(file) == "MCAP":
        held = armlab.log.inspect(file)
        names = held.robots if robot is None and len(held.robots) == 1 else (robot or "",)
        arm = described(held.attachments, names[0], str(file))
        if arm is not None:
            return arm
    return None if robot is None else load_robot(robot)


@log.command(help_epilogue="Example: armlab log recover run.mcap")
def recover(file: Path, *, output: Path | None = None) -> None:
    """Write a repaired copy of a truncated or corrupt log. The original is not modified.

    Parameters:
        file: The recording.
        output: The copy; default: <name>.recovered.mcap in the same folder.
    """
    with progress("recover") as tell:
        done = armlab.log.recover(file, output, progress=tell)
    lost = f"lost: {done.torn} bytes at the end, {done.lost_chunks} corrupt chunks"
    note(f"{done.messages} messages over {done.seconds:.3f} s; {lost}")
    result(str(done.path))


@log.command(help_epilogue="Example: armlab log cut run.mcap --from 10 --to 20 -o part.mcap")
def cut(
    file: Path,
    *,
    from_: Annotated[float | None, Parameter(name="--from")] = None,
    to: float | None = None,
    robot: str | None = None,
    columns: Columns = None,
    output: Output,
    force: Force = False,
) -> None:
    """Copy a segment of a log: the rows with --from <= t < --to. The original is not modified.

    A recording keeps its metadata, its attachments, the parameters in force, and the events of the segment. Times t are
    not shifted: 12.3 s is the same instant in both files.

    Parameters:
        file: A finished or unfinished recording, or a log in another format.
        from_: Start [s], as shown by armlab log show and in figures; default: the beginning.
        to: End [s]; default: the end.
        robot: Robot to select from a recording of several robots; default for .mcap: all. For other formats, see armlab
            log export.
        output: The new file: .mcap for a recording, or an extension supported by armlab log export.
    """
    from armlab.log.file_formats.opening import format_at
    from armlab.log.topics.reader import is_foreign
    from armlab.log.writing import ENDINGS

    start, stop = (-float("inf") if from_ is None else from_), (float("inf") if to is None else to)
    if not start < stop or (from_, to, robot) == (None, None, None):
        raise ConfigError(f"Expected --from S < --to S, or only one of them, got {from_} and {to}.")
    check_output(output, force, ENDINGS, [file])
    with progress("cut") as tell:
        recorded = format_at(file) in ("MCAP", "") and not is_foreign(file)
        if output.suffix.lower() == ".mcap" and recorded and columns is None:
            armlab.log.cut(file, output, start, stop, robot=robot, progress=tell)
        else:
            arm = _arm_for(output.suffix.lower(), file, robot)
            table = _table(file, columns, robot)
            part = table.between(start, stop)
            if not len(part):
                has = f"covers {table.t[0]:g} s to {table.t[-1]:g} s" if len(table) else "is empty"
                raise LogError(f"Expected rows between {start:g} s and {stop:g} s in {file}, got none. The log {has}.")
            armlab.log.write(part, output, arm, progress=tell)
    result(str(output))


@log.command(help_epilogue="Example: armlab log resample run.mcap --rate 250 -o even.mcap")
def resample(
    file: Path,
    *,
    rate: float,
    max_gap: float | None = None,
    robot: str | None = None,
    columns: Columns = None,
    output: Output,
    force: Force = False,
) -> None:
    """Resample a log to a uniform rate.

    Numbers are interpolated linearly, and poses and quaternions along geodesics. Counts, flags and text columns keep
    the value of the previous row. Use this command for logs with skipped cycles or jittered timestamps. The rate must
    not be lower than the sampling rate of the log; to downsample, filter first.

    Parameters:
        file: A finished or unfinished recording, or a log in another format.
        rate: Rows per second [Hz].
        max_gap: Longest gap between rows to interpolate [s]; longer gaps give missing values. Default: three periods.
        robot: As in armlab log export.
        output: The new file, with an extension supported by armlab log export.
    """
    from armlab.log.writing import ENDINGS

    require_positive("rate", rate, "Hz")
    require_positive("max-gap", max_gap, "s")
    check_output(output, force, ENDINGS, [file])
    arm = _arm_for(output.suffix.lower(), file, robot)
    with progress("resample") as tell:
        tell(0, 1, f"reading {file.name}")
        table = _table(file, columns, robot)
        even = table.resample(rate, max_gap=max_gap)
        armlab.log.write(even, output, arm, progress=tell)
    note(f"{len(table)} rows resampled to {len(even)}")
    result(str(output))


@log.command(help_epilogue="Example: armlab log merge first.mcap second.mcap -o both.mcap")
def merge(*file: Path, output: Output, force: Force = False) -> None:
    """Merge several recordings into one. The originals are not modified.

    Recordings of one robot are joined by wall-clock time; gaps between them remain. Recordings of both arms of a bridge
    are stored side by side: select one with --robot (armlab log export) or --arm (armlab plot).

    Parameters:
        file: Two or more recordings, in any order.
        output: The new file, .mcap.
    """
    check_output(output, force, [".mcap"], file)
    with progress("merge") as tell:
        armlab.log.merge(file, output, progress=tell)
    result(str(output))


@log.command(name="open", help_epilogue="Example: armlab log open run.mcap --foxglove")
def open_(file: Path, *, rerun: bool = False, foxglove: bool = False, plotjuggler: bool = False) -> int:
    """Open a recording in another program: Foxglove, PlotJuggler or Rerun.

    Default: the first installed program. The command returns when the program ends. armlab plot and armlab view need
    none of these programs.

    Parameters:
        file: A finished recording.
        rerun: Use Rerun.
        foxglove: Use Foxglove.
        plotjuggler: Use PlotJuggler.
    """
    if not armlab.log.inspect(file).finished:
        raise LogError(
            f"Expected a finished recording, got the truncated {file}, which other programs cannot open. "
            f"Repair the file: armlab log recover {file}."
        )
    wanted = [name for name, is_on in (("foxglove", foxglove), ("plotjuggler", plotjuggler), ("rerun", rerun)) if is_on]
    viewer, program = chosen(wanted)
    note(f"Opening {file} in {viewer.title}: {program}.{viewer.remark}")
    return FAILED if subprocess.run([program, *viewer.arguments, str(file.absolute())], check=False).returncode else 0


_EVENTS_SHOWN = 20


def _data(file: Path, kind: str, held: Inspection | None, tables: Mapping[str, Table]) -> dict[str, Any]:
    told = [_table_data(table) for table in tables.values()]
    several = "robots" if held and held.robots else "tables"
    rows = told[0] if list(tables) == [""] else {several: dict(zip(tables, told, strict=True))}
    return {"file": str(file), **rows, **(_recording_data(held) if held else {"format": kind})}


def parameters_text(held: Inspection) -> str:
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


def parameters_data(held: Inspection) -> dict[str, Any]:
    return {
        "parameters": [
            {"stamp_ns": one.stamp_ns, "name": one.name, "value": one.value, "who": one.who, "sequence": one.sequence}
            for one in held.parameters
        ],
        "parameters_at_end": (held.summary or {}).get("parameters") or {},
    }


def _table_data(table: Table) -> dict[str, Any]:
    from armlab.log.table import component_names, statistics, timing

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
    """Return the additional content of a recording as data for JSON."""
    return {
        "format": "MCAP",
        "bytes": held.size,
        "finished": held.finished,
        "torn_bytes": held.torn,
        "metadata": held.metadata,
        "topics": [{"name": t.name, "type": t.type, "messages": t.messages} for t in held.topics],
        "attachments": {name: len(data) for name, data in held.attachments.items()},
        "events": [{"stamp_ns": event.stamp_ns, "text": event.text} for event in held.events],
        **parameters_data(held),
        "summary": held.summary,
    }


def _exchanged_text(file: Path, kind: str, tables: Mapping[str, Table]) -> str:
    first = min(tables.values(), key=lambda table: table.t0_ns, default=None)
    sources = [f"source: {entry}" for entry in first.source] if first else []
    head = [f"{file}: {kind}, began {_began(first.t0_ns if first else 0)}", *sources]
    return "\n\n".join(["\n".join(head), *_table_texts(tables)])


def _table_texts(tables: Mapping[str, Table]) -> list[str]:
    """Return a description of each table (size, rate, notes, columns), with its name if there are several tables."""
    blocks = [] if tables else ["no topic with numeric data"]
    for name, table in tables.items():
        first, *rest = str(table).splitlines()
        first = f"{name}: {first}" if name else first
        blocks.append("\n".join([first, *(line for line in rest if line.startswith("note:"))]))
        blocks.append(aligned(_column_rows(table), right=(4, 5, 6)))
    return blocks


def _began(t0_ns: int) -> str:
    from datetime import UTC, datetime

    return f"{datetime.fromtimestamp(t0_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S UTC}" if t0_ns else "-"


def _text(held: Inspection, tables: Mapping[str, Table]) -> str:
    state = "finished" if held.finished else f"unfinished, {held.torn} bytes truncated"
    began = min((table.t0_ns for table in tables.values()), default=0)
    blocks = [f"{held.path}: {held.size / 1e6:.2f} MB, {state}, began {_began(began)}"]
    for about in held.metadata.values():
        shown = [pair for pair in about.items() if pair[1] and "\n" not in pair[1] and pair[0] != "attachments"]
        blocks.append(aligned(shown))
    blocks += _table_texts(tables)
    if skipped := held.summary.get("skipped"):
        blocks.append(f"The robot's clock shows {skipped} skipped controller cycles, for which the log has no rows.")
    blocks.append(aligned([("attachment", "bytes"), *((n, str(len(d))) for n, d in held.attachments.items())], (1,)))
    lines = [f"{_when(event.stamp_ns, began):>12}  {event.text}" for event in held.events[:_EVENTS_SHOWN]]
    more = len(held.events) - len(lines)
    blocks.append("\n".join(["events", *lines, *([f"and {more} more (--json shows all)"] if more > 0 else [])]))
    return "\n\n".join(block for block in blocks if block)


def _when(stamp_ns: int, t0_ns: int) -> str:
    """Return the time since the first row; "-" for timestamps of another clock, as in lockstep."""
    seconds = (stamp_ns - t0_ns) / 1e9
    return f"{seconds:.3f} s" if abs(seconds) < 30 * 86_400 else "-"


def _column_rows(table: Table) -> list[tuple[str, ...]]:
    """Return one row per column: its shape, unit, frame, number of missing values, minimum and maximum."""
    import numpy as np

    from armlab.log.table import statistics

    holes = table.missing()
    rows: list[tuple[str, ...]] = [("column", "shape", "unit", "frame", "missing", "min", "max")]
    for name in table.names:
        column, stats = table.columns[name], statistics(table[name])
        known = ~np.isnan(stats["min"])
        numbers = [f"{f(stats[k][known]):.6g}" if known.any() else "-" for k, f in (("min", np.min), ("max", np.max))]
        shape = "x".join(map(str, column.shape)) or "1"
        rows.append((name, shape, column.unit or "", column.frame or "-", str(holes.get(name, (0,))[0]), *numbers))
    return rows


@dataclass(frozen=True, slots=True)
class Viewer:
    """A program that opens MCAP files."""

    title: str
    program: str  # command
    arguments: tuple[str, ...]  # arguments before the file name
    source: str  # installation hint
    remark: str = ""  # printed before opening


VIEWERS = {
    "foxglove": Viewer("Foxglove", "foxglove-studio", (), "download the desktop program from foxglove.dev/download"),
    "plotjuggler": Viewer("PlotJuggler", "plotjuggler", ("-d",), "packages are listed at plotjuggler.io"),
    "rerun": Viewer(
        "Rerun",
        "rerun",
        ("--bind", "127.0.0.1"),  # the default is all network interfaces
        "pip install rerun-sdk, into a separate environment",
        " Rerun may connect to external hosts; `rerun analytics disable` prevents that.",
    ),
}


def chosen(wanted: Sequence[str]) -> tuple[Viewer, str]:
    """Return the program that opens a recording, and the path of the program."""
    if len(wanted) > 1:
        raise ConfigError(f"Expected a single program to open the log, got {' and '.join(wanted)}. Omit one.")
    places = {name: shutil.which(viewer.program) for name, viewer in VIEWERS.items()}
    for name in wanted or VIEWERS:
        if place := places[name]:
            return VIEWERS[name], place
    there = ", ".join(VIEWERS[name].title for name, place in places.items() if place) or "none of these programs"
    missing = "; ".join(f"{VIEWERS[name].title}: {VIEWERS[name].source}" for name in wanted or VIEWERS)
    what = VIEWERS[wanted[0]].title if wanted else "Foxglove, PlotJuggler or Rerun"
    raise MissingExtra(f"Expected {what} on the PATH, got {there}. Install it: {missing}.")
