"""``armlab monitor``: a bridge that runs, in the terminal."""

from __future__ import annotations

import math
import shutil
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from armlab.errors import ConfigError, LinkError, UnknownName

if TYPE_CHECKING:
    from rich.console import RenderableType

    from armlab.bridge.row import Row

__all__ = ["Watch", "monitor"]

_RATE = 10.0  # Hz of the display
_LINES = 1.0  # s between two lines where there is no terminal
_SILENT = 0.5  # s after which an arm sends no packets
_EVENTS = 8


def monitor(robot: str | None = None, *, cell: str = "", seconds: float | None = None) -> None:
    """Watch a bridge of this user that runs, until Ctrl-C or its end.

    Parameters
    ----------
    robot
        Show this arm only.
    cell
        Name of the cell; needed when several run.
    seconds
        Time after which to end [s].
    """
    from rich.console import Console

    from armlab.bridge.local import LocalFeed
    from armlab.bridge.messages import Subscribe
    from armlab.cli.output import note, result

    if seconds is not None and not seconds >= 0.0:
        raise ConfigError(f"Expected seconds of at least 0 s, got {seconds}.")
    console = Console()
    watch = Watch(robot)
    end = math.inf if seconds is None else time.monotonic() + seconds
    with LocalFeed(cell) as feed:
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
            live.update(watch.table(time.time_ns()), refresh=True)


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


class Watch:
    """What is known of a bridge from its messages, in words.

    Parameters
    ----------
    robot : show this arm only; None shows all.

    Attributes
    ----------
    events : the last, with their times. told : events so far.
    """

    def __init__(self, robot: str | None = None) -> None:
        self._robot = robot
        self._about: dict[str, Any] = {}
        self._status: dict[str, Any] = {}
        self._row: Row | None = None
        self._files: list[Path] = []
        self._sizes: tuple[float, int] | None = None
        self.events: deque[str] = deque(maxlen=_EVENTS)
        self.told = 0

    def take(self, message: Row | dict[str, Any]) -> None:
        """Take one message of the local feed.

        Raises
        ------
        UnknownName : the arm to show is not in this cell.
        """
        if not isinstance(message, dict):
            self._row = message
            if self._robot is not None and f"{self._robot}.q" not in message.values:
                known = [name.partition(".")[0] for name in message.values if name.endswith(".commander")]
                raise UnknownName.among("robot of this cell", self._robot, known)
        elif message["kind"] == "about":
            self._about = message
        elif message["kind"] == "status":
            self._status = message
        elif message["kind"] == "recording":
            self._files, self._sizes = [Path(file) for file in message["files"]], None
        elif message["kind"] == "event":
            stamp = time.strftime("%H:%M:%S", time.localtime(1e-9 * message["stamp_ns"]))
            self.events.append(f"{stamp} {message['text']}")
            self.told += 1

    def arms(self, now_ns: int) -> list[dict[str, str]]:
        """Return what there is to say of each arm, by heading.

        Parameters
        ----------
        now_ns : wall clock.
        """
        if self._row is None:
            return []
        names = [name.removesuffix(".commander") for name in self._row.values if name.endswith(".commander")]
        return [self._arm(name, now_ns) for name in names if self._robot in (None, name)]

    def _arm(self, name: str, now_ns: int) -> dict[str, str]:
        values = {key.partition(".")[2]: value for key, value in self._row.values.items() if key.startswith(f"{name}.")}  # type: ignore[union-attr]
        status = self._status.get("arms", {}).get(name, {})
        trips = " / ".join(_number(status.get(key), "{:.0f}") for key in ("p50", "p99", "longest"))
        wrench = values["wrench"] if math.isfinite(values["wrench"][0]) else values["wrench_hat"]
        has_wrench = math.isfinite(wrench[0])
        clamps = [f"{kind} {' '.join(map(str, n))}" for kind, n in status.get("clamps", {}).items() if any(n)]
        return {
            "arm": name,
            "state": _state(values, now_ns),
            "rate [Hz]": _number(status.get("rate"), "{:.1f}"),
            "p50 / p99 / max [us]": trips,
            "missed": str(status.get("missed", "-")),
            "late": str(status.get("late", "-")),
            "refused packets": str(status.get("drops", "-")),
            "force [N]": " ".join(f"{one:.1f}" for one in wrench[:3]) if has_wrench else "-",
            "moment [N m]": " ".join(f"{one:.2f}" for one in wrench[3:]) if has_wrench else "-",
            "clamps per joint": "; ".join(clamps) or "none",
            "commander": values["commander"] or "nobody",
        }

    def recording(self) -> str:
        """Return the files of the recording, their size, and for how long the disk has room."""
        sizes = [file.stat().st_size for file in self._files if file.exists()]
        if not sizes:
            return "none"
        total, now = sum(sizes), time.monotonic()
        if self._sizes is None:
            self._sizes = (now, total)
        seconds, grown = now - self._sizes[0], total - self._sizes[1]
        room = shutil.disk_usage(self._files[0].parent).free
        hours = f", room for {room / grown * seconds / 3600.0:.0f} h" if grown > 0 else ""
        return f"{', '.join(str(file) for file in self._files)}: {1e-6 * total:.1f} MB{hours}"

    def lines(self, now_ns: int) -> list[str]:
        """Return one line per arm.

        Parameters
        ----------
        now_ns : wall clock.
        """
        return [
            ", ".join(value if key == "arm" else f"{key} {value}" for key, value in arm.items())
            for arm in self.arms(now_ns)
        ] or ["No row yet: no packet of a robot has come."]

    def table(self, now_ns: int) -> RenderableType:
        """Return the same as a table, a column per arm, with recording and events below.

        Parameters
        ----------
        now_ns : wall clock.
        """
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        arms = self.arms(now_ns)
        if not arms:
            return Text("No row yet: no packet of a robot has come.")
        table = Table(title=f"Cell {self._about.get('cell', '')}")
        for k, arm in enumerate([{"arm": ""}, *arms]):
            table.add_column(arm["arm"], no_wrap=k == 0)
        for key in list(arms[0])[1:]:
            table.add_row(Text(key), *[Text(arm[key]) for arm in arms])  # brackets would be styles
        lost = self._status.get("lost", 0)
        notes = [f"Recording: {self.recording()}", *([f"Rows lost by this feed: {lost}"] if lost else []), *self.events]
        return Group(table, Text("\n".join(notes)))


def _state(values: dict[str, Any], now_ns: int) -> str:
    """Return what the arm does, or why it cannot move."""
    from armlab.bridge.readiness import obstacle

    age = 1e-9 * (now_ns - values["receive_ns"])
    if age > _SILENT:
        return f"no packet for {age:.1f} s"
    why = obstacle(SimpleNamespace(motors=values["motors"], rapid=values["rapid"], mci=values["mci"]))  # type: ignore[arg-type]
    if why:
        return why
    if values["seq_sent"] < 0:
        return "listening"
    asked = math.isfinite(values["q_ref"][0]) or math.isfinite(values["qd_ref"][0])
    return "running" if asked else "holding"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None or not math.isfinite(value) else form.format(value)
