"""The rows of one robot in one file, on their way into another."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from armlab.errors import LogError
from armlab.kernels import RowEncoder
from armlab.log.column import Column
from armlab.log.mcap_copy import messages_in
from armlab.log.mcap_records import Channel
from armlab.log.messages import column_topic, definition, plan
from armlab.log.recording_columns import Rows
from armlab.log.rows import Slot

__all__ = ["Arm", "seconds_channel"]

_ROW = struct.Struct("<qqd")  # stamp, number, t
_SECONDS = {"t": Slot(Column().resolved("t"), _ROW.size - 8, _ROW.size, "<f8")}
_NUMBERS = 1 << 32  # of MCAP's sequence
_NEVER = (1 << 63) - 1


def seconds_channel(prefix: str, clock: dict[str, str]) -> Channel:
    """Return the channel of the column `t`: times that are not those of the messages.

    Parameters
    ----------
    prefix : topics of the robot begin so. clock : what is written beside, see `messages.clock_metadata`.
    """
    topic = column_topic("t")
    metadata = topic.metadata(_SECONDS) | clock
    return Channel(f"{prefix}{topic.name}", topic.type, definition(topic.type), "ros2msg", "cdr", metadata)


class Arm:
    """The rows of one robot in a file: which of them are taken, at what times, under which numbers.

    Parameters
    ----------
    path : of the file. prefix : topics of the robot begin so, with slashes. robot_hash : of its description.
    rows : all its rows. seconds : channel of a column t, if it has one: it is written anew.

    Attributes
    ----------
    t, t0_ns : times of all rows in the new file and the wall clock of its t = 0. seconds_number : channel of `t` there.
    inside : the rows and events that come now are taken.
    """

    def __init__(self, path: Path, prefix: str, robot_hash: str, rows: Rows, seconds: int | None) -> None:
        self.path, self.prefix, self.name, self.robot_hash = path, prefix, prefix.strip("/"), robot_hash
        self.rows, self.seconds, self.seconds_number = rows, seconds, 0
        self.t, self.t0_ns = rows.t, rows.t0_ns
        self.inside, self.is_over = True, False
        self._first, self._last = 0, len(rows.t)
        self._offset = 0
        self._place = {int(number): place for place, number in enumerate(rows.sequence)}
        self._encoder = RowEncoder([plan(0, column_topic("t"), _SECONDS)])
        twice = len(rows.t) - len(self._place)
        if twice:
            raise LogError(
                f"Expected rows with numbers of their own in {path}, got {twice} that come again. "
                "Write it anew: log.write(log.read(path), 'new.mcap', robot)."
            )

    @property
    def start_ns(self) -> int:
        """Wall clock of the first row; of a recording without rows, which sets no clock for others, the end of time."""
        return self._wall(0) if self.rows.kept.any() else _NEVER

    @property
    def end_ns(self) -> int:
        """Wall clock of the last row."""
        return self._wall(-1)

    @property
    def rows_left(self) -> int:
        """Number of rows of the table that are taken."""
        return int(self.rows.kept[self._first : self._last].sum())

    @property
    def ticks(self) -> tuple[int, int]:
        """Numbers of the first and the last row that are taken, as in the file."""
        numbers = self.rows.sequence[self._first : self._last]
        return (int(numbers[0]), int(numbers[-1])) if len(numbers) else (0, -1)

    def cut(self, start: float, stop: float) -> None:
        """Take the rows with start <= t < stop only, and what was written between them."""
        kept = np.flatnonzero(self.rows.kept)
        t = self.rows.t[kept]
        wanted = kept[(t >= start) & (t < stop)]
        if len(wanted) == 0:
            self._first, self._last = 0, 0
        else:  # what came before the first row of the table, and after the last, belongs to them
            self._first = int(wanted[0]) if wanted[0] > kept[0] else 0
            self._last = int(wanted[-1]) + 1 if wanted[-1] < kept[-1] else len(self.rows.t)
        self.inside = self._first == 0 and self._last > 0

    def follow(self, first: Arm, before: Arm) -> None:
        """Put the rows on the clock of the first recording of the robot, numbered on from the one before.

        Raises
        ------
        LogError : the one before has not ended when this one begins.
        """
        self.t, self.t0_ns = self.rows.t + (self.rows.t0_ns - first.t0_ns) / 1e9, first.t0_ns
        own, last = self.t[self.rows.kept], before.t[before.rows.kept]
        if len(own) and len(last) and own[0] <= last[-1]:
            raise LogError(
                f"Expected {self.path} of {self.name} to begin after {before.path} has ended at {last[-1]:.6g} s, got "
                f"{own[0]:.6g} s. Cut one of them, or put them together in Python: log.concat and Table.shifted."
            )
        if len(self.rows.sequence) and len(before.rows.sequence):
            highest = int(before.rows.sequence.max()) + before._offset
            self._offset = max(0, highest + 1 - int(self.rows.sequence.min()))

    def number(self, sequence: int) -> int:
        """Return the number of a row in the new file."""
        return (sequence + self._offset) % _NUMBERS

    def arrive(self, sequence: int, log_ns: int) -> bytes | None:
        """Take notice that a row begins; return the message that holds its t, None when the row is not taken."""
        place = self._place.get(sequence)
        if place is None:
            return None
        self.inside, self.is_over = self._first <= place < self._last, place >= self._last
        if not self.inside:
            return None
        records, *_ = self._encoder.encode([_ROW.pack(log_ns, sequence, self.t[place])])
        return next(message for *_, message in messages_in(records))

    def _wall(self, which: int) -> int:
        t = self.rows.t[self.rows.kept]
        return self.rows.t0_ns + round(float(t[which]) * 1e9) if len(t) else 0
