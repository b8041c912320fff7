"""XML elements that know their line, read without document types: no entity can grow, no other file is opened."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from xml.parsers import expat

import numpy as np

from armlab.errors import RobotError

__all__ = ["LARGEST", "Element", "parse_xml"]

LARGEST = 1e9
"""Limits from this on stand for none; no other number of a description is as large."""

DEEPEST = 64  # nesting of elements; URDF needs 5
MOST_BYTES, MOST_ELEMENTS = 1 << 24, 100_000  # a humanoid with two hands has 200 kB and 3000
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_LIMIT = re.compile(rf"{_NUMBER.pattern}|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)
_EXPAND = "Expand the file first: xacro robot.xacro > robot.urdf."


@dataclass(slots=True)
class Element:
    """One element: tag, attributes, place and children; its readers raise `RobotError` with file and line."""

    tag: str
    attributes: dict[str, str]
    file: str
    line: int
    children: list[Element] = field(default_factory=list)

    def error(self, expected: str, got: object, advice: str = "") -> RobotError:
        """Return the error that says what was expected at this element."""
        return RobotError(f"Expected {expected} in {self.file}, line {self.line}, got {got}.{advice and ' '}{advice}")

    def all(self, tag: str) -> list[Element]:
        """Return the children of one tag."""
        return [child for child in self.children if child.tag == tag]

    def one(self, tag: str) -> Element | None:
        """Return the only child of one tag, or None."""
        found = self.all(tag)
        if len(found) > 1:
            raise found[1].error(f"one <{tag}> inside <{self.tag}>", f"another in line {found[0].line}", "Remove one.")
        return found[0] if found else None

    def need(self, tag: str) -> Element:
        """Return the only child of one tag."""
        found = self.one(tag)
        if found is None:
            raise self.error(f"a <{tag}> inside <{self.tag}>", "none", "Add it.")
        return found

    def text(self, name: str) -> str:
        """Return an attribute that must be there and not be empty."""
        value = self.attributes.get(name, "")
        if not value.strip():
            raise self.error(f"the attribute {name} of <{self.tag}>", "none", "Add it.")
        if "${" in value or "$(" in value:
            raise self.error(f"plain text as {name} of <{self.tag}>", f"the xacro expression {value!r}", _EXPAND)
        return value

    def numbers(self, name: str, count: int, default: tuple[float, ...] | None = None) -> np.ndarray:
        """Return `count` numbers between spaces; where the attribute is missing, the default if there is one."""
        if name not in self.attributes and default is not None:
            return np.array(default)
        words = self.text(name).split()
        if len(words) != count:
            raise self.error(f"{count} numbers as {name} of <{self.tag}>", repr(self.attributes[name]))
        return np.array([self._number(name, word) for word in words])

    def number(self, name: str, default: float | None = None) -> float:
        """Return one number."""
        return float(self.numbers(name, 1, None if default is None else (default,))[0])

    def limit(self, name: str, default: float) -> float:
        """Return one limit, infinite from `LARGEST` on."""
        word = self.attributes.get(name, "").strip()
        if _LIMIT.fullmatch(word):
            value = float(word)
            return value if abs(value) < LARGEST else float(np.copysign(np.inf, value))
        return self.number(name, default)

    def _number(self, name: str, word: str) -> float:
        if not _NUMBER.fullmatch(word):
            raise self.error(f"a finite number in {name} of <{self.tag}>", repr(word), "Correct it.")
        value = float(word)
        if not abs(value) < LARGEST:
            raise self.error(f"numbers below {LARGEST:g} in {name} of <{self.tag}>", word, "Correct it; units are SI.")
        return value


def parse_xml(data: str | bytes, file: str) -> Element:
    """Return the root element of a text.

    Parameters
    ----------
    data : XML; bytes are decoded as their declaration says.
    file : its name, for messages.

    Raises
    ------
    RobotError : when the text is no XML, has a document type (entities), is too large, nested too deep, or is not
        expanded xacro.
    """
    if len(data) > MOST_BYTES:
        raise RobotError(f"Expected XML of at most {MOST_BYTES >> 20} MiB in {file}, got {len(data)} bytes.")
    parser = expat.ParserCreate()
    top = Element("", {}, file, 1)
    open_elements = [top]
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        element = Element(tag, attributes, file, parser.CurrentLineNumber)
        if count > MOST_ELEMENTS:
            raise element.error(f"at most {MOST_ELEMENTS} elements", "more")
        if tag.startswith("xacro:"):
            raise element.error("a URDF", f"the xacro element <{tag}>", _EXPAND)
        if len(open_elements) > DEEPEST:
            raise element.error(f"elements nested at most {DEEPEST} deep", f"a deeper <{tag}>")
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def document_type(name: str, *_: object) -> None:
        place = Element(name, {}, file, parser.CurrentLineNumber)
        raise place.error("XML without a document type", "a <!DOCTYPE>", "Remove it: a URDF needs no entities.")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _tag: open_elements.pop()
    parser.StartDoctypeDeclHandler = document_type
    try:
        parser.Parse(data, True)
    except RobotError:  # a ValueError too, and a sentence already
        raise
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise RobotError(f"Expected XML in {file}, line {error.lineno}, got: {reason}.") from None
    except (ValueError, LookupError) as error:  # an encoding that does not exist or does not fit
        raise RobotError(f"Expected XML in {file}, line {parser.CurrentLineNumber}, got: {error}.") from None
    return top.children[0]
