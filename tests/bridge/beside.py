"""What tests of whole cells in real time need: a reader that must get every row, and what the loop missed when."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from armlab.bridge.servers.row import Row
from armlab.errors import LinkError
from armlab.log import Table

from ..processes import until

PATIENCE = 60.0  # s; only a test that fails waits so long
WINDOW = 100  # ticks before and after what happened, in which packets without an answer are compared


class Watch:
    """A reader of another server, which must get every row; it reads in a thread of its own."""

    def __init__(self) -> None:
        self.ticks: list[int] = []
        self.row: Row | None = None
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        with LocalFeed() as feed, contextlib.suppress(LinkError):  # the bridge ends
            feed.ask(Subscribe(rate=None))
            while True:
                message = feed.receive()
                if isinstance(message, Row):
                    self.row = message
                    self.ticks.append(message.values["yumi_left.tick"])

    def __getitem__(self, name: str) -> Any:
        """A value of the newest row."""
        assert self.row is not None
        return self.row.values[f"yumi_left.{name}"]

    def until(self, condition: Callable[[], bool]) -> None:
        until(lambda: self.row is not None and condition(), PATIENCE)

    def wait(self, ticks: int) -> None:
        """Wait for so many rows from now on."""
        last = len(self.ticks) + ticks
        self.until(lambda: len(self.ticks) > last)

    def commands(self, who: str) -> bool:
        return self["commander"] == who

    def check(self) -> None:
        """It got every row, in order."""
        steps = np.diff(self.ticks)
        assert steps.min() == 1
        assert np.sum(steps - 1) <= 0.001 * len(self.ticks)


def more_missed(table: Table, ticks: Sequence[int], window: int = WINDOW) -> list[int]:
    """Return how many more packets were missed in a window after each tick than in one before.

    Packets that were lost have no row, and those that were overtaken no answer. While the loop stands still in the
    controller, as the arbiter is, its guard answers that the arm holds: late.
    """
    number, seq = (np.asarray(table[name], dtype=int) for name in ("tick", "seq"))
    in_time = (np.asarray(table["send_ns"]) > 0) & (np.asarray(table["late"]) == 0)
    missed = np.diff(seq, prepend=seq[0] - 1) - in_time
    places = [int(np.searchsorted(number, tick)) for tick in ticks]
    return [int(missed[at : at + window].sum() - missed[at - window : at].sum()) for at in places]
