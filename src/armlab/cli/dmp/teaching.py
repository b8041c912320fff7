"""Fit movement primitives of all kinds to demonstrations in logs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import armlab
from armlab.cli.support.options import load_robot
from armlab.cli.support.output import aligned
from armlab.errors import ConfigError, UnknownName

if TYPE_CHECKING:
    from armlab.estimation import Fit
    from armlab.log import Table

KINDS: dict[str, tuple[str, ...]] = {
    "joints": ("basis", "schedule", "scaling", "convention", "robot"),
    "pose": ("basis", "schedule", "scaling", "convention", "frame", "robot"),
    "periodic": ("basis", "period", "robot"),
    "promp": ("basis", "robot"),
}
"""Options of `armlab dmp fit` for each kind of primitive."""
POSES = "T_base_tool"
MOVES = 0.02  # slowest motion, relative to the largest speed
STILL = 2e-3  # rad/s or m/s, velocity noise at rest
MARGIN = 0.1  # s of standstill that is kept at both ends


@dataclass(frozen=True)
class Demonstration:
    """Times t (N,) with positions (N, n) or poses (N, 4, 4) from a log, and the sources to store with a fit."""

    t: np.ndarray
    y: np.ndarray
    sources: tuple[str, ...]


@dataclass(frozen=True)
class MotionWindow:
    """Segment of a log from `start` to `end` [s], without the standstill before and after the motion unless `whole` is
    set."""

    start: float | None = None
    end: float | None = None
    whole: bool = False

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ConfigError(f"Expected --{name} to be a time in the log [s], got {value:g}.")


def check_options(kind: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that have a value; reject options that do not apply to this kind of primitive."""
    if kind not in KINDS:
        raise UnknownName.among("kind of primitive", kind, KINDS)
    chosen = {name: value for name, value in given.items() if value is not None}
    for name in chosen:
        if name not in KINDS[kind]:
            having = " or ".join(k for k, options in KINDS.items() if name in options)
            raise ConfigError(f"Expected --{name} with --kind {having}, got --kind {kind}. Omit --{name}.")
    if kind == "periodic" and "period" not in chosen:
        raise ConfigError(
            "Expected --period SECONDS (duration of one period) with --kind periodic, got no period. Add --period."
        )
    return chosen


def read_demonstration(
    path: Path,
    kind: str,
    columns: Sequence[str],
    robot: str | None,
    window: MotionWindow,
    where: str | None = None,
    force: bool = False,
) -> Demonstration:
    from armlab.cli.support.log_input import check_log, taught_on
    from armlab.log.topics.reader import is_foreign, read_joints

    arm, foreign = None if robot is None else load_robot(robot), is_foreign(path)
    if foreign and arm is None and kind != "pose" and "q" in (columns or ("q",)):
        raise ConfigError(
            f"Expected --robot NAME with {path}, got no robot. The robot defines the joint order of a log that was not "
            "recorded by armlab."
        )
    if arm is not None and not foreign:
        check_log(path, arm, force)
    if arm is not None and where is not None:
        table = armlab.log.read_arm(path, arm, columns=where, needed=("q",), force=force)
    else:
        table = armlab.log.read(path, where) if arm is None or not foreign else read_joints(path, arm)
    if kind == "pose" and arm is not None:
        table = table.with_column(POSES, armlab.kinematics.forward(arm, table["q"]))
    elif kind == "pose" and not columns and POSES not in table:
        raise ConfigError(
            f"Expected tool poses in {path}, column {POSES}, got {', '.join(table.names)}. "
            "Add --robot NAME to compute the poses from q, or select their column with --column."
        )
    names = columns or ((POSES,) if kind == "pose" else ("q",))
    start = -np.inf if window.start is None else window.start
    part = table.between(start, np.inf if window.end is None else window.end)
    y = _side_by_side(part, names)
    rows = slice(None) if window.whole else _moving(part.t, y, f"{' '.join(names)} of {path}")
    sources = [source for source in table.source if "sha256" in source]
    if tuple(names) == ("q",):
        sources += taught_on(path, arm)
    return Demonstration(part.t[rows], y[rows], tuple(sources))


