"""What tests of several servers share: how they wait, and content that clients should not send."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

PATIENCE = 20.0  # s; only a test that fails waits so long


def until(condition: Callable[[], Any], what: str = "it", patience: float = PATIENCE) -> Any:
    """Wait for what another thread or process does, and return it."""
    end = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < end, f"{what} did not happen"
        time.sleep(0.001)
    return found


def nested(depth: int) -> list[Any]:
    """Lists in lists: more of them than a decoder takes."""
    found: list[Any] = []
    for _ in range(depth):
        found = [found]
    return found
