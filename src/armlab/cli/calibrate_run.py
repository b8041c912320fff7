"""How every calibration runs: files read, rows that were measured, the fit, what is wanted of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armlab.errors import ConfigError, LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.cli.calibrate_input import Samples
    from armlab.cli.calibrate_report import Wanted

_DEGREES = 20.0  # rad that no joint turns

__all__ = ["measured_rows", "noise_of", "run_fit", "tool_poses"]


def run_fit(
    job: str,
    files: Sequence[Path],
    parts: Callable[[Samples], tuple[np.ndarray, ...]],
    fit: Callable[..., Any],
    wanted: Wanted,
    sources: Sequence[str] = (),
) -> int:
    """Read files of samples, fit all of them together, and write what is wanted; return the exit code.

    Parameters
    ----------
    job : for the title. files : of samples. parts : takes arrays with as many rows each out of one file.
    fit : takes these parts, files behind each other. wanted : of the result. sources : of other files that it needs.

    Raises
    ------
    ConfigError : no file, or one twice. LogError : files that cannot be read, or measured something else.
    """
    import numpy as np

    from armlab.cli.calibrate_input import read_samples

    wanted.check()
    if not files:
        raise ConfigError("Expected files of samples, got none. Give one or more CSV, MAT or MCAP files.")
    read = [read_samples(path) for path in files]
    hashes = [one.source.rsplit(" ", 1)[-1] for one in read]
    twice = next((one.path for i, one in enumerate(read) if hashes[i] in hashes[:i]), None)
    if twice is not None:
        raise ConfigError(f"Expected different files, got {twice} again. Samples count once: leave it out.")
    found = [parts(one) for one in read]
    for part in zip(*found, strict=True):
        widths = {array.shape[1:] for array in part}
        if len(widths) > 1:
            shapes = ", ".join(f"{array.shape} in {one.path.name}" for one, array in zip(read, part, strict=True))
            raise LogError(f"Expected files that measured the same, got arrays of {shapes}. Calibrate them one by one.")
    joined = [np.concatenate(part) for part in zip(*found, strict=True)]
    wanted.write(job, fit(*joined), (*(one.source for one in read), *sources))
    return 0


def measured_rows(
    read: Samples, needed: Sequence[np.ndarray], some: Sequence[np.ndarray] = (), *, every: bool = False
) -> tuple[np.ndarray, ...]:
    """Return the rows in which something was measured; recordings have rows between the samples of a sensor.

    Parameters
    ----------
    read : the file, for messages. needed : arrays (N, ...) of which a row has all. some : of which it has at least one.
    every : rows without any of `some` count too.

    Returns
    -------
    The rows of `needed`, of `some`, and their numbers in the file.

    Raises
    ------
    LogError : numbers of rows that differ; no such rows.
    """
    import numpy as np

    from armlab.cli.output import note

    parts = [*needed, *some]
    lengths = [len(part) for part in parts]
    if len(set(lengths)) > 1:
        raise LogError(f"Expected as many samples of each kind in {read.path}, got {', '.join(map(str, lengths))}.")
    seen = [~np.isnan(part).all(axis=tuple(range(1, part.ndim))) for part in parts]
    there = np.all(seen[: len(needed)], axis=0)
    if some and not every:
        there &= np.any(seen[len(needed) :], axis=0)
    if not there.any():
        raise LogError(f"Expected rows in which all was measured in {read.path}, got none of {len(there)}.")
    _require_whole(read, needed, there)
    if not there.all():
        without = np.count_nonzero(~there)
        note(f"{without} of {len(there)} rows of {read.path.name} have no measurement and do not count")
    if not every:
        there &= _first_times(read, needed, some, there)
    return (*(part[there] for part in parts), np.flatnonzero(there))


def _require_whole(read: Samples, needed: Sequence[np.ndarray], there: np.ndarray) -> None:
    """Refuse rows with some of the numbers of a pose or a vector, by their place in the file; points may be hidden."""
    import numpy as np

    for part in needed:
        if part.ndim == 2 or part.shape[1:] == (4, 4):
            bad = np.flatnonzero(there & np.isnan(part).any(axis=tuple(range(1, part.ndim))))
            if len(bad):
                raise LogError(
                    f"Expected whole samples in {read.path}, got numbers missing in {len(bad)} of {len(there)} rows, "
                    f"first in row {bad[0]} (from 0). Empty all of the measurement of such a row, or mend it."
                )


def _first_times(
    read: Samples, needed: Sequence[np.ndarray], some: Sequence[np.ndarray], there: np.ndarray
) -> np.ndarray:
    """Return which rows (N,) are no copy of an earlier one: the same sample twice tells nothing new of the noise."""
    import numpy as np

    from armlab.cli.output import note

    flat = [np.ascontiguousarray(part.reshape(len(part), -1), dtype=float) for part in (*needed, *some)]
    numbers, name = np.flatnonzero(there), read.path.name
    first = np.zeros(len(there), dtype=bool)
    seen: set[bytes] = set()
    for i in numbers:
        row = b"".join(part[i].tobytes() for part in flat)
        first[i] = row not in seen
        seen.add(row)
    if len(seen) < len(numbers):
        note(f"{len(numbers) - len(seen)} of {len(numbers)} rows of {name} are copies of others and count once")
    kept = np.flatnonzero(first)
    for part in flat[len(needed) if some else 1 :]:
        if part.shape[1] >= 3:
            held = np.count_nonzero((part[kept][1:] == part[kept][:-1]).all(axis=1))
            if held:
                note(f"{held} rows of {name} repeat the measurement of the row before: held values?")
    return first


def noise_of(values: Sequence[float] | None) -> Any:
    """Return the deviations as the fits take them: None, one number, or a tuple."""
    return None if values is None else values[0] if len(values) == 1 else tuple(values)


def tool_poses(read: Samples, robot: str | None) -> np.ndarray:
    """Return T_base_tool (N, 4, 4) as it was recorded, or of the joint positions of the arm.

    Parameters
    ----------
    read : the file. robot : name or file of the arm; None for recorded poses.

    Raises
    ------
    LogError : neither is in the file, or the joint positions are in degrees.
    """
    if robot is None:
        return read.poses("T_base_tool")
    import numpy as np

    from armlab import robots
    from armlab.kinematics import forward

    arm = robots.load(robot)
    q = read.vectors("q", (arm.n,))
    far = np.nanmax(np.abs(q[:, ~arm.prismatic]), initial=0.0)
    if far > _DEGREES:
        raise LogError(
            f"Expected joint angles q in radians in {read.path}, got up to {far:.4g}. These seem to be degrees: write "
            "their unit into the header, q1 [deg]."
        )
    return forward(arm, q)
