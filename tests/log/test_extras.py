"""Packages of the extra are there, or a sentence says how to get them."""

from __future__ import annotations

import json
import sys

import pytest

from armlab.errors import MissingExtra
from armlab.log.file_formats.opening import needed


def test_what_is_installed_is_returned() -> None:
    assert needed("json", "for a test") is json


def test_what_is_missing_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingExtra, match=r"Expected pyarrow for Parquet, got none\. Install it: pip install 'armlab"):
        needed("pyarrow.parquet", "for Parquet")
