"""Every public name and its signature is listed, so that a change is noticed before it reaches users.

`make api` rewrites the list; describe the change in CHANGELOG.md.
"""

from __future__ import annotations

import difflib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType
from typing import Any, is_typeddict

import pytest

import armlab
import armlab.kernels

LIST = Path(__file__).with_name("public_api.txt")


class Plain(str):
    """An annotation shown without quotes."""

    __slots__ = ()
    __repr__ = str.__str__


def modules() -> list[str]:
    """Every package, and the modules that a package lists among its names."""
    found = {"armlab"}
    for info in pkgutil.walk_packages(armlab.__path__, "armlab."):
        package, _, name = info.name.rpartition(".")
        listed = package in found and name in getattr(import_module(package), "__all__", ())
        if listed or (info.ispkg and not re.search(r"\._", info.name)):
            found.add(info.name)
    return sorted(found)


def signature(thing: Any) -> str:
    """Parameters with annotations and defaults as they are written, without addresses and line ends."""
    try:
        known = inspect.signature(thing)
    except (TypeError, ValueError):  # built-in or in C
        return "(...)"
    written = [p.replace(annotation=plain(p.annotation)) for p in known.parameters.values()]
    text = str(known.replace(parameters=written, return_annotation=plain(known.return_annotation)))
    text = re.sub(r"ForwardRef\('(.*?)'\)", r"\1", text)  # fields of named tuples
    return re.sub(r"\s+", " ", re.sub(r" at 0x[0-9a-f]+", "", text))


def plain(annotation: Any) -> Any:
    return Plain(annotation) if isinstance(annotation, str) else annotation


def members(cls: type) -> Iterator[str]:
    """Public methods and properties, those of our own private bases included."""
    ours = [base for base in cls.__mro__ if base.__module__.startswith("armlab")]
    parts = {name: part for base in reversed(ours) for name, part in vars(base).items() if not name.startswith("_")}
    if is_typeddict(cls):
        yield from (f"[{name!r}]: {kind.__forward_arg__}" for name, kind in sorted(cls.__annotations__.items()))
    for name, part in sorted(parts.items()):
        reads = part.fget if isinstance(part, property) else getattr(part, "func", None)  # or a cached property
        if reads is not None:
            yield f".{name} -> {inspect.signature(reads).return_annotation}"
        elif isinstance(part, staticmethod | classmethod):
            yield f".{name}{signature(part.__func__)}"
        elif inspect.isroutine(part):
            yield f".{name}{signature(part)}"


@cache
def stub() -> ModuleType:
    """Signatures of the compiled kernels."""
    path = Path(armlab.kernels.__file__).with_name("_native.pyi")
    loader = SourceFileLoader("armlab.kernels._native", str(path))
    module = module_from_spec(spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    return module


def described(module: ModuleType, name: str) -> Iterator[str]:
    """Lines of one public name."""
    place = stub() if module.__name__ == "armlab.kernels" else module  # C has no signatures
    thing = getattr(place, name)
    where = f"{module.__name__}.{name}"
    if isinstance(thing, ModuleType):
        yield f"{where}: module"
    elif isinstance(thing, type):
        bases = ", ".join(base.__name__ for base in thing.__bases__ if base is not object)
        yield f"{where}{signature(thing)}" + f" is a {bases}" * bool(bases)
        yield from (where + line for line in members(thing))
    elif callable(thing):
        yield f"{where}{signature(thing)}"
    else:
        yield f"{where}: {type(thing).__name__}"


@cache
def public() -> str:
    lines = []
    for one in modules():
        module = import_module(one)
        lines += [line for name in sorted(getattr(module, "__all__", ())) for line in described(module, name)]
    return "\n".join(lines) + "\n"


def test_public_names_and_signatures_are_those_of_the_list() -> None:
    listed, there = LIST.read_text(encoding="utf-8"), public()
    change = difflib.unified_diff(listed.splitlines(), there.splitlines(), "listed", "there is now", n=0, lineterm="")
    if listed != there:
        pytest.fail(
            "The public names changed. If this is intended, run `make api` and add a line to CHANGELOG.md.\n"
            + "\n".join(change),
            pytrace=False,
        )


def test_the_list_sees_names_parameters_defaults_and_methods() -> None:
    def told(q: float, *, method: str = "irls") -> Plain:
        raise NotImplementedError

    assert signature(told) == "(q: float, *, method: str = 'irls') -> Plain"
    lines = public().splitlines()
    assert "armlab.errors.MissingExtra(...) is a ArmlabError, ImportError" in lines
    assert "armlab.lie.se3: module" in lines
    assert "armlab.log.Table.dt -> np.ndarray" in lines
    assert not [line for line in lines if re.search(r"0x[0-9a-f]{6}|\._[a-z]|\n", line)]


if __name__ == "__main__":
    LIST.write_text(public(), encoding="utf-8")
