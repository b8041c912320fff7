"""``armlab log``: what a log holds, its export, parts of it, several in one, repair, and other programs to look."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["cut", "export", "log", "merge", "open_", "recover", "show"]

log = App(name="log", help="Show, export, cut, merge, open and repair logs.")


@log.command(help_epilogue="Example: armlab log show run.mcap")
def show(file: Path, *, json: bool = False, parameters: bool = False) -> None:
    """Show what a log holds: rows, rate, columns with units and ranges; of a recording also metadata and events.

    Of a log of another program, an MCAP file or a bag, it shows each topic by itself.

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
    from armlab.cli.log_text import data_of, parameters_data, parameters_text, text_of
    from armlab.cli.output import print_json, result
    from armlab.cli.reading import reading_bar
    from armlab.errors import LogError
    from armlab.log.file_formats.opening import format_at
    from armlab.log.topics.reader import is_foreign

    kind = format_at(file)
    held = logs.inspect(file) if kind in ("MCAP", "") else None  # of no file it says why
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
            tables = logs.read_topics(file, progress=tell)
        else:
            tables = {name or "": logs.read(file, robot=name, progress=tell) for name in robots}
    if json:
        print_json(data_of(file, kind, held, tables))
    else:
        result(text_of(file, kind, held, tables))


