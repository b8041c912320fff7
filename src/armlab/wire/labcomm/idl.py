"""LabComm's `.lc` declaration language, and the declarations supplied with armlab.

``sample struct { int tm; double pos[7]; } robot_row;`` declares a sample, and ``typedef`` names a type for later
use. A typedef is expanded at each use; its name is not transmitted.
"""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple, NoReturn

from armlab.errors import LabCommError, UnknownName
from armlab.wire.labcomm.types import (
    PRIMS,
    VOID,
    Array,
    Dialect,
    Field,
    Notes,
    Prim,
    SampleType,
    Struct,
    Type,
    TypeRef,
    dialect_named,
)

_LARGEST, _MAX_DEPTH = 2**20, 32
_KEYWORDS = {"typedef", "struct", "void", *PRIMS}
_TOKEN = re.compile(
    r"(?P<skip>\s+|//[^\n]*|/\*.*?\*/)|(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?P<number>0|[1-9][0-9]*)(?![0-9])"
    r'|(?P<quoted>"[^"]*")|(?P<mark>[{}\[\](),:;])',
    re.DOTALL,
)
_NAME = re.compile(r"(?!_$)[A-Za-z_][A-Za-z0-9_]*")


class Typedef(NamedTuple):
    """Named type that is not a sample."""

    name: str
    type: Type


class _Token(NamedTuple):
    kind: str
    text: str
    at: int


def parse_lc(text: str, dialect: str = "2014v1") -> list[SampleType | Typedef]:
    """Return the samples and typedefs declared in a text, in order.

    Parameters
    ----------
    text : declarations with at most 2**20 characters and 32 levels of nesting.
    dialect : name of the dialect; only 2014i supports notes, such as ``(unit:rad)``, and quoted docs.

    Raises
    ------
    LabCommError : if the text is invalid; `line` and `column` locate the fault.
    UnknownName : if the dialect is unknown.
    """
    kind = dialect_named(dialect)
    if len(text) > _LARGEST:
        raise LabCommError(f"Expected at most {_LARGEST} characters of .lc text, got {len(text)}.")
    return _Parser(text, kind).file()


def to_lc(types: Iterable[SampleType | Typedef]) -> str:
    """Return the declarations of types; ``parse_lc(to_lc(types), "2014i")`` returns the same types.

    Parameters
    ----------
    types : the samples and typedefs.

    Raises
    ------
    LabCommError : if the language cannot express a name or a note.
    """
    lines = []
    for one in types:
        is_sample = isinstance(one, SampleType)
        head = "sample" if is_sample else "typedef"
        lines.append(f"{head} {_notes(one.notes if is_sample else ())}{_declared(one.type, _name(one.name), '')}\n")
    return "".join(lines)


