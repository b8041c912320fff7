"""``armlab log``: show, export, cut, merge, open and repair logs."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Force, Json
from armlab.cli.support.output import aligned, check_output, note, print_json, progress, refuse_overwrite, result
from armlab.errors import ConfigError, LogError, MissingExtra

if TYPE_CHECKING:
    from collections.abc import Mapping

    from armlab.log import Table
    from armlab.log.recording.metadata import Inspection
    from armlab.robots import Robot


log = App(name="log", help="Show, export, cut, merge, open and repair logs.")


@log.command(help_epilogue="Example: armlab log show run.mcap")
def show(file: Path, *, json: Json = False, parameters: bool = False) -> None:
    """Show what a log holds: rows, rate, columns with units and ranges; of a recording also metadata and events.

    Of a log of another program, an MCAP file or a bag, it shows each topic by itself.

    Parameters:
        file: A recording, finished or not, or a log in another format.
        parameters: Show only the parameters of the run: who set what when, and what was in force at the end.
    """
    import warnings

    from armlab.cli.support.log_input import reading_bar
    from armlab.log.file_formats.opening import format_at
    from armlab.log.topics.reader import is_foreign

    kind = format_at(file)
    held = armlab.log.inspect(file) if kind in ("MCAP", "") else None  # of no file it says why
    if held and not held.topics:
        raise LogError(f"Expected messages in {file}, got none that can be read in {held.size} bytes.")
    if parameters:
        if json:
            print_json(parameters_data(held) if held else {"parameters": [], "parameters_at_end": {}})
        else:
            result(parameters_text(held) if held else "This log has no parameters.")
        return
    robots = held.robots if held and len(held.robots) > 1 else (None,)
    with warnings.catch_warnings(), reading_bar(file) as tell:
        warnings.simplefilter("ignore")  # the notes of the table say the same and are shown below
        if is_foreign(file):
            tables = armlab.log.read_topics(file, progress=tell)
        else:
            tables = {name or "": armlab.log.read(file, robot=name, progress=tell) for name in robots}
    if json:
        print_json(_data(file, kind, held, tables))
    else:
        result(_text(held, tables) if held else _exchanged_text(file, kind, tables))


@log.command(help_epilogue="Example: armlab log export run.mcap run.mat")
def export(
    file: Path,
    output: Path,
    *,
    robot: str | None = None,
    clock: str | None = None,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    force: Force = False,
) -> None:
    """Convert a log; the output format follows the file extension.

    .csv for spreadsheets, .mat for MATLAB, .parquet for pandas and databases, .h5 for HDF5, .rosbag2 for ROS 2, .mcap
    for a recording of armlab. armlab reads all of them back as they were.

    Parameters:
        file: A log in any of these formats, finished or not.
        output: The new file; of a rosbag2 the new folder.
        robot: Which one, of a recording of several; of a log of another program the arm whose joints it has, or the
            first part of its topics. For .mcap and .rosbag2 the arm of the log, by name or file, if the log does not
            describe it.
        clock: Of a log of another program, the topic whose stamps are the rows, as armlab log show lists them.
        storage: Of a rosbag2: sqlite3 for releases of ROS 2 that are older than Iron.
    """
    from armlab.log.file_formats.delimited import sidecar_path
    from armlab.log.file_formats.mat import matlab_names
    from armlab.log.reading import names_robots
    from armlab.log.writing import ENDINGS

    check_output(output, force, ENDINGS, [file])
    ending = output.suffix.lower()
    if ending == ".csv":
        refuse_overwrite(sidecar_path(output), force)
    arm = _arm_for(ending, file, robot)
    with progress("export") as tell:
        tell(0, 1, f"reading {file.name}")
        table = armlab.log.read(
            file,
            robot=(robot if arm is None else arm) if names_robots(file) else None,
            clock=clock,
            progress=lambda done, total, _: tell(done, total, f"reading {file.name}"),
        )
        armlab.log.write(
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


def _arm_for(ending: str, file: Path, robot: str | None) -> Robot | None:
    """Return the arm whose joints a new file names: as a recording describes it, else the one that is named.

    None for formats without names of joints, and for a bag that keeps the names of another program.
    """
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
    return None if robot is None else armlab.robots.load(robot)


@log.command(help_epilogue="Example: armlab log recover run.mcap")
def recover(file: Path, *, output: Path | None = None) -> None:
    """Write a repaired copy of a truncated or damaged log. The original stays as it is.

    Parameters:
        file: The recording.
        output: The copy; <name>.recovered.mcap beside the file when not given.
    """
    with progress("recover") as tell:
        done = armlab.log.recover(file, output, progress=tell)
    note(
        f"{done.messages} messages over {done.seconds:.3f} s; lost: {done.torn} bytes at the end, "
        f"{done.lost_chunks} damaged chunks"
    )
    result(str(done.path))


@log.command(help_epilogue="Example: armlab log cut run.mcap --from 10 --to 20 -o part.mcap")
def cut(
    file: Path,
    *,
    from_: Annotated[float | None, Parameter(name="--from")] = None,
    to: float | None = None,
    robot: str | None = None,
    output: Annotated[Path, Parameter(alias="-o")],
    force: Force = False,
) -> None:
    """Write a segment of a log: the rows with --from <= t < --to. The original stays as it is.

    A recording stays a whole recording: metadata, attachments, the parameters so far, and the events of the stretch.
    Its t is not shifted, so that 12.3 s is the same moment in both.

    Parameters:
        file: A recording, finished or not, or a log in another format.
        from_: Seconds of the table, as armlab log show and the figures have them; from the beginning when not given.
        to: Seconds of the table; to the end when not given.
        robot: Which one, of a recording of several: all of them stay in .mcap when not given. Else as in armlab log
            export.
        output: The new file: .mcap of a recording; else an ending that armlab log export knows.
    """
    from armlab.log.file_formats.opening import format_at
    from armlab.log.reading import names_robots
    from armlab.log.topics.reader import is_foreign
    from armlab.log.writing import ENDINGS

    start, stop = (-float("inf") if from_ is None else from_), (float("inf") if to is None else to)
    if not start < stop or (from_, to, robot) == (None, None, None):
        raise ConfigError(f"Expected --from S, --to S or both, the first before the second, got {from_} and {to}.")
    check_output(output, force, ENDINGS, [file])
    with progress("cut") as tell:
        if output.suffix.lower() == ".mcap" and format_at(file) in ("MCAP", "") and not is_foreign(file):
            armlab.log.cut(file, output, start, stop, robot=robot, progress=tell)
        else:
            arm = _arm_for(output.suffix.lower(), file, robot)
            table = armlab.log.read(file, robot=robot if names_robots(file) else None)
            part = table.between(start, stop)
            if not len(part):
                has = f"{table.t[0]:g} s to {table.t[-1]:g} s" if len(table) else "no rows at all"
                raise LogError(f"Expected rows between {start:g} s and {stop:g} s in {file}, got none; it has {has}.")
            armlab.log.write(part, output, arm, progress=tell)
    result(str(output))


@log.command(help_epilogue="Example: armlab log merge first.mcap second.mcap -o both.mcap")
def merge(*file: Path, output: Annotated[Path, Parameter(alias="-o")], force: Force = False) -> None:
    """Write several recordings to one. The originals stay as they are.

    Recordings of one robot are put one after another by their wall clocks, and the gaps between them stay. Recordings
    of both arms of a bridge stand side by side: commands take the rows of the robot that they name, armlab log export
    those of --robot, armlab plot those of --arm.

    Parameters:
        file: Two recordings or more, in any order.
        output: The new file, .mcap.
    """
    check_output(output, force, [".mcap"], file)
    with progress("merge") as tell:
        armlab.log.merge(file, output, progress=tell)
    result(str(output))


@log.command(name="open", help_epilogue="Example: armlab log open run.mcap --foxglove")
def open_(file: Path, *, rerun: bool = False, foxglove: bool = False, plotjuggler: bool = False) -> int:
    """Open a recording in another program, if it is installed: Foxglove, PlotJuggler or Rerun.

    Without an option the first of these that is installed. armlab needs none of them: armlab plot and armlab view show
    logs, too. Returns when the program ends.

    Parameters:
        file: A finished recording.
        rerun: Open it there.
        foxglove: Open it there.
        plotjuggler: Open it there.
    """
    if not armlab.log.inspect(file).finished:
        raise LogError(
            f"Expected a finished recording, got {file}, which was cut off, and which other programs do not open. Make "
            f"it whole: armlab log recover {file}."
        )
    wanted = [name for name, is_on in (("foxglove", foxglove), ("plotjuggler", plotjuggler), ("rerun", rerun)) if is_on]
    viewer, program = chosen(wanted)
    note(f"Opening {file} in {viewer.title}: {program}.{viewer.remark}")
    return FAILED if subprocess.run([program, *viewer.arguments, str(file.absolute())], check=False).returncode else 0


_EVENTS_SHOWN = 20


def _data(file: Path, kind: str, held: Inspection | None, tables: Mapping[str, Table]) -> dict[str, Any]:
    """Return what is shown of a log, for scripts."""
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
    """Return what is shown of any log, for scripts."""
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
        **parameters_data(held),
        "summary": held.summary,
    }


def _exchanged_text(file: Path, kind: str, tables: Mapping[str, Table]) -> str:
    first = min(tables.values(), key=lambda table: table.t0_ns, default=None)
    sources = [f"source: {entry}" for entry in first.source] if first else []
    head = [f"{file}: {kind}, began {_began(first.t0_ns if first else 0)}", *sources]
    return "\n\n".join(["\n".join(head), *_table_texts(tables)])


def _table_texts(tables: Mapping[str, Table]) -> list[str]:
    """Return rows, notes and columns of each table, with its name where there are several."""

    blocks = [] if tables else ["no topic with numbers"]
    for name, table in tables.items():
        first, *rest = str(table).splitlines()
        first = f"{name}: {first}" if name else first
        blocks.append("\n".join([first, *(line for line in rest if line.startswith("note:"))]))
        blocks.append(aligned(_column_rows(table), right=(4, 5, 6)))
    return blocks


def _began(t0_ns: int) -> str:
    from datetime import UTC, datetime

    if not t0_ns:
        return "-"
    return datetime.fromtimestamp(t0_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _text(held: Inspection, tables: Mapping[str, Table]) -> str:
    state = "finished" if held.finished else f"not finished, {held.torn} bytes torn"
    began = min((table.t0_ns for table in tables.values()), default=0)
    blocks = [f"{held.path}: {held.size / 1e6:.2f} MB, {state}, began {_began(began)}"]
    for about in held.metadata.values():
        blocks.append(
            aligned(
                [(key, value) for key, value in about.items() if value and "\n" not in value and key != "attachments"]
            )
        )
    blocks += _table_texts(tables)
    blocks.append(aligned([("attachment", "bytes"), *((n, str(len(d))) for n, d in held.attachments.items())], (1,)))
    lines = [f"{_when(event.stamp_ns, began):>12}  {event.text}" for event in held.events[:_EVENTS_SHOWN]]
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

    title: str  # title, program: its name, and that of its command
    program: str
    arguments: tuple[str, ...]  # before the file
    source: str  # how one gets it
    remark: str = ""  # what one should know before it opens


VIEWERS = {
    "foxglove": Viewer("Foxglove", "foxglove-studio", (), "its desktop program is at foxglove.dev/download"),
    "plotjuggler": Viewer("PlotJuggler", "plotjuggler", ("-d",), "its packages are listed at plotjuggler.io"),
    "rerun": Viewer(
        "Rerun",
        "rerun",
        ("--bind", "127.0.0.1"),  # its default is every interface
        "pip install rerun-sdk, in an environment of its own",
        " It may call hosts outside; `rerun analytics disable` says no.",
    ),
}


def chosen(wanted: Sequence[str]) -> tuple[Viewer, str]:
    """Return the program to open a recording with, and where it is."""
    if len(wanted) > 1:
        raise ConfigError(f"Expected one program to open the log with, got {' and '.join(wanted)}. Leave one out.")
    places = {name: shutil.which(viewer.program) for name, viewer in VIEWERS.items()}
    for name in wanted or VIEWERS:
        place = places[name]
        if place is not None:
            return VIEWERS[name], place
    there = ", ".join(VIEWERS[name].title for name, place in places.items() if place) or "none of these programs"
    missing = "; ".join(f"{VIEWERS[name].title}: {VIEWERS[name].source}" for name in wanted or VIEWERS)
    what = VIEWERS[wanted[0]].title if wanted else "Foxglove, PlotJuggler or Rerun"
    raise MissingExtra(f"Expected {what} on the PATH, got {there}. How to get it: {missing}.")
