"""Printing: results to standard output, messages and what happens during a run to standard error."""

from __future__ import annotations

import json
import logging
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armlab._whole_files import whole_file
from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.log import Tick
    from armlab.state import Command, State


FIGURES = (".png", ".svg", ".pdf")


def result(text: str) -> None:
    """Write a line of result to standard output."""
    sys.stdout.write(f"{text}\n")


def note(text: str) -> None:
    """Write a message for the reader to standard error."""
    sys.stderr.write(f"{text}\n")


def print_json(data: Any) -> None:
    """Write data as JSON to standard output: arrays become lists, values that are not finite null."""
    sys.stdout.write(json.dumps(_plain(data), indent=2, ensure_ascii=False) + "\n")


def aligned(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Return rows of words as lines with aligned columns; `right` numbers the columns of figures."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    lines = []
    for row in rows:
        words = enumerate(zip(row, widths, strict=True))
        lines.append("  ".join(word.rjust(n) if i in right else word.ljust(n) for i, (word, n) in words).rstrip())
    return "\n".join(lines)


def refuse_overwrite(path: Path, force: bool) -> None:
    """Raise `ConfigError` when `path` exists and `force` is not set."""
    if path.exists() and not force:
        raise ConfigError(f"Expected a new file, got {path}, which exists. Choose another name or add --force.")


def check_output(path: Path, force: bool, endings: Sequence[str], inputs: Sequence[Path] = ()) -> None:
    """Raise `ConfigError` before the work begins when its result could not be written."""
    if path.suffix.lower() not in endings:
        raise ConfigError(f"Expected a file name that ends in {' or '.join(endings)}, got {path}. Change the ending.")
    if not path.parent.is_dir():
        raise ConfigError(f"Expected {path} in a folder that exists, got {path.parent}. Make the folder first.")
    if not os.access(path.parent, os.W_OK):
        raise ConfigError(f"Expected {path} in a folder that you may write to, got {path.parent}. Choose another.")
    for one in inputs:
        if path.exists() and one.exists() and (_holds(path, one) or _holds(one, path)):
            raise ConfigError(
                f"Expected a new file, got {path}, which is or holds what is read, {one}. Choose another name."
            )
    refuse_overwrite(path, force)


def _holds(outer: Path, inner: Path) -> bool:
    """Whether a file or folder is the other one, by whatever way, or has it inside."""
    place = inner.resolve()
    return any(outer.samefile(one) for one in (place, *place.parents))


def save_figure(drawn: Any, path: Path) -> None:
    """Write a figure; an existing file is replaced in one step or not at all."""
    figure = drawn if hasattr(drawn, "savefig") else drawn.get_figure(root=True)
    with whole_file(path) as part:
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=150)


@contextmanager
def progress(title: str) -> Iterator[Callable[[float, float, str], None]]:
    """Show a bar on standard error while the block runs; yields a function (done, total, what) that moves it.

    Where standard error is not a terminal, each new `what` is one line.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        last = ""

        def say(done: float, total: float, what: str) -> None:
            nonlocal last
            if what != last:
                note(f"{title}: {what}")
            last = what

        yield say
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(title, total=1.0)
        yield lambda done, total, what: bar.update(task, completed=done / total, description=f"{title}: {what}")


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if hasattr(data, "tolist"):  # of NumPy, which is not loaded for its sake
        return _plain(data.tolist())
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


_MCI_RUNNING = 3
_HOME = 0.05  # rad or m
_QUIET = logging.NullHandler()


class Narrator:
    """Writes the events of a run to standard error, and what a listener should know of the first packets."""

    def __init__(self, listens: bool = False, q_home: dict[str, list[float]] | None = None) -> None:
        self._listens, self._q_home = listens, dict(q_home or {})
        self._guided: set[str] = set()
        # Without a handler Python would write the warnings of the bridge to standard error, where they stand already.
        logging.getLogger("armlab.bridge").addHandler(_QUIET)

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        if self._listens and state.mci == _MCI_RUNNING and state.robot not in self._guided:
            self._guided.add(state.robot)
            note(
                f"warning: {state.robot} is in EGM guidance and waits for references. Nothing is sent here, so its "
                "controller will report 41822 and stop. To record motion by hand, let RAPID run EGMStreamStart only."
            )
        home = self._q_home.pop(state.robot, None)
        if home is None:
            return
        away = [abs(at - there) for at, there in zip(state.q.tolist(), home)]
        worst = max(range(len(away)), key=away.__getitem__)
        if away[worst] > _HOME:
            note(
                f"warning: {state.robot} does not begin in its home posture: joint {worst + 1} is {away[worst]:.2f} "
                "rad or m away. The log is as good, but a replay will begin where this one did."
            )

    def event(self, text: str, warn: bool = False) -> None:
        note(f"warning: {text}" if warn else text)
