"""No kernel without a table of exact results, or a reason."""

from __future__ import annotations

import inspect
import runpy
from collections.abc import Iterator
from pathlib import Path

import armlab.kernels

RESULTS = runpy.run_path(str(Path(__file__).with_name("results.py")))
TABLED, LEFT_OUT = RESULTS["TABLED"], RESULTS["LEFT_OUT"]
TABLES = [key.partition("/")[2].split() for key in RESULTS["tables"]()]


def kernels() -> Iterator[str]:
    """Yield functions by their names, methods by those of class and method."""
    for name in armlab.kernels.__all__:
        kernel = getattr(armlab.kernels, name)
        if not inspect.isclass(kernel):
            yield name
            continue
        yield from (f"{name}.{method}" for method, _ in inspect.getmembers(kernel, callable) if method[0] != "_")


def has_table(kernel: str) -> bool:
    words = TABLED.get(kernel, kernel.rpartition(".")[2]).split()
    return any(table[: len(words)] == words for table in TABLES)


def is_left_out(kernel: str) -> bool:
    return kernel in LEFT_OUT or kernel.partition(".")[0] in LEFT_OUT


def test_every_kernel_has_a_table_or_a_reason() -> None:
    found = list(kernels())
    assert [k for k in found if not has_table(k) and not is_left_out(k)] == []
    assert [k for k in found if has_table(k) and is_left_out(k)] == []
    assert {"Chain.rnea", "so3_exp"} <= set(found)


def test_the_lists_name_kernels_that_exist() -> None:
    found = set(kernels())
    classes = {k.partition(".")[0] for k in found}
    assert [k for k in LEFT_OUT if k not in found | classes] == []
    assert [k for k in TABLED if k not in found or not has_table(k)] == []
