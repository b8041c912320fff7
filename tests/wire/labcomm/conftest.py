"""Byte vectors written by the LabComm libraries; tests are skipped if the vectors are missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

VECTORS = Path(__file__).parents[4] / "shared/data/labcomm_vectors"


@pytest.fixture(scope="session")
def folder() -> Path:
    if not VECTORS.exists():
        pytest.skip("needs ../shared/data/labcomm_vectors: streams written by the LabComm libraries")
    return VECTORS


@pytest.fixture(scope="session")
def manifest(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
