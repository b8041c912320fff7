"""Lockstep soak test: `armlab run` and a simulated arm run as fast as possible and write one recording."""

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
"""Both ends of EGM over UDP; the arm has no masses, because its dynamics would take half of the processor time."""

_LOOK = 2.0  # s, maximum sampling period, so the last sample is near the end


def run(folder: Path, seconds: float, most: float) -> dict[str, Any]:
    """Run the test and return its description, see `series.description`.

    Parameters
    ----------
    folder : output folder. seconds : robot time [s]. most : wall-clock limit [s].
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
        begin = time.time_ns()
        with Watch(folder / "held.csv", min(seconds / 200.0, _LOOK), processes) as watch:
            cut_off = _wait(program, watch, folder, most)
            end = time.time_ns()
        status = program.end(signal.SIGINT)
    statuses = {"run": status}
    return {
        "part": "lockstep",
        "seconds": seconds,
        "begin": begin,
        "end": end,
        "cut_off": cut_off,
        "statuses": statuses,
    }


def _wait(program: Program, watch: Watch, folder: Path, most: float) -> str:
    """Wait until the program ends; return the reason for an early end, if any."""
    begin = time.monotonic()
    reported = begin
    try:
        print("  Running; Ctrl-C aborts the run, which is still assessed.", flush=True)
        while (status := program.process.poll()) is None:
            if time.monotonic() - begin > most:
                return "--most"
            if time.monotonic() - reported > 60.0:
                reported = time.monotonic()
                size = sum(path.stat().st_size for path in folder.glob("*.mcap"))
                print(f"  {reported - begin:.0f} s elapsed, {1e-6 * size:.0f} MB recorded", flush=True)
            watch.pause(0.1)
    except KeyboardInterrupt:
        return "a signal"
    return "a signal" if status < 0 or status == 128 + signal.SIGINT else ""
