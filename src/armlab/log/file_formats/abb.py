"""Logs of ABB controllers: test signals in text files (`read_abb`), and motor signals of orca or ExtCtrl (`from_orca`).

`read_abb` uses the signal numbers of RAPID's ``TestSignDefine channel, signal, unit, axis, time``. Signals 4000
(position), 4001 (speed), 4002 (torque) and 4003 (external torque) are arm-side values of an axis (ABB's manual, as
quoted in ros-industrial/abb_libegm, issue 86). Columns of other signals are named by signal number.
docs/how_to/exchange_logs.md shows an example map.

Logs of orca and ExtCtrl have one column per motor signal, such as ``irb2ext.robot[0].joint[2].posRawAbs``, the angle of
a motor. Motors are numbered in ABB's axis order. `read_csv` reads the output of lc2csv, and `read_labcomm` reads the
LabComm stream. Older names, with ``_`` in place of ``. [ ]``, are also accepted.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from armlab import glossary, robots
from armlab._files import parsed
from armlab.errors import ConfigError, LogError, RobotError, ShapeError, UnknownName
from armlab.log.column import Column, alias
from armlab.log.file_formats.delimited import rows_of
from armlab.log.file_formats.description import labelled_table
from armlab.log.file_formats.opening import is_text, origin
from armlab.log.table import Table
from armlab.robots import Robot
from armlab.robots.couplings import abb_to_logical, motor_to_joint, motor_torque_to_joint

SIGNALS = {4000: "q", 4001: "qd", 4002: "tau", 4003: "tau_ext"}
UNITS = {"q": ("deg", "mm"), "qd": ("deg/s", "mm/s"), "tau": ("N m", "N"), "tau_ext": ("N m", "N")}  # rotary, linear


class _Signal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    signal: int
    axis: int = 1
    arm: str = ""


class _Map(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    columns: dict[str, _Signal]
    arm: str = ""
    time: str = ""
    time_unit: str = "s"
    rate: float | None = None
    separator: str = ","
    header: bool = True
    skip: int = 0


def read_abb(path: str | Path, map: str | Path, arm: str | None = None, *, raw: bool = False) -> Table:
    """Read a text file of ABB test signals and return them in SI units and kinematic joint order.

    Degrees, millimetres and ABB's axis order are converted; axes that were not logged are missing (NaN). If the
    controller measures an axis relative to the base (IRB 2400), q still contains joint positions.

    Parameters
    ----------
    path : text file, one line per sample.
    map : TOML file. ``[columns]`` maps each label to a signal, an axis and an arm. ``time`` is the label of the clock
        and ``time_unit`` its unit; ``rate`` [Hz] replaces a missing clock. ``separator`` is one character; a space
        matches any number of spaces. ``skip`` is the number of lines to skip at the start. ``header = false`` declares
        a file without labels, whose columns are "1", "2", .... ``arm`` sets the arm for all signals.
    arm : arm to select if the map has several arms; a library name or a robot file.
    raw : keep rows with non-increasing time; default: drop them, with a note and a warning.

    Returns
    -------
    Table : available columns of q, qd, tau and tau_ext (N, n); signal_<number>_axis_<axis> (N,) for every other signal.

    Raises
    ------
    LogError : the file is not text (for example, an ABB binary file), lacks a label or a clock, or contains a
        non-numeric value.
    ConfigError : the map is invalid, names no arm, or contains an axis that the arm does not have.
    UnknownName : `arm` is not in the map.
    """
    path, map = Path(path), Path(map)
    about = _read_map(map)
    if path.is_file() and not is_text(path):
        raise LogError(
            f"Expected a text file at {path}, got a binary file. "
            "Export text from ABB's signal viewer, the only program that can read its binary files."
        )
    robot, signals = _of_arm(about, map, arm)
    fields = _fields(path, about)
    arrays: dict[str, tuple[np.ndarray, str]] = {}
    if about.time:
        arrays["t"] = (_numbers(path, about, fields, about.time), about.time_unit)
    for label, one in signals.items():
        name = f"signal_{one.signal}_axis_{one.axis}"
        if name in arrays:
            raise ConfigError(
                f"Expected each signal of an axis exactly once in {map}, got {name} twice. Correct the map."
            )
        arrays[name] = (_numbers(path, about, fields, label), _unit(one, robot, map))
    return _joined(labelled_table(path, arrays, rate=about.rate, raw=raw), robot, map)


def _read_map(path: Path) -> _Map:
    try:
        about = msgspec.convert(parsed(path.read_text(encoding="utf-8")), _Map)
    except OSError as error:
        raise ConfigError(f"Expected a map of the columns at {path}, got: {error.strerror}.") from None
    except (ValueError, msgspec.ValidationError) as error:
        raise ConfigError(f"Expected a map of the columns in {path}, got: {str(error).rstrip('.')}.") from None
    if bool(about.time) == (about.rate is not None) or len(about.separator) != 1 or about.skip < 0:
        raise ConfigError(
            f"Expected either time or rate, one character as separator and skip >= 0 in {path}, got time "
            f"{about.time!r}, rate {about.rate}, {about.separator!r} and {about.skip}. Correct the map."
        )
    return about


def _of_arm(about: _Map, path: Path, arm: str | None) -> tuple[Robot, dict[str, _Signal]]:
    arms = {label: one.arm or about.arm for label, one in about.columns.items()}
    names = sorted(set(arms.values()))
    if not all(names) or not names:
        raise ConfigError(
            f"Expected an arm for every column of {path}, but some columns have none. "
            'Add the arm to the map: arm = "yumi_left".'
        )
    if arm is None and len(names) > 1:
        raise ConfigError(
            f"Expected the name of one arm (arm=) for {path}, which contains the arms {', '.join(names)}."
        )
    if arm is not None and arm not in names:
        raise UnknownName.among("arm of the map", arm, names)
    chosen = arm or names[0]
    return robots.load(chosen), {label: one for label, one in about.columns.items() if arms[label] == chosen}


def _unit(one: _Signal, robot: Robot, path: Path) -> str:
    name = SIGNALS.get(one.signal)
    if name is None:
        return "1"
    if not 1 <= one.axis <= robot.n:
        raise ConfigError(f"Expected an axis from 1 to {robot.n} of {robot.name!r} in {path}, got {one.axis}.")
    return UNITS[name][bool(robot.prismatic[robot.abb_axes.index(one.axis)])]


def _fields(path: Path, about: _Map) -> dict[str, list[str]]:
    """Return the strings of each column, keyed by label (without labels, by number from 1)."""
    rows = rows_of(path, about.separator)[about.skip :]
    if about.separator == " ":
        rows = [[field for field in row if field] for row in rows]
    while rows and not any(rows[-1]):
        rows.pop()
    labels = [label.strip() for label in rows[0]] if rows and about.header else []
    rows = rows[about.header :]
    if not rows:
        raise LogError(f"Expected lines of numbers in {path}, got none after the first {about.skip}. Correct the map.")
    labels = labels or [str(number) for number in range(1, len(rows[0]) + 1)]
    for number, row in enumerate(rows, start=1 + about.skip + about.header):
        if len(row) != len(labels):
            raise LogError(
                f"Expected {len(labels)} fields in line {number} of {path}, got {len(row)}. Correct this line."
            )
    return dict(zip(labels, (list(column) for column in zip(*rows, strict=True)), strict=True))


def _numbers(path: Path, about: _Map, fields: dict[str, list[str]], label: str) -> np.ndarray:
    if label not in fields:
        raise LogError(f"Expected a column {label!r} in {path}, as stated in the map, got {', '.join(fields)}.")
    try:
        return np.array([field.strip() or "nan" for field in fields[label]], dtype=float)
    except ValueError as error:
        raise LogError(f"Expected numbers in the column {label!r} of {path}, got: {error}.") from None


def _joined(table: Table, robot: Robot, path: Path) -> Table:
    """Assemble the axes of each signal in the arm's axis order, then convert them to joint values."""
    # On the arm side of the gears, the only remaining coupling comes from a rod that moves two joints.
    behind = replace(robot, coupling=robot.coupling / np.diag(robot.coupling))
    values: dict[str, Any] = {}
    columns: dict[str, Column] = {}
    for signal, name in SIGNALS.items():
        axes = [f"signal_{signal}_axis_{axis}" for axis in range(1, robot.n + 1)]
        if any(axis in table for axis in axes):
            empty = np.full(len(table), np.nan)
            ordered = abb_to_logical(robot, np.stack([table.values.get(axis, empty) for axis in axes], axis=1))
            to_joint = motor_torque_to_joint if name.startswith("tau") else motor_to_joint
            values[name] = to_joint(behind, ordered)
            unit, frame = (None, None) if name in glossary.columns() else ("N m", "joint")
            columns[name] = Column(unit=unit, frame=frame, labels=robot.joint_names)
            table = table.without(*(axis for axis in axes if axis in table))
    source = (table.source[0], f"read_abb({robot.name}, {origin(path)})")
    return replace(table, values={**values, **table.values}, columns={**columns, **table.columns}, source=source)