class _Parser:
    """Recursive-descent parser over the tokens."""

    def __init__(self, text: str, dialect: Dialect) -> None:
        self._text, self._dialect = text, dialect
        self._tokens, self._next = self._scan(), 0
        self._types: dict[str, Type] = {}
        self._names: set[str] = set()

    def file(self) -> list[SampleType | Typedef]:
        found: list[SampleType | Typedef] = []
        while self._peek().kind != "end":
            found.append(self._declaration())
        return found

    def _declaration(self) -> SampleType | Typedef:
        start = self._take()
        if start.text not in ("typedef", "sample"):
            self._fail(start, '"typedef" or "sample"')
        notes = self._notes()
        if notes and start.text == "typedef":
            self._fail(start, "a typedef without notes")
        node, name = self._typed(1)
        if name.text in self._names:
            self._fail(name, "an unused name")
        self._names.add(name.text)
        if start.text == "sample":
            return SampleType(name.text, node, notes)
        self._types[name.text] = node
        return Typedef(name.text, node)

    def _typed(self, depth: int) -> tuple[Type, _Token]:
        """Parse a type, its name, its sizes and the semicolon."""
        start = self._peek()
        node = self._type(depth)
        name = self._take()
        if name.kind != "name" or name.text in _KEYWORDS or name.text == "_":
            self._fail(name, "a name")
        dims = []
        while self._peek().text == "[":
            dims.append(self._dims())
        self._mark(";")
        try:
            for sizes in reversed(dims):
                node = Array(sizes, node)
        except LabCommError as error:
            self._fail(start, str(error).partition(", got ")[0].removeprefix("Expected "))
        return node, name

    def _type(self, depth: int) -> Type:
        token = self._take()
        if depth > _MAX_DEPTH:
            self._fail(token, f"at most {_MAX_DEPTH} levels")
        if token.text == "struct":
            return self._struct(token, depth)
        if token.text == "void":
            return VOID
        if token.text in PRIMS:
            if token.text == "sample" and not self._dialect.references:
                self._fail(token, f"a type of LabComm {self._dialect.name}")
            return PRIMS[token.text]
        if token.kind != "name" or token.text not in self._types:
            self._fail(token, "a previously declared type")
        return self._types[token.text]

    def _struct(self, start: _Token, depth: int) -> Type:
        self._mark("{")
        fields: dict[str, Field] = {}
        while self._peek().text != "}" or not fields:
            notes = self._notes()
            first = self._peek()
            node, name = self._typed(depth + 1)
            if node == VOID:
                self._fail(first, "a non-void type for a field")
            if name.text in fields:
                self._fail(name, "an unused field name")
            fields[name.text] = Field(name.text, node, notes)
        self._mark("}")
        try:
            return Struct(tuple(fields.values()))
        except LabCommError:
            self._fail(start, f"at most {_MAX_DEPTH} levels")

    def _dims(self) -> tuple[int, ...]:
        self._mark("[")
        sizes = []
        while True:
            token = self._take()
            if token.text != "_" and (token.kind != "number" or not 0 < int(token.text[:11]) < 2**32):
                self._fail(token, "a size from 1 to 2**32 - 1 or _")
            sizes.append(0 if token.text == "_" else int(token.text))
            after = self._take()
            if after.text == "]":
                return tuple(sizes)
            if after.text != ",":
                self._fail(after, '"," or "]"')

    def _notes(self) -> Notes:
        """Parse the notes and skip the documentation."""
        notes: dict[str, str] = {}
        while self._peek().text == "(" or self._peek().kind == "quoted":
            token = self._take()
            if not self._dialect.maps:
                self._fail(token, "no notes, which only dialect 2014i supports,")
            if token.kind == "quoted":
                continue
            key = self._take()
            if key.kind != "name" or key.text in notes:
                self._fail(key, "an unused key")
            self._mark(":")
            value = self._take()
            if value.kind not in ("name", "quoted"):
                self._fail(value, "a value")
            notes[key.text] = value.text
            self._mark(")")
        return tuple(sorted(notes.items()))

    def _mark(self, text: str) -> None:
        token = self._take()
        if token.text != text:
            self._fail(token, f'"{text}"')

    def _peek(self) -> _Token:
        return self._tokens[self._next]

    def _take(self) -> _Token:
        token = self._tokens[self._next]
        self._next += token.kind != "end"
        return token

    def _scan(self) -> list[_Token]:
        tokens, at = [], 0
        while at < len(self._text):
            match = _TOKEN.match(self._text, at)
            if match is None:
                self._fail(_Token("", self._text[at], at), "a name, a number, a punctuation mark or a comment")
            if match.lastgroup != "skip":
                tokens.append(_Token(match.lastgroup or "", match[0], at))
            at = match.end()
        tokens.append(_Token("end", "", at))
        return tokens

    def _fail(self, token: _Token, expected: str) -> NoReturn:
        line = self._text.count("\n", 0, token.at) + 1
        column = token.at - self._text.rfind("\n", 0, token.at)
        got = repr(token.text[:40]) if token.text else "the end"
        raise LabCommError(
            f"Expected {expected} in line {line}, column {column}, got {got}.", line=line, column=column
        ) from None


def _declared(node: Type, name: str, indent: str) -> str:
    dims = ""
    while isinstance(node, Array):
        dims += f"[{', '.join(str(size or '_') for size in node.dims)}]"
        node = node.elem
    if isinstance(node, TypeRef):
        raise LabCommError(f"Expected a type expressible in .lc, got a reference to type {node.index}.")
    if isinstance(node, Prim) or not node.fields:
        return f"{node.name if isinstance(node, Prim) else 'void'} {name}{dims};"
    inner = indent + "  "
    fields = [f"{inner}{_notes(part.notes)}{_declared(part.type, _name(part.name), inner)}\n" for part in node.fields]
    return f"struct {{\n{''.join(fields)}{indent}}} {name}{dims};"


def _name(text: str) -> str:
    if not _NAME.fullmatch(text) or text in _KEYWORDS:
        raise LabCommError(f"Expected a valid .lc name (letters, digits, _, not a keyword), got {text!r}.")
    return text


def _notes(notes: Notes) -> str:
    for key, value in notes:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", key) or not re.fullmatch(
            r'[A-Za-z_][A-Za-z0-9_]*|"[^"]*"', value
        ):
            raise LabCommError(f"Expected a valid .lc note (names, or a quoted value), got {key!r}: {value!r}.")
    return "".join(f"({key}:{value}) " for key, value in notes)


FILES = ("armlab", "extctrl")
"""File names without extension."""


@cache
def text(name: str) -> str:
    """Return the text of a supplied declaration file, for example for a LabComm compiler."""
    data = pkgutil.get_data("armlab.wire.labcomm", f"idl/{name}.lc") if name in FILES else None
    if data is None:
        raise UnknownName.among("file of LabComm declarations", name, FILES)
    return data.decode()


@cache
def samples(name: str) -> dict[str, SampleType]:
    """Return the samples of a supplied declaration file by name."""
    return {one.name: one for one in parse_lc(text(name)) if isinstance(one, SampleType)}
