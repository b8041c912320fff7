"""A cell that runs until its clients have done: no test guesses how long they take."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from armlab.bridge.arbiter import Arbiter
from armlab.bridge.cell import Cell, run_cell
from armlab.state import Command, State

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
