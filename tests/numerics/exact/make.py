"""Write the tables anew: `python tests/numerics/exact/make.py [folder [topic ...]]`; with `--few`, a few samples.

Arrays are their shape and their doubles, of 16 hexadecimal digits each; for what an earlier table has as well stands
its name. Inputs are made without BLAS, whose sums depend on the processor: every machine makes the same tables.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
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
import observers
import obstacles
import orientations
import primitives
import rigid
import steppers
import wrenches

MODULES = (
    chains, contacts, estimators, filters, groups, limits, observers, obstacles, orientations, primitives, steppers,
    wrenches,
)  # fmt: skip
TOPICS = {module.__name__: module for module in MODULES}


def packed(value: np.ndarray) -> list[Any]:
    """Return shape and big-endian bytes in hexadecimal digits."""
    return [list(value.shape), value.astype(">f8").tobytes().hex()]


def lines(tables: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each table, with the name of an earlier one in the place of what that has as well."""
    first: dict[str, str] = {}

    def named(name: str, value: Any, *place: str) -> Any:
        known = first.setdefault(json.dumps([place, value]), name)
        return value if known == name else known

    for name, table in tables.items():
        found: dict[str, Any] = {}
        for part, arrays in table.items():
            whole = (
                {key: packed(array) for key, array in arrays.items()} if isinstance(arrays, dict) else packed(arrays)
            )
            found[part] = named(name, whole, part)
            if isinstance(found[part], dict):
                found[part] = {key: named(name, array, part, key) for key, array in whole.items()}
        yield f'"{name}": {json.dumps(found)}'


def main(folder: Path, topics: list[str]) -> None:
    for topic in topics:
        text = ",\n".join(lines(TOPICS[topic].tables()))
        (folder / f"{topic}.json").write_text("{\n" + text + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    if "--few" in sys.argv:
        sys.argv.remove("--few")
        rigid.few = 2
    folder, *topics = sys.argv[1:] or [Path(__file__).parents[1] / "tables"]
    main(Path(folder), topics or list(TOPICS))