MOTOR_SIGNALS = {"q": ("rad", ["posRawAbs"]), "qd": ("rad/s", ["velFlt", "velRaw"]), "tau": ("N m", ["trqRaw"])}


def from_orca(table: Table, robot: Robot, arm: int) -> Table:
    """Return q, qd and tau of one arm: ``q = G q_motor``, ``qd = G qd_motor``, ``tau = G⁻ᵀ tau_motor``.

    The axes are reordered before the gear matrix G is applied; both steps preserve power. The velocity is velFlt if
    logged, otherwise velRaw.

    Parameters
    ----------
    table : table of `read_csv` or `read_labcomm`.
    robot : robot with axis order and gears.
    arm : index of the arm in the file, counted from 0, as in robot[0] and robot[1].

    Returns
    -------
    Table : available columns of q (N, n) [rad], qd [rad/s] and tau [N m], on the same clock.

    Raises
    ------
    LogError : positions of this arm are missing (the message lists the available arms), a joint is missing, or a motor
        unit is wrong.
    ShapeError, RobotError : `table` is not a table, `robot` is not a `Robot`.

    Reference: Robotlib.jl, src/read_log.jl and README. Robotlib's ``q GR⁻ᵀ`` applies ``G⁻¹`` to torques and agrees with
    these formulas only for gears without coupling.
    """
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    values = {}
    for name, (unit, signals) in MOTOR_SIGNALS.items():
        blocks = [_motors(table, robot, arm, signal, unit) for signal in signals]
        found = [block for block in blocks if block is not None]
        if found:
            motors = abb_to_logical(robot, found[0])
            values[name] = motor_torque_to_joint(robot, motors) if name == "tau" else motor_to_joint(robot, motors)
    if "q" not in values:
        arms = sorted({match[1] for name in table.names if (match := re.search(r"robot_(\d+)__joint_", alias(name)))})
        have = f"arms {', '.join(arms)}" if arms else f"columns {', '.join(table.names[:5])}, ..."
        raise LogError(f"Expected columns robot[{arm}].joint[0].posRawAbs and so on, got {have}. Pass another arm.")
    columns = {name: Column(labels=robot.joint_names) for name in values}
    source = (*table.source, f"from_orca({robot.name}, arm {arm})")
    return replace(table, values=values, columns=columns, source=source)


def _motors(table: Table, robot: Robot, arm: int, signal: str, unit: str) -> np.ndarray | None:
    """Return the signal (N, n) of all motors in ABB's order, or None; axes beyond n are external."""
    pattern = re.compile(rf"(?:^|_)robot_{re.escape(str(arm))}__joint_(\d{{1,3}})__{signal}$")
    found: dict[int, str] = {}
    for name in table.names:
        match = pattern.search(alias(name))
        if match and int(match[1]) < robot.n:
            if int(match[1]) in found:
                raise LogError(
                    f"Expected one {signal} per joint, got {found[int(match[1])]} "
                    f"and {name}. Drop one of these columns."
                )
            found[int(match[1])] = name
    if not found:
        return None
    missing = [joint for joint in range(robot.n) if joint not in found]
    if missing:
        raise LogError(
            f"Expected {signal} of {robot.n} joints of robot[{arm}] for {robot.name!r}, but joints {missing} are "
            "missing. Pass the robot that was logged."
        )
    for name in found.values():
        if table.units[name] not in ("1", unit):
            raise LogError(f"Expected motor values in {unit} in {name}, got {table.units[name]}. Convert the values.")
    return np.stack([table[found[joint]] for joint in range(robot.n)], axis=1)
