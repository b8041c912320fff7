"""`ReplaySource`: a source as a recording holds it."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.bridge.sources import TICK_COLUMNS, Reading, Source
from armlab.errors import UnknownName
from armlab.log import Table

__all__ = ["ReplaySource"]


class ReplaySource(Source):
    """A source as it was recorded: the same readings at the same ticks, through the same fusion.

    Parameters
    ----------
    name : of the recorded source. table : a recording with its columns. period, options : see `Source`.

    Raises
    ------
    UnknownName : the table has no such source.
    """

    def __init__(self, name: str, table: Table, period: float, **options: Any) -> None:
        prefix, own = f"{name}.", TICK_COLUMNS
        names = [one for one in table.names if one.startswith(prefix) and one.removeprefix(prefix) not in own]
        if not names or f"{prefix}age" not in table:
            known = sorted({one.partition(".")[0] for one in table.names if one.endswith(".age")})
            raise UnknownName.among("source in this recording", name, known)
        fields = {one.removeprefix(prefix): table.columns[one] for one in names}
        super().__init__(name, fields, period, **options)
        self._values = {one.removeprefix(prefix): table[one] for one in names}
        self._ages_ns = np.rint(1e9 * table[f"{prefix}age"])
        absent = np.full(len(table), np.nan)  # the source had no clock or numbers of its own
        self._counts = {one: table.values.get(f"{prefix}{one}", absent) for one in ("seq", "gaps", "source_time")}
        self._ticks_ns = table["receive_ns"] - table["receive_ns"][0]
        self._begun_ns: int | None = None
        self._row, self._newest = -1, None

    def newest(self) -> Reading | None:
        """Return what the recording held at this time; it begins with the first tick."""
        if self._begun_ns is None:
            self._begun_ns = self.now_ns
        row = int(np.searchsorted(self._ticks_ns, self.now_ns - self._begun_ns, side="right")) - 1
        if row != self._row:
            self._row, self._newest = row, self._reading(row)
        return self._newest

    def _reading(self, row: int) -> Reading | None:
        if row < 0 or not np.isfinite(self._ages_ns[row]) or self._begun_ns is None:
            return None
        receive_ns = self._begun_ns + int(self._ticks_ns[row]) - int(self._ages_ns[row])
        told = [float(counts[row]) for counts in self._counts.values()]
        seq, gaps, seconds = (one if np.isfinite(one) else 0.0 for one in told)
        values = self.values({name: array[row] for name, array in self._values.items()})
        return Reading(values, round(1e9 * seconds), receive_ns, int(seq), int(gaps))
