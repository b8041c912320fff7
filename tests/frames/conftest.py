"""Point clouds with known ground truth, and tracker files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

DATA = Path(__file__).parents[3] / "shared" / "data" / "frames"


@pytest.fixture(scope="session")
def tracker() -> Path:
    if not DATA.is_dir():
        pytest.skip("needs ../shared/data/frames: clouds and planes of a tracker")
    return DATA


@pytest.fixture(scope="session")
def reference(tracker: Path) -> dict[str, Any]:
    """Reference results of the four scenes, in millimetres."""
    return json.loads((tracker / "frames_reference.json").read_text(encoding="utf-8"))
