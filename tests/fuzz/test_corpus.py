"""The inputs that fuzzing begins with, and those that once failed: every decoder takes or refuses them."""

from __future__ import annotations

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
    """What a target promises of this input holds; see its function."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        TARGETS[path.parent.name](path.read_bytes())


def test_every_target_has_inputs_and_they_are_small() -> None:
    assert {path.parent.name for path in INPUTS} == set(TARGETS)
    assert sum(path.stat().st_size for path in INPUTS) < 2**19
