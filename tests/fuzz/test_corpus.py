"""Corpus inputs, also with one value replaced by something no program writes."""

from __future__ import annotations

import random
import re
import sys
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT))

from fuzz.targets import TARGETS  # noqa: E402

CORPUS = ROOT / "fuzz" / "corpus"
INPUTS = sorted(path for path in CORPUS.rglob("*") if path.is_file())


@pytest.mark.parametrize("path", INPUTS, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_input(path: Path) -> None:
    """The properties that a target checks hold for this input; see its function."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        TARGETS[path.parent.name](path.read_bytes())


def test_every_target_has_inputs_and_they_are_small() -> None:
    assert {path.parent.name for path in INPUTS} == set(TARGETS)
    assert sum(path.stat().st_size for path in INPUTS) < 2**19


MOST = 15  # places per input
PLACE = re.compile(
    rb"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])|\"[^\"\n]{0,60}\"|'[^'\n]{0,60}'|\btrue\b|\bfalse\b"
)
TEXTS = [path for path in INPUTS if PLACE.search(path.read_bytes())]
VALUES = [
    b"1" + b"0" * 400, b"-1" + b"0" * 400, b"1" * 5000, b"1e999", b"-1e999", b"nan", b"NaN", b"inf", b"Infinity",
    b"9223372036854775807", b"9223372036854775808", b"-9223372036854775809", b"18446744073709551616", b"4294967296",
    b"1e308", b"5e-324", b"0", b"-1", b"1.5", b"1e5", b"1_0", b"0x7fffffffffffffffffff", "١".encode(), b"2026-01-01",
    b"true", b"null", b'"x"', b'""', b'"\\ud800"', b'"\\u0000"', b'"a/../../b"', b'"' + b"x" * 3000 + b'"',
    b"[]", b"{}", b"[[1]]", b'[1,"x"]', b"[[1,2],[3]]", b"{a=1}", b"1,1", b"1;1",
    b"[" * 4000 + b"1" + b"]" * 4000, b'{"a":' * 4000 + b"1" + b"}" * 4000,
]  # fmt: skip


def run(path: Path, places: list[re.Match[bytes]], values: list[bytes]) -> None:
    data = path.read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for place in places:
            for value in values:
                fitting = value.ljust(len(place[0]))  # keeps the length if possible, so that the rest stays valid
                made = data[: place.start()] + fitting + data[place.end() :]
                try:
                    TARGETS[path.parent.name](made)
                except Exception as error:
                    error.add_note(f"{value[:40]!r} for {place.group()!r} at byte {place.start()}")
                    raise


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_one_place(path: Path) -> None:
    """A third of the values, each at a random place; together the inputs cover all."""
    places = list(PLACE.finditer(path.read_bytes()))
    chosen = random.Random(path.name)
    for value in chosen.sample(VALUES, len(VALUES) // 3):
        run(path, [chosen.choice(places)], [value])


@pytest.mark.slow
@pytest.mark.parametrize("path", TEXTS, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_many_places(path: Path) -> None:
    places = list(PLACE.finditer(path.read_bytes()))
    run(path, random.Random(1).sample(places, min(MOST, len(places))), VALUES)
