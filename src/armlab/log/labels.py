"""Names of columns: the aliases of the old tools, and natural order."""

from __future__ import annotations

import re

__all__ = ["OLD_NAMES", "alias", "natural_key"]

OLD_NAMES = {"pos": "q", "vel": "qd", "trq": "tau", "pos_o": "q_ref", "vel_o": "qd_ref", "trq_o": "tau_ref"}
OLD_NAMES |= {"timestamp": "t", "seqnum": "seq"}
"""Names of the fields of Robotlab.jl's logs -> ours."""


def alias(name: str) -> str:
    """Return a column name with ``: . [ ]`` replaced by ``_`` and outer ``_`` stripped, as the old tools did."""
    return re.sub(r"[:.\[\]]", "_", name).strip("_")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return the sorting key in which digit groups compare as numbers."""
    pieces = re.findall(r"\d+|\D+", name)
    return [(0, int(piece), "") if piece.isdigit() else (1, 0, piece) for piece in pieces]
