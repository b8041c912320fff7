"""The soak in lockstep: `armlab run` and a simulated arm, both as fast as they can, with a recording in one file."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from soak.processes import Watch, family, label
from soak.programs import Program

__all__ = ["LINK", "run"]

LINK = "sim://yumi_left?lockstep=true&lagging=true"
"""Both ends of EGM as bytes in datagrams; the arm has no masses, since its dynamics would take half of the time."""

_LOOK = 10.0  # s between two looks at the processes, at most


def run(folder: Path, seconds: float, most: float) -> dict[str, Any]:
    """Run it and return what is told of it, see `series.told`.

    Parameters
    ----------
    folder : for all that it leaves. seconds : of robot time. most : s of the wall clock after which it is ended.
    """
    sway = Path(__file__).with_name("sway.py")
    words = [sys.executable, "-m", "armlab", "run", "yumi_left", str(sway), "--link", LINK]
    words += ["--seconds", str(seconds), "--log", str(folder / "run")]
    with Program("run", words, folder) as program:

        def processes() -> Iterator[tuple[int, str]]:
            for pid in family(program.process.pid):
                with contextlib.suppress(OSError):
                    yield pid, label(pid, program.process.pid)

        program.await_word("ready")
        print(f"  Runs; `kill -INT {program.process.pid}` ends it early, and it is judged all the same.", flush=True)
        begin = time.time_ns()
        with Watch(folder / "held.csv", min(seconds / 200.0, _LOOK), processes):
            _wait(program, folder, most)
            end = time.time_ns()
        status = program.end(signal.SIGINT)
    return {"part": "lockstep", "begin": begin, "end": end, "statuses": {"run": status}}


def _wait(program: Program, folder: Path, most: float) -> None:
    begin = time.monotonic()
    told = begin
    while program.process.poll() is None and time.monotonic() - begin < most:
        if time.monotonic() - told > 60.0:
            told = time.monotonic()
            size = sum(path.stat().st_size for path in folder.glob("*.mcap"))
            print(f"  {told - begin:.0f} s of the wall clock, {1e-6 * size:.0f} MB recorded", flush=True)
        time.sleep(0.1)
