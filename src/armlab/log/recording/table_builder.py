"""`Log` and `Tail`: tables that grow in memory, row by row."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab._numbers import positive
from armlab.errors import LogError
from armlab.log.assembly import recording_table
from armlab.log.column import OLD_NAMES, Column
from armlab.log.recording.file import RecordingFile, recording_path
from armlab.log.recording.rows import RowLayout, Tick
from armlab.log.table import Table
from armlab.state import Command, State

if TYPE_CHECKING:
    from armlab.robots import Robot

_TAIL_RATE = 500.0  # rows per second a Tail has room for; EGM's fastest is 250
_TAIL_ROWS = 1 << 40  # more than any memory


class Log:
    """Log in memory that grows without copying: the standard columns and the user's.

    Parameters
    ----------
    robot : gives the joints.
    extra : the user's columns, name -> `Column` with shape, unit and frame.

    Examples
    --------
    >>> log = Log(robot, extra={"fext": Column(shape=(6,), unit="N", frame="base")})
    >>> log.push(t=0.0, q=q, fext=f)
    >>> log.table()["fext"]
    """

    def __init__(self, robot: Robot, extra: Mapping[str, Column] | None = None) -> None:
        self._robot = robot
        self._layout = RowLayout(robot, {**(extra or {}), "t": Column()})
        self._rows: deque[bytes] = deque(maxlen=self._capacity())  # bytes: nothing for the garbage collector to scan
        self._start_ns = time.time_ns() - time.monotonic_ns()
        self._pushed = 0

    def __len__(self) -> int:
        return len(self._rows)

    def push(self, **values: Any) -> None:
        """Append one row by column name; what is not given is missing.

        Field names of the ancestor's logs (pos vel trq pos_o vel_o trq_o timestamp seqnum) are read as ours.
        `t` is the row's time [s], given for every row or for none; without it the clock is the time of the call.

        Raises
        ------
        UnknownName, ShapeError : before anything is stored.
        """
        values = {OLD_NAMES.get(name, name): value for name, value in values.items()}
        stamp = self._start_ns + time.monotonic_ns()
        standard = {"tick": self._pushed, "session": 1, "stamp_ns": stamp}
        self._rows.append(self._layout.pack_values({**standard, **values}))
        self._pushed += 1

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Append what the bridge knows of one tick.

        Raises
        ------
        ShapeError : an array has the wrong number of values.
        """
        self._rows.append(self._layout.pack(state, command, tick))

    def table(self) -> Table:
        """Return the rows so far; the table stays valid while pushing goes on."""
        values = self._layout.unpack(self._rows.copy())
        columns = {name: slot.column for name, slot in self._layout.slots.items()}
        return recording_table(values, columns, values.pop("stamp_ns"))

    def save(self, path: str | Path, *, note: str = "") -> Path:
        """Write the rows so far to a finished recording and return its path.

        ``log.read(log.save(path))`` is `table()`, but that poses go through quaternions.

        Parameters
        ----------
        path : ending in .mcap; ``-2``, ``-3`` is added when it exists, as a recorder does. note : kept in the metadata.

        Raises
        ------
        ConfigError : another ending; `write` makes files of other formats from `table()`.
        LogError : it cannot be written; nothing is left then.
        """
        rows = self._rows.copy()
        file = RecordingFile(recording_path(path), self._robot, self._layout, {}, note)
        try:
            file.write(list(rows), 0)
            file.finish({"rows": len(rows)})
        except BaseException as error:
            file.abandon()
            file.path.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise LogError(f"Expected to write the log {file.path}, got: {error.strerror}.") from None
            raise
        return file.path

    def _capacity(self) -> int | None:
        return None


class Tail(Log):
    """The last seconds of a log: a ring of fixed size.

    Parameters
    ----------
    seconds : how much is kept.
    robot, extra : as in `Log`.
    """

    def __init__(self, seconds: float, robot: Robot, extra: Mapping[str, Column] | None = None) -> None:
        self.seconds = positive(seconds, "length of a Tail [s]", "A minute is 60.")
        super().__init__(robot, extra)

    def table(self) -> Table:
        """Return the rows of the last `seconds`."""
        table = super().table()
        return table.between(table.t[-1] - self.seconds, np.inf) if len(table) else table

    def _capacity(self) -> int | None:
        return int(min(self.seconds * _TAIL_RATE, _TAIL_ROWS)) + 1
