"""Clouds of known truth, and the files of a tracker."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.lie import quaternion

DATA = Path(__file__).parents[3] / "shared" / "data" / "frames"


@pytest.fixture(scope="session")
def tracker() -> Path:
    """Folder of the tracker's files."""
    if not DATA.is_dir():
        pytest.skip("needs ../shared/data/frames: clouds and planes of a tracker")
    return DATA


@pytest.fixture(scope="session")
def reference(tracker: Path) -> dict[str, Any]:
    """Reference results of the four scenes, in millimetres."""
    return json.loads((tracker / "frames_reference.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def cube() -> list[np.ndarray]:
    """The 24 rotations that map the axes onto themselves."""
    found = []
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2)):
        for signs in np.ndindex(2, 2, 2):
            R = np.zeros((3, 3))
            R[range(3), order] = 1 - 2 * np.array(signs)
            if np.linalg.det(R) > 0:
                found.append(R)
    return found


@pytest.fixture(scope="session")
def uniform_rotation() -> Callable[[np.random.Generator], np.ndarray]:
    """Draw a rotation, uniformly."""

    def draw(rng: np.random.Generator) -> np.ndarray:
        q = rng.standard_normal(4)
        return quaternion.to_matrix(q / np.linalg.norm(q))

    return draw
