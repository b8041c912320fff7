"""Other programs that show recordings: which are installed, and how one gets them."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from armlab.errors import ConfigError, LogError, MissingExtra

__all__ = ["VIEWERS", "Viewer", "check_finished", "chosen", "started"]


@dataclass(frozen=True, slots=True)
class Viewer:
    """A program that opens MCAP files.

    Attributes
    ----------
    title, program : its name, and that of its command. arguments : before the file. source : how one gets it.
    remark : what one should know before it opens.
    """

    title: str
    program: str
    arguments: tuple[str, ...]
    source: str
    remark: str = ""


VIEWERS = {
    "foxglove": Viewer("Foxglove", "foxglove-studio", (), "its desktop program is at foxglove.dev/download"),
    "plotjuggler": Viewer("PlotJuggler", "plotjuggler", ("-d",), "its packages are listed at plotjuggler.io"),
    "rerun": Viewer(
        "Rerun",
        "rerun",
        ("--bind", "127.0.0.1"),  # its default is every interface
        "pip install rerun-sdk, in an environment of its own",
        " It may call hosts outside; `rerun analytics disable` says no.",
    ),
}


def check_finished(file: Path) -> None:
    """Check that a file is a recording that was finished: these programs need its end.

    Raises
    ------
    LogError : it is not; says what to do.
    """
    from armlab import log as logs

    if not logs.inspect(file).finished:
        raise LogError(
            f"Expected a finished recording, got {file}, which was cut off, and which other programs do not open. Make "
            f"it whole: armlab log recover {file}."
        )


def chosen(wanted: Sequence[str]) -> tuple[Viewer, str]:
    """Return the program to open a recording with, and where it is.

    Parameters
    ----------
    wanted : names of viewers; none for the first that is installed.

    Raises
    ------
    ConfigError : several. MissingExtra : it is not installed; says which are, and how to get one.
    """
    if len(wanted) > 1:
        raise ConfigError(f"Expected one program to open the log with, got {' and '.join(wanted)}. Leave one out.")
    places = {name: shutil.which(viewer.program) for name, viewer in VIEWERS.items()}
    for name in wanted or VIEWERS:
        place = places[name]
        if place is not None:
            return VIEWERS[name], place
    there = ", ".join(VIEWERS[name].title for name, place in places.items() if place) or "none of these programs"
    missing = "; ".join(f"{VIEWERS[name].title}: {VIEWERS[name].source}" for name in wanted or VIEWERS)
    what = VIEWERS[wanted[0]].title if wanted else "Foxglove, PlotJuggler or Rerun"
    raise MissingExtra(f"Expected {what} on the PATH, got {there}. How to get it: {missing}.")


def started(viewer: Viewer, program: str, file: Path) -> int:
    """Run a program on a file until it ends, and return its exit code."""
    return subprocess.run([program, *viewer.arguments, str(file.absolute())], check=False).returncode
