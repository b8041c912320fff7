"""`Gaps`: rows of an arm that did not come, counted from the numbers that they carry."""

from __future__ import annotations

import struct

from armlab.bridge.row_schema import RowSchema

__all__ = ["Gaps"]

_NUMBER = struct.Struct("<q")


class Gaps:
    """Counts what a reader of every row of an arm ("state" or "live") misses.

    Parameters
    ----------
    schema : of the rows. robot : the arm.

    Attributes
    ----------
    rows, lost : that came, and that did not between those that did. starts : runs of the bridge that were heard.
    """

    def __init__(self, schema: RowSchema, robot: str) -> None:
        self._at = schema.fields[f"{robot}.tick"].offset
        self._last = -1
        self.rows = self.lost = self.starts = 0

    def take(self, data: bytes) -> int:
        """Count a row; return how many are missing before it.

        Parameters
        ----------
        data : a row of this schema, of this arm.
        """
        (number,) = _NUMBER.unpack_from(data, self._at)
        if number <= self._last or not self.rows:  # another run begins anew
            self.starts += 1
            missing = 0
        else:
            missing = number - self._last - 1
        self._last = number
        self.rows += 1
        self.lost += missing
        return missing
