"""Printing: results to standard output, messages and run events to standard error."""

from __future__ import annotations

import json
import logging
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armlab._files import whole_file
from armlab.cli import DOUBTFUL, FAILED
from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.bridge.doctor.machine import Finding
    from armlab.log import Tick
    from armlab.state import Command, State

FIGURES = (".png", ".svg", ".pdf")


def result(text: str) -> None:
    """Write a result line to standard output."""
    sys.stdout.write(f"{text}\n")


def note(text: str) -> None:
    """Write a message for the user to standard error."""
    sys.stderr.write(f"{text}\n")


def print_json(data: Any) -> None:
    """Write data as JSON to standard output: arrays become lists, non-finite values null."""
    sys.stdout.write(json.dumps(_plain(data), indent=2, ensure_ascii=False) + "\n")


def aligned(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Return rows of text with aligned columns; `right` lists the indices of right-aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    lines = []
    for row in rows:
        words = enumerate(zip(row, widths, strict=True))
        lines.append("  ".join(word.rjust(n) if i in right else word.ljust(n) for i, (word, n) in words).rstrip())
    return "\n".join(lines)


def refuse_overwrite(path: Path, force: bool) -> None:
    """Raise `ConfigError` if `path` exists and `force` is not set."""
    if path.exists() and not force:
        raise ConfigError(f"Expected a new file, but {path} already exists. Choose another name or add --force.")


def check_output(path: Path, force: bool, endings: Sequence[str], inputs: Sequence[Path] = ()) -> None:
    """Raise `ConfigError` before any computation if the result cannot be written."""
    if path.suffix.lower() not in endings:
        raise ConfigError(
            f"Expected a file name that ends in {' or '.join(endings)}, got {path}. Change the file extension."
        )
    if not path.parent.is_dir():
        raise ConfigError(
            f"Expected {path} in an existing folder, but {path.parent} does not exist. Create the folder first."
        )
    if not os.access(path.parent, os.W_OK):
        raise ConfigError(
            f"Expected {path} in a writable folder, but {path.parent} is not writable. Choose another folder."
        )
    for one in inputs:
        if path.exists() and one.exists() and (_holds(path, one) or _holds(one, path)):
            raise ConfigError(
                f"Expected a new file, got {path}, which is or contains the input {one}. Choose another name."
            )
    refuse_overwrite(path, force)


def _holds(outer: Path, inner: Path) -> bool:
    """Return whether the outer path is the inner path or contains it, after resolving links."""
    place = inner.resolve()
    return any(outer.samefile(one) for one in (place, *place.parents))


def save_figure(drawn: Any, path: Path) -> None:
    """Write a figure atomically."""
    figure = drawn if hasattr(drawn, "savefig") else drawn.get_figure(root=True)
    with whole_file(path) as part:
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=150)


@contextmanager
def progress(title: str) -> Iterator[Callable[[float, float, str], None]]:
    """Show a progress bar on standard error during the block; yields its callback (done, total, step).

    If standard error is not a terminal, each new step is printed on a separate line.
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
    percent = TextColumn("{task.percentage:3.0f} %")
    with Progress(TextColumn("{task.description}"), BarColumn(), percent, TimeElapsedColumn(), console=console) as bar:
        task = bar.add_task(title, total=1.0)
        yield lambda done, total, what: bar.update(task, completed=done / total, description=f"{title}: {what}")


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if hasattr(data, "tolist"):  # a NumPy value, recognised without importing NumPy
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
    """Feed that prints the events of a run to standard error, with warnings about its first packets."""

    def __init__(self, listens: bool = False, q_home: dict[str, list[float]] | None = None) -> None:
        self._listens, self._q_home = listens, dict(q_home or {})
        self._guided: set[str] = set()
        # Without a handler, Python would print the warnings of the bridge a second time.
        logging.getLogger("armlab.bridge").addHandler(_QUIET)

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        if self._listens and state.mci == _MCI_RUNNING and state.robot not in self._guided:
            self._guided.add(state.robot)
            note(
                f"warning: {state.robot} is in EGM guidance and waits for references. This command sends nothing, so "
                "the controller will report event 41822 and stop. To record lead-through motion, let RAPID run only "
                "EGMStreamStart."
            )
        home = self._q_home.pop(state.robot, None)
        if home is None:
            return
        away = [abs(at - there) for at, there in zip(state.q.tolist(), home)]
        worst = max(range(len(away)), key=away.__getitem__)
        if away[worst] > _HOME:
            note(
                f"warning: {state.robot} does not start in its home posture: joint {worst + 1} is {away[worst]:.2f} "
                "rad or m away. The log is valid, but a replay will "
                "start from this posture instead of the home posture."
            )

    def event(self, text: str, warn: bool = False) -> None:
        note(f"warning: {text}" if warn else text)


def print_findings(findings: list[Finding], json: bool) -> int:
    """Print findings and return the exit code."""
    verdicts = [finding.verdict for finding in findings]
    if json:
        print_json([asdict(finding) for finding in findings])
    else:
        width = max(len(finding.name) for finding in findings)
        for finding in findings:
            result(f"{finding.verdict:7}  {finding.name:{width}}  {finding.value}")
            if finding.advice:
                result(f"{'':7}  {'':{width}}  -> {finding.advice}")
        result(", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in ("ok", "warning", "failure")))
    return FAILED if "failure" in verdicts else DOUBTFUL if "warning" in verdicts else 0