def taught(kind: str, demos: Sequence[Demonstration], options: Mapping[str, Any]) -> Fit[Any]:
    given = {("n_basis" if name == "basis" else name): value for name, value in options.items() if name != "robot"}
    if kind in ("pose", "periodic"):
        if len(demos) > 1:
            raise ConfigError(f"Expected one log with --kind {kind}, got {len(demos)}. Fit a primitive to each log.")
        fit = armlab.motion.fit_pose_dmp if kind == "pose" else armlab.motion.fit_periodic_dmp
        return fit(demos[0].t, demos[0].y, **given)
    t, y = [demo.t for demo in demos], [demo.y for demo in demos]
    if kind == "promp":
        return armlab.motion.fit_promp(t, y, **given)
    return armlab.motion.fit_dmp(t if len(t) > 1 else t[0], y if len(y) > 1 else y[0], **given)


def numbers_of(kind: str, found: Fit[Any], demos: int) -> dict[str, Any]:
    value = found.value
    told = {"kind": kind, "demonstrations": demos, "samples": found.n}
    told["rms"] = np.sqrt((found.residuals**2).mean(axis=0))
    if kind == "periodic":
        return told | {"period": value.period, "kernels": len(value.centres), "baseline": value.g}
    told |= {"duration": value.duration}
    if kind == "promp":
        sd = value.marginal(np.array([0.0, value.duration])).sd
        return told | {"kernels": len(value.centres), "start_sd": sd[0], "goal_sd": sd[1]}
    if kind == "pose":
        return told | {"kernels": value.position.n_basis, "start": value.T_start, "goal": value.T_goal}
    return told | {"kernels": value.n_basis, "start": value.y0, "goal": value.g, "unscaled": list(value.unscaled)}


def text_of(kind: str, found: Fit[Any], demos: int) -> str:
    told, value = numbers_of(kind, found, demos), found.value
    shown = "1 demonstration" if demos == 1 else f"{demos} demonstrations"
    length = f"periods of {value.period:.2f} s" if kind == "periodic" else f"{value.duration:.2f} s"
    size = 6 if kind == "pose" else value.n
    count = "" if kind == "promp" else f" with {found.n} samples"
    head = f"{kind}: {length} of {size} coordinates from {shown}{count}; {told['kernels']} kernels"
    names = ("x", "y", "z", "turn x", "turn y", "turn z") if kind == "pose" else [str(i + 1) for i in range(size)]
    keys = {"joints": ("start", "goal"), "periodic": ("baseline",), "promp": ("start_sd", "goal_sd"), "pose": ()}[kind]
    columns: dict[str, Sequence[float]] = {key.removesuffix("_sd"): told[key] for key in keys}
    titles = [f"SD of {name}" if kind == "promp" else name for name in columns]
    rows = [("coordinate", *titles, "motion error (RMS)")]
    rows += [
        (name, *(f"{values[i]:.4f}" for values in columns.values()), f"{told['rms'][i]:.2e}")
        for i, name in enumerate(names)
    ]
    return f"{head}\n{aligned(rows, right=range(1, len(rows[0])))}"


def _side_by_side(table: Table, names: Sequence[str]) -> np.ndarray:
    parts = [table[name] for name in names]
    if len(parts) == 1 and parts[0].ndim > 1:
        return parts[0]
    return np.column_stack([part.reshape(len(table), -1) for part in parts])


def _moving(t: np.ndarray, y: np.ndarray, what: str) -> slice:
    """Return the rows of the motion with a stationary margin at both ends."""
    if len(t) < 3:
        return slice(None)
    speed = np.abs(np.gradient(y, t, axis=0)).reshape(len(t), -1).max(axis=1)
    moving = np.flatnonzero(speed > max(MOVES * np.nanmax(speed), STILL))
    if not len(moving):
        raise ConfigError(f"Expected a motion in {what}, got an arm at rest. Choose another log or column.")
    first, last = np.searchsorted(t, (t[moving[0]] - MARGIN, t[moving[-1]] + MARGIN))
    return slice(int(first), int(last))
