"""What tests of several servers share: how they wait, and content that clients should not send."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from armlab.bridge.cell import Cell, run_cell
from armlab.bridge.command.arbiter import Arbiter
from armlab.state import Command, State

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


LONGEST = 120.0  # s; only a test that fails runs so long


def play(monkeypatch: pytest.MonkeyPatch, cell: Cell, script: Callable[[], None]) -> Any:
    """Run a cell in this thread while a script plays its clients in another; the end of the one ends the other."""
    over, obey, failures = threading.Event(), Arbiter.__call__, list[BaseException]()

    def obey_or_end(arbiter: Arbiter, state: State) -> Any:
        command = obey(arbiter, state)
        return Command.stop() if over.is_set() else command

    def run() -> None:
        try:
            script()
        except BaseException as error:
            failures.append(error)
        over.set()

    monkeypatch.setattr(Arbiter, "__call__", obey_or_end)
    thread = threading.Thread(target=run, daemon=True)
    try:
        return run_cell(cell, seconds=LONGEST, patience=20.0, ready=lambda line: thread.start())
    finally:
        thread.join(LONGEST)
        assert not thread.is_alive()
        if failures:
            raise failures[0]