@log.command(help_epilogue="Example: armlab log export run.mcap run.mat")
def export(
    file: Path,
    output: Path,
    *,
    robot: str | None = None,
    clock: str | None = None,
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
        Which one, of a recording of several; of a log of another program the arm whose joints it has, or the first part
        of its topics. For .mcap and .rosbag2 the arm of the log, by name or file, if the log does not describe it.
    clock
        Of a log of another program, the topic whose stamps are the rows, as armlab log show lists them.
    storage
        Of a rosbag2: sqlite3 for releases of ROS 2 that are older than Iron.
    force
        Replace an existing file.
    """
    from armlab import log as logs
    from armlab.cli.output import check_output, note, progress, refuse_overwrite, result
    from armlab.log.file_formats.delimited import sidecar_path
    from armlab.log.file_formats.mat import matlab_names
    from armlab.log.topics.reader import names_robots
    from armlab.log.writing import ENDINGS

    check_output(output, force, ENDINGS, [file])
    ending = output.suffix.lower()
    if ending == ".csv":
        refuse_overwrite(sidecar_path(output), force)
    arm = _arm_for(ending, file, robot)
    with progress("export") as tell:
        tell(0, 1, f"reading {file.name}")
        table = logs.read(
            file,
            robot=(robot if arm is None else arm) if names_robots(file) else None,
            clock=clock,
            progress=lambda done, total, _: tell(done, total, f"reading {file.name}"),
        )
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


def _arm_for(ending: str, file: Path, robot: str | None) -> Robot | None:
    """Return the arm whose joints a new file names: as a recording describes it, else the one that is named.

    None for formats without names of joints, and for a bag that keeps the names of another program.
    """
    from armlab import log as logs
    from armlab import robots
    from armlab.log.file_formats.opening import format_at
    from armlab.log.recording.metadata import described
    from armlab.log.topics.reader import is_foreign

    if ending not in (".mcap", ".rosbag2") or (ending == ".rosbag2" and is_foreign(file)):
        return None
    if format_at(file) == "MCAP":
        held = logs.inspect(file)
        names = held.robots if robot is None and len(held.robots) == 1 else (robot or "",)
        arm = described(held.attachments, names[0], str(file))
        if arm is not None:
            return arm
    return None if robot is None else robots.load(robot)


@log.command(help_epilogue="Example: armlab log recover run.mcap")
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


@log.command(help_epilogue="Example: armlab log cut run.mcap --from 10 --to 20 -o part.mcap")
def cut(
    file: Path,
    *,
    from_: Annotated[float | None, Parameter(name="--from")] = None,
    to: float | None = None,
    robot: str | None = None,
    output: Annotated[Path, Parameter(alias="-o")],
    force: bool = False,
) -> None:
    """Write a stretch of a log: the rows with --from <= t < --to. The original stays as it is.

    A recording stays a whole recording: metadata, attachments, the parameters so far, and the events of the stretch.
    Its t is not shifted, so that 12.3 s is the same moment in both.

    Parameters
    ----------
    file
        A recording, finished or not, or a log in another format.
    from_
        Seconds of the table, as armlab log show and the figures have them; from the beginning when not given.
    to
        Seconds of the table; to the end when not given.
    robot
        Which one, of a recording of several: all of them stay in .mcap when not given. Else as in armlab log export.
    output
        The new file: .mcap of a recording; else an ending that armlab log export knows.
    force
        Replace an existing file.
    """
    from armlab import log as logs
    from armlab.cli.output import check_output, progress, result
    from armlab.errors import ConfigError, LogError
    from armlab.log.file_formats.opening import format_at
    from armlab.log.topics.reader import is_foreign, names_robots
    from armlab.log.writing import ENDINGS

    start, stop = (-float("inf") if from_ is None else from_), (float("inf") if to is None else to)
    if not start < stop or (from_, to, robot) == (None, None, None):
        raise ConfigError(f"Expected --from S, --to S or both, the first before the second, got {from_} and {to}.")
    check_output(output, force, ENDINGS, [file])
    with progress("cut") as tell:
        if output.suffix.lower() == ".mcap" and format_at(file) in ("MCAP", "") and not is_foreign(file):
            logs.cut(file, output, start, stop, robot=robot, progress=tell)
        else:
            arm = _arm_for(output.suffix.lower(), file, robot)
            table = logs.read(file, robot=robot if names_robots(file) else None)
            part = table.between(start, stop)
            if not len(part):
                has = f"{table.t[0]:g} s to {table.t[-1]:g} s" if len(table) else "no rows at all"
                raise LogError(f"Expected rows between {start:g} s and {stop:g} s in {file}, got none; it has {has}.")
            logs.write(part, output, arm, progress=tell)
    result(str(output))


@log.command(help_epilogue="Example: armlab log merge first.mcap second.mcap -o both.mcap")
def merge(*file: Path, output: Annotated[Path, Parameter(alias="-o")], force: bool = False) -> None:
    """Write several recordings to one. The originals stay as they are.

    Recordings of one robot are put one after another by their wall clocks, and the gaps between them stay. Recordings
    of both arms of a bridge stand side by side: commands take the rows of the robot that they name, armlab log export
    those of --robot, armlab plot those of --arm.

    Parameters
    ----------
    file
        Two recordings or more, in any order.
    output
        The new file, .mcap.
    force
        Replace an existing file.
    """
    from armlab import log as logs
    from armlab.cli.output import check_output, progress, result

    check_output(output, force, [".mcap"], file)
    with progress("merge") as tell:
        logs.merge(file, output, progress=tell)
    result(str(output))


@log.command(name="open", help_epilogue="Example: armlab log open run.mcap --foxglove")
def open_(file: Path, *, rerun: bool = False, foxglove: bool = False, plotjuggler: bool = False) -> int:
    """Open a recording in another program, if it is installed: Foxglove, PlotJuggler or Rerun.

    Without an option the first of these that is installed. armlab needs none of them: armlab plot and armlab view show
    logs, too. Returns when the program ends.

    Parameters
    ----------
    file
        A finished recording.
    rerun, foxglove, plotjuggler
        Open it there.
    """
    from armlab.cli import FAILED
    from armlab.cli.output import note
    from armlab.cli.viewers import check_finished, chosen, started

    check_finished(file)
    wanted = [name for name, is_on in (("foxglove", foxglove), ("plotjuggler", plotjuggler), ("rerun", rerun)) if is_on]
    viewer, program = chosen(wanted)
    note(f"Opening {file} in {viewer.title}: {program}.{viewer.remark}")
    return FAILED if started(viewer, program, file) else 0
