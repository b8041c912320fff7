"""Input logs of commands, with checks for logs of another robot and for implausible data."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import armlab
from armlab.cli.support.output import note, progress
from armlab.errors import ModelMismatchError, NotExcited, ShapeError

if TYPE_CHECKING:
    from armlab.log import Table
    from armlab.log.file_formats.description import Progress
    from armlab.log.recording.metadata import Inspection
    from armlab.models import TorqueModel
    from armlab.robots import Robot

BAND = 5.0  # Hz, band for comparing velocity with the derivative of position
SHORTEST = 100  # rows
LARGE = 50_000_000  # bytes; reading a larger log takes seconds
FEW = 0.01  # maximum fraction of rows that a fit may skip
LOST = 1.5  # steps above this multiple of the median are gaps


@contextmanager
def reading_bar(path: Path) -> Iterator[Progress | None]:
    """Show a progress bar while the block reads a large log; yields the callback for `log.read`, or None."""
    files = [path] if path.is_file() else [one for one in path.glob("*") if one.is_file()]
    if not sys.stderr.isatty() or sum(one.stat().st_size for one in files) < LARGE:
        yield None
        return
    with progress("reading") as tell:
        yield lambda done, total, _: tell(done, max(total, 1), path.name)


def read_log(path: Path, robot: Robot, force: bool = False, columns: str | None = None, *, fit: bool = False) -> Table:
    """Return the log with q, qd and tau; a missing velocity is computed from the positions.

    `columns` specifies any non-standard column names. With `fit`, a few incomplete rows are skipped.
    """
    with reading_bar(path) as tell:
        table = armlab.log.read_arm(path, robot, tell, force=force, columns=columns)
    for line in table.notes if columns else ():
        note(f"{path.name}: {line}")
    needed = [name for name in ("q", "qd", "tau") if name in table] if fit else ["q"] if "qd" not in table else []
    if needed:
        table = _whole_rows(table, needed, path)
    return armlab.identify.with_velocity(table)


def _whole_rows(table: Table, names: list[str], path: Path) -> Table:
    """Return the table without its incomplete rows if there are only a few; empty rows count as lost."""
    values = np.hstack([table[name] for name in names])
    lost = np.asarray(~np.isfinite(values).all(axis=1))
    some = lost & np.isfinite(values).any(axis=1)
    if not some.any() or np.count_nonzero(lost) > FEW * len(table):
        return table
    rows = ", ".join(str(row) for row in np.flatnonzero(some)[:5])
    said = f"{np.count_nonzero(some)} of {len(table)} rows of {path.name}"
    note(f"{said} have missing values and are skipped; first rows: {rows}")
    return table.rows(np.logical_not(lost))


@contextmanager
def by_force(force: bool) -> Iterator[None]:
    """Add advice about --force to a robot-mismatch error raised in the block; with `force`, only print the error."""
    try:
        yield
    except ModelMismatchError as error:
        if not force:
            said = str(error)
            more = "" if "--force" in said else ", or add --force to continue."
            raise ModelMismatchError(said.rstrip(".") + more if more else said) from None
        note(str(error))


def check_log(path: Path, whose: Robot | TorqueModel, force: bool = False) -> None:
    """Reject a recording made with a different robot description; only MCAP files name their robot."""
    from armlab.log.file_formats.opening import format_at
    from armlab.log.recording.metadata import check_recorded, described
    from armlab.robots import Robot

    if not path.is_file() or format_at(path) != "MCAP":
        return
    held = armlab.log.inspect(path)
    with by_force(force):
        if isinstance(whose, Robot):
            check_recorded(held, whose)
        else:
            names = list(_recorded(held))
            name = names[0] if len(names) == 1 else whose.robot_name
            if (recorded := described(held.attachments, name, str(path))) is not None:
                whose.check_robot(recorded)


def _recorded(held: Inspection) -> dict[str, str]:
    """Return the robot hashes of a recording, keyed by robot name."""
    return {pairs["robot"]: pairs.get("robot_hash", "") for pairs in held.metadata.values() if pairs.get("robot")}


_TAUGHT = "taught on "  # followed by robot and hash, in the sources of a joint-space primitive


def taught_on(path: Path, robot: Robot | None) -> tuple[str, ...]:
    """Return the line that names the robot of a demonstration: the given robot, or the robot of the recording."""
    from armlab.log.file_formats.opening import format_at

    if robot is not None:
        return (f"{_TAUGHT}{robot.name} {robot.hash}",)
    if not path.is_file() or format_at(path) != "MCAP":
        return ()
    known = _recorded(armlab.log.inspect(path))
    return tuple(f"{_TAUGHT}{name} {digest}" for name, digest in known.items() if digest and len(known) == 1)


def check_taught(path: Path, robot: Robot, force: bool = False) -> None:
    """Reject a joint-space primitive taught on an arm with another description."""
    from armlab.models.files import sources_of
    from armlab.robots.comparison import check_same

    advice = "Teach the motion on this robot, or add --force to continue."
    for entry in sources_of(path):
        if not entry.startswith(_TAUGHT):
            continue
        name, _, digest = entry.removeprefix(_TAUGHT).rpartition(" ")
        with by_force(force):
            check_same(robot, f"the primitive {path}", name, digest, None, advice)


def model_for(path: Path, robot: Robot, force: bool = False) -> TorqueModel:
    """Return the torque model in a file; reject (with `force`: adapt) a model with another robot description."""
    model: TorqueModel = armlab.models.load(path, "torque_model")
    with by_force(force):
        model.check_robot(robot)
        return model
    return model.moved_to(robot)


def doubts(table: Table, robot: Robot, model: TorqueModel | None = None) -> tuple[str, ...]:
    """Return errors for velocities that are not the derivatives of the positions, and for implausible torques.

    `identify.prepare` rejects logs with these errors. Logs for estimation may contain periods at rest, so this check
    uses only the motion in the longest segment without a gap. The table has q, qd and tau (N, n).
    """
    from armlab.log.units_check import check_torque, check_velocity, has_moved
    from armlab.signals import lowpass_offline

    rows = _longest_stretch(table)
    if rows.stop - rows.start < SHORTEST:
        return ()
    t, q, qd, tau = table.t[rows], table["q"][rows], table["qd"][rows], table["tau"][rows]
    moved = has_moved(q, robot)
    known = np.isfinite(model.quality.rms_cv) if model is not None else moved
    measured = moved & known if known.any() else moved
    rate = 1.0 / float(np.median(np.diff(t)))
    slope, speed = (lowpass_offline(x, rate, min(BAND, 0.2 * rate)) for x in (np.gradient(q, t, axis=0), qd))
    found = []
    for check in (lambda: check_velocity(slope, speed, moved, robot), lambda: check_torque(q, tau, measured, robot)):
        try:
            check()
        except (NotExcited, ShapeError) as error:
            found.append(str(error))
    return tuple(found)


def gaps(table: Table) -> list[tuple[float, float]]:
    """Return the start time and the length of each gap [s]; a gap is a step longer than 1.5 times the median step."""
    steps = np.diff(table.t)
    after = np.flatnonzero(steps > LOST * np.median(steps)) if len(steps) else []
    return [(float(table.t[k]), float(steps[k])) for k in after]


def left_out(table: Table) -> int:
    """Return the number of rows without an estimate because of non-finite values."""
    return int(np.count_nonzero(table["wrench_flags"] & armlab.contact.INVALID))


def _longest_stretch(table: Table) -> slice:
    """Return the rows of the longest segment without missing values."""
    whole = np.isfinite(np.hstack([table[name] for name in ("q", "qd", "tau")])).all(axis=1)
    step = np.diff(table.t)
    apart = step > LOST * np.median(step) if len(step) else np.zeros(0, dtype=bool)
    cuts = np.flatnonzero(~whole)
    edges = np.unique(np.concatenate([[0, len(table)], cuts, cuts + 1, np.flatnonzero(apart) + 1]).astype(int))
    if len(edges) < 2:
        return slice(0, 0)
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]), int(edges[longest + 1]))
