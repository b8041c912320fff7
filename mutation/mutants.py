"""Mutants of a file, and their substitution for the original in this process.

mutmut generates them with its own operators and scope. Three rules are added: decorated functions are also mutated,
conditions are forced to true and to false, and calls are removed. Strings with spaces are not mutated.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import libcst as cst
from libcst.metadata import MetadataWrapper
from mutmut.mutation import mutators
from mutmut.mutation.file_mutation import MutationVisitor
from mutmut.mutation.pragma_handling import get_ignored_lines

__all__ = ["Mutant", "codes", "difference", "is_same", "loaded", "mutants", "transplant"]

_LARGE = 100  # values for which adding 1 makes no difference


@dataclass(frozen=True)
class Mutant:
    """One change to a file: the lines `before` in the function `where` became `after`."""

    file: str
    where: str
    before: str
    after: str
    source: str


def _number(node: cst.BaseNumber) -> Iterator[cst.CSTNode]:
    if isinstance(node, cst.Integer | cst.Float) and node.evaluated_value >= _LARGE:
        yield node.with_changes(value=repr(2 * node.evaluated_value))
    else:
        yield from mutators.operator_number(node)


def _word(node: cst.BaseString) -> Iterator[cst.CSTNode]:
    if isinstance(node, cst.SimpleString) and " " not in node.value:
        yield from list(mutators.operator_string(node))[:1]


def _left_out(node: cst.Expr | cst.Assign) -> Iterator[cst.CSTNode]:
    if isinstance(node, cst.Expr):
        is_felt = not isinstance(node.value, cst.BaseString)
    else:
        is_felt = all(isinstance(one.target, cst.Attribute | cst.Subscript) for one in node.targets)
    if is_felt:
        yield cst.Pass()


_REPLACED = {
    mutators.operator_number,
    mutators.operator_string,
    mutators.operator_assignment,  # None as a value or argument almost always causes a crash, which any test detects
    mutators.operator_arg_removal,
}
_OPERATORS = [
    *((kind, operator) for kind, operator in mutators.mutation_operators if operator not in _REPLACED),
    (cst.BaseNumber, _number),
    (cst.BaseString, _word),
    (cst.If, mutators.operator_if_exp),
    (cst.Expr, _left_out),
    (cst.Assign, _left_out),
]


class _Visitor(MutationVisitor):
    """Also visits decorated functions, because functions are not wrapped here."""

    def _skip_node_and_children(self, node: cst.CSTNode) -> bool:
        return not isinstance(node, cst.FunctionDef) and super()._skip_node_and_children(node)


def mutants(path: Path, file: str) -> Iterator[Mutant]:
    """Return the mutants of a file; some may compile to the same code, or not at all."""
    source = path.read_text()
    wrapper = MetadataWrapper(cst.parse_module(source))
    visitor = _Visitor(_OPERATORS, get_ignored_lines(file, source, wrapper))
    module = wrapper.visit(visitor)
    found, tree = set(), ast.parse(source)
    for mutation in visitor.mutations:
        changed = module.deep_replace(mutation.original_node, mutation.mutated_node).code  # type: ignore[arg-type]
        if changed != source and changed not in found:
            found.add(changed)
            first, before, after = difference(source, changed)
            if not before.startswith("__all__"):  # checked by tests/style
                yield Mutant(file, _function(tree, first + 1), before, after, changed)


def difference(old: str, new: str) -> tuple[int, str, str]:
    """Return the position of the first difference, the original lines and the changed lines, each joined into one line.

    Lines that are not unique in the file are extended by the preceding lines until they are.
    """
    ours, theirs = ([line.strip() for line in text.splitlines()] for text in (old, new))
    shorter = min(len(ours), len(theirs))
    first = next((i for i in range(shorter) if ours[i] != theirs[i]), shorter - 1)
    end = next((i for i in range(shorter - first) if ours[-1 - i] != theirs[-1 - i]), shorter - first - 1)
    begin, everything = first, " ".join(ours)
    while everything.count(before := " ".join(ours[begin : len(ours) - end])) > 1 and begin > 0:
        begin -= 1
    return first, before, " ".join(theirs[begin : len(theirs) - end])


def _function(tree: ast.AST, line: int, name: str = "") -> str:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.lineno <= line <= (node.end_lineno or 0):
            return _function(node, line, f"{name}.{node.name}".lstrip("."))
    return name


def codes(module: ModuleType) -> dict[str, FunctionType]:
    """Return the functions, methods and properties that a module defines, by qualified name."""
    found: dict[str, FunctionType] = {}
    todo = [
        (name, value) for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__
    ]
    for name, value in todo:
        if isinstance(value, property):
            todo += [(f"{name}.{way}", getattr(value, way)) for way in ("fget", "fset", "fdel")]
        for way in ("__func__", "__wrapped__"):
            value = getattr(value, way, value)
        if isinstance(value, FunctionType):
            found[name] = value
        elif isinstance(value, type) and name.rpartition(".")[2] == value.__name__:
            todo += [(f"{name}.{key}", one) for key, one in vars(value).items()]
    return found


def is_same(mutant: Mutant, module: ModuleType) -> bool:
    """Return whether a mutant compiles to the same code as its module.

    Raises
    ------
    SyntaxError : the mutant does not compile.
    """
    path = str(module.__file__)
    one, other = (compile(text, path, "exec") for text in (mutant.source, Path(path).read_text()))
    return _plain(one) == _plain(other)


def loaded(mutant: Mutant, module: ModuleType) -> ModuleType:
    """Return a mutant as a module that no other module has imported.

    Raises
    ------
    Exception : any exception raised by its import.
    """
    scratch = ModuleType(module.__name__)
    scratch.__dict__.update({key: vars(module)[key] for key in ("__file__", "__package__", "__spec__")})
    exec(compile(mutant.source, str(module.__file__), "exec"), scratch.__dict__)
    return scratch


def transplant(scratch: ModuleType, module: ModuleType) -> tuple[set[CodeType], bool]:
    """Substitute a loaded mutant for its module; return the changed code objects, and whether anything else changed.

    Functions keep their identity for all references: only their code is replaced. Constants are replaced in every
    armlab module that binds them to the same name.
    """
    ours, theirs, changed, beside = codes(module), codes(scratch), set(), False
    for key in ours.keys() & theirs.keys():
        one, other = ours[key], theirs[key]
        if _plain(one.__code__) != _plain(other.__code__):
            changed.add(one.__code__)
            one.__code__ = _fitting(other.__code__, one.__code__)
        if _said((one.__defaults__, one.__kwdefaults__)) != _said((other.__defaults__, other.__kwdefaults__)):
            one.__defaults__, one.__kwdefaults__, beside = other.__defaults__, other.__kwdefaults__, True
    for key, value in vars(scratch).items():
        old = vars(module).get(key)
        if _is_constant(value) and not key.startswith("__") and repr(old) != repr(value):
            beside = True
            for one in [one for at, one in sys.modules.items() if at.startswith("armlab")]:
                if vars(one).get(key) is old:
                    setattr(one, key, value)
        if isinstance(value, type) and isinstance(old, type) and value.__module__ == module.__name__:
            beside = _exchange_constants(value, old) or beside
    return changed, beside


def _exchange_constants(scratch: type, kind: type) -> bool:
    """Replace the constants of a class; return whether one changed."""
    changed = False
    for key, value in vars(scratch).items():
        if _is_constant(value) and not key.startswith("__") and repr(vars(kind).get(key)) != repr(value):
            setattr(kind, key, value)
            changed = True
    return changed


def _fitting(code: CodeType, old: CodeType) -> CodeType:
    """Return a code object that fits a function and keeps its closure (needed for `super()`)."""
    return code if code.co_freevars else code.replace(co_freevars=old.co_freevars)


def _said(defaults: Any) -> str:
    return re.sub(" at 0x[0-9a-f]+", "", repr(defaults))  # of functions


def _is_constant(value: Any) -> bool:
    simple = value is None or isinstance(value, bool | int | float | str)
    return (
        simple
        or (isinstance(value, tuple | frozenset | dict) and not hasattr(value, "__module__"))
        or type(value).__name__ in ("Drop", "State", "attrgetter")
    )


def _plain(code: CodeType) -> Any:
    """Return the parts of a code object that define its behaviour, without its location."""
    constants = tuple(_plain(one) if isinstance(one, CodeType) else (type(one), repr(one)) for one in code.co_consts)
    names = code.co_name, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    taken = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    return code.co_code, constants, names, taken, code.co_exceptiontable
