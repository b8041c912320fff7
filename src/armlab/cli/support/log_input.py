"""The log that a command reads: refused without torques or of another robot; doubts about implausible data."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import armlab
from armlab.cli.support.output import progress
from armlab.errors import NotExcited, ShapeError

if TYPE_CHECKING:
    from armlab.log import Table
    from armlab.log.file_formats.description import Progress
    from armlab.models import TorqueModel
    from armlab.robots import Robot


BAND = 5.0  # Hz, in which velocity is compared with the slope of position
SHORTEST = 100  # rows
LARGE = 50_000_000  # bytes, which take longer than a glance to read
LOST = 1.5  # median steps: a longer one lacks rows


@contextmanager
def reading_bar(path: Path) -> Iterator[Progress | None]:
    """Show a bar on a terminal while the block reads a large log; yields what `log.read` tells, None without a bar."""
    files = [path] if path.is_file() else [one for one in path.glob("*") if one.is_file()]
    if not sys.stderr.isatty() or sum(one.stat().st_size for one in files) < LARGE:
        yield None
        return
    with progress("reading") as tell:
        yield lambda done, total, _: tell(done, max(total, 1), path.name)


def read_log(path: Path, robot: Robot) -> Table:
    """Return the log with q, qd and tau; where it has no velocity that is the slope of the position."""
    with reading_bar(path) as tell:
        return armlab.identify.with_velocity(armlab.log.read_arm(path, robot, tell))


def doubts(table: Table, robot: Robot, model: TorqueModel | None = None) -> tuple[str, ...]:
    """Return what of a log cannot be true: velocity that is not the slope of position, torques of the motors.

    `identify.prepare` refuses such logs. One that is only estimated may rest, so it is looked at where it moves, in its
    longest stretch without a gap. `contact.Estimator.run` has refused what is worse.

    `table`: with q, qd, tau (N, n).
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
    """Return (time of the row before, length) of each gap [s]: a step longer than one and a half of the usual."""
    steps = np.diff(table.t)
    after = np.flatnonzero(steps > LOST * np.median(steps)) if len(steps) else []
    return [(float(table.t[k]), float(steps[k])) for k in after]


def left_out(table: Table) -> int:
    """Return how many rows are not finite and have no estimate."""
    return int(np.count_nonzero(table["wrench_flags"] & armlab.contact.INVALID))


def _longest_stretch(table: Table) -> slice:
    """Return the rows of the longest stretch in which nothing is missing."""
    whole = np.isfinite(np.hstack([table[name] for name in ("q", "qd", "tau")])).all(axis=1)
    step = np.diff(table.t)
    apart = step > LOST * np.median(step) if len(step) else np.zeros(0, dtype=bool)
    cuts = np.flatnonzero(~whole)
    edges = np.unique(np.concatenate([[0, len(table)], cuts, cuts + 1, np.flatnonzero(apart) + 1]).astype(int))
    if len(edges) < 2:
        return slice(0, 0)
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]), int(edges[longest + 1]))
