"""``armlab monitor``: a running bridge, in the terminal."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from armlab.errors import ConfigError, LinkError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from armlab.bridge.servers.status import Watch

__all__ = ["monitor", "table"]

_RATE = 10.0  # Hz of the display
_LINES = 1.0  # s between two lines where there is no terminal


def monitor(robot: str | None = None, *, cell: str = "", zenoh: str = "", seconds: float | None = None) -> None:
    """Watch a bridge of this user that runs, until Ctrl-C or its end.

    Parameters
    ----------
    robot
        Show this arm only.
    cell
        Name of the cell; needed when several run.
    zenoh
        A bridge on another computer, for example zenoh://192.168.1.5:7447/lab1.
    seconds
        Time after which to end [s].
    """
    from rich.console import Console

    from armlab.bridge.servers.local import LocalFeed
    from armlab.bridge.servers.messages import Subscribe
    from armlab.bridge.servers.status import Watch
    from armlab.bridge.servers.zenoh.feed import ZenohFeed
    from armlab.cli.support.output import note, result

    if seconds is not None and not seconds >= 0.0:
        raise ConfigError(f"Expected seconds of at least 0 s, got {seconds}.")
    console = Console()
    watch = Watch(robot)
    end = math.inf if seconds is None else time.monotonic() + seconds
    with ZenohFeed(zenoh, robot or "") if zenoh else LocalFeed(cell) as feed:
        feed.ask(Subscribe(rate=_RATE))
        try:
            if console.is_terminal:
                _live(console, feed, watch, end)
            else:
                for line in _lines(feed, watch, end):
                    result(line)
        except LinkError as error:
            note(str(error))


def _live(console: Any, feed: Any, watch: Watch, end: float) -> None:
    from rich.live import Live

    with Live(console=console, auto_refresh=False) as live:
        while time.monotonic() < end:
            _hear(feed, watch, 1.0 / _RATE)
            live.update(table(watch, time.time_ns()), refresh=True)


def _lines(feed: Any, watch: Watch, end: float) -> Any:
    told = 0
    while time.monotonic() < end:
        _hear(feed, watch, _LINES)
        yield from watch.lines(time.time_ns())
        for text in list(watch.events)[len(watch.events) - min(watch.told - told, len(watch.events)) :]:
            yield f"  {text}"
        told = watch.told


def _hear(feed: Any, watch: Watch, seconds: float) -> None:
    """Take what comes for a while."""
    due = time.monotonic() + seconds
    while feed.wait(due - time.monotonic()):
        watch.take(feed.receive())
        if time.monotonic() >= due:
            return


def table(watch: Watch, now_ns: int) -> RenderableType:
    """Return what is known as a table, a column per arm, with recording and events below.

    Parameters
    ----------
    watch : of the bridge. now_ns : wall clock.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    arms = watch.arms(now_ns)
    if not arms:
        return Text("No row yet: no packet of a robot has come.")
    shown = Table(title=f"Cell {watch.cell}")
    for k, arm in enumerate([{"arm": ""}, *arms]):
        shown.add_column(arm["arm"], no_wrap=k == 0)
    for key in list(arms[0])[1:]:
        shown.add_row(Text(key), *[Text(arm[key]) for arm in arms])  # brackets would be styles
    return Group(shown, Text("\n".join(watch.notes())))
