"""Descriptors that other code closes."""

from __future__ import annotations

import os
from pathlib import Path

from armlab._descriptors import identity


def test_a_descriptor_that_belongs_to_another_file_has_another_identity(tmp_path: Path) -> None:
    number = os.open(tmp_path / "a", os.O_CREAT | os.O_WRONLY)
    before = identity(number)
    assert before == identity(number)
    os.close(number)
    assert identity(number) is None
    assert os.open(tmp_path / "b", os.O_CREAT | os.O_WRONLY) == number
    assert identity(number) not in (None, before)
    os.close(number)
