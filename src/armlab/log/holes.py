"""Values of very different lengths: their columns are refused before there is memory for them."""

from __future__ import annotations

from collections.abc import Mapping

from armlab.errors import LogError

__all__ = ["refuse_holes"]

_LARGEST, _HOLES = 1 << 31, 512  # bytes of columns, and cells per number: one of 500 frames in each message


def refuse_holes(count: int, widths: Mapping[str, int], held: int) -> None:
    """Refuse values that differ so much that their columns are large and hardly hold anything.

    One message of a megabyte among thousands of short ones asks for gigabytes.

    Parameters
    ----------
    count : rows. widths : name -> most numbers in one of them. held : numbers in all of them.

    Raises
    ------
    LogError : more than 2 GiB of columns with less than one number in 512 cells.
    """
    cells = count * sum(widths.values())
    if 8 * cells > _LARGEST and cells > _HOLES * held:
        widest = max(widths, key=lambda path: widths[path])
        raise LogError(
            f"Expected values that are alike, got {count} rows with {held} numbers, up to {widths[widest]} in "
            f"{widest[:80]}: {len(widths)} name(s) that would take {cells} cells."
        )
