"""Write the tables anew: `python tests/numerics/exact/make.py [folder [topic ...]]`.

Arrays are their shape and their doubles, of 16 hexadecimal digits each. Inputs are made without BLAS, whose sums
depend on the processor: every machine makes the same tables.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import chains
import contacts
import estimators
import filters
import groups
import limits
import obstacles
import primitives

TOPICS = {
    module.__name__: module for module in (chains, contacts, estimators, filters, groups, limits, obstacles, primitives)
}


def packed(value: Any) -> Any:
    """Return arrays as shape and big-endian bytes in hexadecimal digits."""
    if isinstance(value, dict):
        return {key: packed(inside) for key, inside in value.items()}
    if isinstance(value, np.ndarray):
        return [list(value.shape), value.astype(">f8").tobytes().hex()]
    return value


def main(folder: Path, topics: list[str]) -> None:
    for topic in topics:
        lines = (f'"{name}": {json.dumps(packed(table))}' for name, table in TOPICS[topic].tables().items())
        (folder / f"{topic}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    folder, *topics = sys.argv[1:] or [Path(__file__).parents[1] / "tables"]
    main(Path(folder), topics or list(TOPICS))
