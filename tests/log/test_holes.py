"""Columns that would hardly hold anything are refused; the logs that have them are in the tests of their readers."""

from __future__ import annotations

import contextlib

import pytest

from armlab.errors import LogError
from armlab.log.column import refuse_ragged


@pytest.mark.parametrize(("rows", "held", "told"), [(2**21, 0, ""), (2**22, 2**20, ""), (2**22, 2**20 - 1, "alike")])
def test_few_holes_and_small_columns_are_no_matter(rows: int, held: int, told: str) -> None:
    with pytest.raises(LogError, match=told) if told else contextlib.nullcontext():
        refuse_ragged(rows, {"x": 100, "y": 28}, held)
