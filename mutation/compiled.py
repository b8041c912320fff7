"""Mutants of a C++ file of the compiled core, and their substitution for the original in this process.

Each mutant is compiled alone and linked with its dependencies into a separate extension. The child process then
substitutes the bound function where the tests look it up. Mutations apply to text formatted by clang-format: binary
operators have a space on both sides, unlike templates, pointers and signs. Loop bounds are not mutated, because one
step too far reads arbitrary memory, which `make sanitize` detects. A mutant that compiles to the same object is
ignored.
"""

from __future__ import annotations

import os
import re
import subprocess
import sysconfig
from collections.abc import Iterator
from importlib import import_module
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, ModuleSpec
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType

import nanobind
import numpy as np
from mutants import Mutant, difference

__all__ = ["mutants", "placed", "prepare"]

ROOT = Path(__file__).resolve().parents[1]
NATIVE, BUILT = ROOT / "native", ROOT / "build" / "mutants"
BESIDE, ORIGINAL = "array/arrays.cpp", "original.o"  # files of the core that the mutated file depends on
MODULE = """
#define ARMLAB_IMPORTS_NUMPY
#include "array/arrays.h"
NB_MODULE({name}, m) {{
  if (PyArray_ImportNumPyAPI() < 0) throw nb::python_error();
  nb::set_leak_warnings(false);
  armlab::python::bind_{name}(m);
}}
"""
_SWAPPED = {
    " < ": " <= ", " <= ": " < ", " > ": " >= ", " >= ": " > ", " == ": " != ", " != ": " == ",
    " + ": " - ", " - ": " + ", " * ": " / ", " / ": " * ", " && ": " || ", " || ": " && ",
    " |= ": " = ", " *= ": " /= ", "std::min(": "std::max(", "std::max(": "std::min(",
    "std::fabs(": "(", "std::floor(": "(", " ? ": " || true ? ",
}  # fmt: skip
_NUMBER = re.compile(r"(?<![\w.])\d+(\.\d+)?(e-?\d+)?(?![\w.])")
_SIGN = re.compile(r"(?<=[\s({,])[-!](?=[\w(])")
_LEFT_OUT = re.compile(r"^ +([\w.:\[\]]+ [|*]?= |[\w.:]+\().*(?=;$)")  # a statement on its own line
_FUNCTION = re.compile(r"^\w[\w:* ]*?(\w+)\(.*\{?$|^struct (\w+)|^constexpr")


def mutants(path: Path, file: str) -> Iterator[Mutant]:
    """Return the mutants of a C++ file; some may compile to the same object, or not at all."""
    source, where = path.read_text(), ""
    lines = source.splitlines()
    for number, line in enumerate(lines):
        begun = _FUNCTION.match(line)
        if begun:
            where = begun[1] or begun[2] or ""
        if where.startswith("bind_"):
            break
        for changed in _changed(line):
            text = "\n".join([*lines[:number], changed, *lines[number + 1 :], ""])
            _, before, after = difference(source, text)
            yield Mutant(file, where, before, after, text)


def _changed(line: str) -> Iterator[str]:
    code = line.split("//")[0].rstrip()
    if not code or code.startswith("#") or ('"' in code and "=" not in code):  # part of a text
        return
    hidden = re.sub(r'"[^"]*"|< \w+; |\[\d\]', lambda found: "_" * len(found[0]), code)
    for old, new in _SWAPPED.items():
        for found in re.finditer(re.escape(old), hidden):
            yield _put(line, found, new)
    for found in _NUMBER.finditer(hidden):
        yield _put(line, found, repr((float if re.search(r"[.e]", found[0]) else int)(found[0]) + 1))
    for found in _SIGN.finditer(hidden):
        yield _put(line, found, "")
    for found in re.finditer(r"\bif \(", hidden):
        end = _closing(hidden, found.end())
        for forced in ("|| true", "&& false"):
            yield f"{line[: found.end()]}({line[found.end() : end]}) {forced}{line[end:]}" if end else line
    for found in _LEFT_OUT.finditer(hidden):
        yield _put(line, found, "")


def _put(line: str, found: re.Match[str], new: str) -> str:
    return line[: found.start()] + new + line[found.end() :]


def _closing(text: str, start: int) -> int:
    """Return the position of the closing bracket, or 0 if it is on another line."""
    depth = 1
    for k in range(start, len(text)):
        depth += (text[k] == "(") - (text[k] == ")")
        if depth == 0:
            return k
    return 0


def prepare(path: Path, file: str) -> Mutant:
    """Compile a file and everything its mutants are linked with; return an equivalent mutant.

    Raises
    ------
    SyntaxError : a file does not compile.
    """
    BUILT.mkdir(parents=True, exist_ok=True)
    (BUILT / "module.cpp").write_text(MODULE.format(name=path.stem))
    (BUILT / "mutant.cpp").write_text(path.read_text())
    (BUILT / "nanobind.cpp").write_text('#include "nb_combined.cpp"\n')
    (BUILT / "beside.cpp").write_text((NATIVE / BESIDE).read_text())
    for one in ("nanobind", "module", "beside", "mutant"):
        _compile(one)
    (BUILT / "mutant.o").rename(BUILT / ORIGINAL)  # compiled from mutant.cpp: objects contain that name
    return Mutant(file, "", "", "", f"{path.read_text()}int beside;\n")


def placed(mutant: Mutant, module: ModuleType) -> bool:
    """Substitute a mutant for the functions that its file binds in a module; return False if it is identical.

    Raises
    ------
    SyntaxError : the mutant does not compile.
    """
    (BUILT / "mutant.cpp").write_text(mutant.source)
    _compile("mutant")
    if (BUILT / "mutant.o").read_bytes() == (BUILT / ORIGINAL).read_bytes():
        return False
    name = Path(mutant.file).stem
    built = BUILT / f"{name}{EXTENSION_SUFFIXES[0]}"
    _run("-shared", *(f"{one}.o" for one in ("nanobind", "module", "beside", "mutant")), "-o", str(built))
    loader = ExtensionFileLoader(name, str(built))
    extension = module_from_spec(ModuleSpec(name, loader, origin=str(built)))
    loader.exec_module(extension)
    for key, function in vars(extension).items():
        if not key.startswith("_"):
            for one in (module, import_module("armlab.kernels")):
                setattr(one, key, function)
    return True


def _compile(name: str) -> None:
    own = Path(nanobind.source_dir()), Path(nanobind.include_dir())
    folders = [NATIVE, *own, own[1].parent / "ext" / "robin_map" / "include"]
    folders += [Path(sysconfig.get_path("include")), Path(np.get_include())]
    flags = ("-std=c++17", "-O1", "-fPIC", "-fvisibility=hidden", "-fno-strict-aliasing", "-ffp-contract=off", "-w")
    _run(*flags, *(f"-I{one}" for one in folders), "-c", f"{name}.cpp", "-o", f"{name}.o")


def _run(*arguments: str) -> None:
    done = subprocess.run(
        [os.environ.get("CXX", "g++"), *arguments], cwd=BUILT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SyntaxError(done.stderr)
