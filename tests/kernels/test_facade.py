"""The facade: a missing or an old extension, and the stub that documents it."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from armlab import kernels

STUB = ast.parse((Path(kernels.__file__).parent / "_native.pyi").read_text(encoding="utf-8"))
PUBLIC = {node.name: node for node in STUB.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}


@pytest.mark.parametrize("extension", ["None", "types.ModuleType('old')"])
def test_without_the_extension_one_sentence_says_what_to_install(extension: str) -> None:
    program = f"import sys, types; sys.modules['armlab.kernels._native'] = {extension}; import armlab.kernels"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False).stderr
    assert "MissingExtra: Expected the compiled kernels of armlab, got none of this version" in said
    assert "Install a wheel of armlab, or install a C++ compiler and build it: `make -B setup`" in said


def test_the_stub_has_every_kernel_and_no_other() -> None:
    assert (
        set(PUBLIC)
        == {name for name in dir(kernels._native) if not name.startswith("_")}
        == set(dir(kernels)) & set(PUBLIC)
    )


def parameters(node: ast.FunctionDef) -> list[str]:
    found = [a.arg for a in (*node.args.args, *node.args.kwonlyargs)]
    return found[1:] if found[:1] == ["self"] else found


def compiled_parameters(function: Any) -> list[str]:
    signature = (function.__doc__ or "").splitlines()[0]
    while "[" in signature:
        signature = re.sub(r"\[[^][]*\]", "", signature)
    found = re.findall(r"[(,] ?\*{0,2}(\w+)(?=[:,)=])", signature.partition(" ->")[0])
    return found[1:] if found[:1] == ["self"] else found


@pytest.mark.parametrize("name", PUBLIC)
def test_the_stub_is_of_the_extension(name: str) -> None:
    """Methods, properties, and the names of parameters in their order."""
    kernel, node = getattr(kernels, name), PUBLIC[name]
    if isinstance(node, ast.FunctionDef):
        assert parameters(node) == compiled_parameters(kernel)
        return
    listed = {part.name: part for part in node.body if isinstance(part, ast.FunctionDef)}
    attributes = {part.target.id for part in node.body if isinstance(part, ast.AnnAssign)}
    assert {part for part in dir(kernel) if not part.startswith("_")} == set(listed) - {"__init__"} | attributes
    for method, part in listed.items():
        if not part.decorator_list:
            assert parameters(part) == compiled_parameters(getattr(kernel, method)), method
