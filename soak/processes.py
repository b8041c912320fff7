"""Resources of a program and its descendants: private memory, descriptors, threads and processor time.

Memory is anonymous (heap, stacks) or swapped; mapped file pages are excluded, because they depend on the cache.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TextIO

from armlab.errors import ArmlabError

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))

from machine import family

__all__ = ["COLUMNS", "Sample", "Watch", "family", "held", "label"]

HEAD = "t,process,memory,descriptors,threads,cpu"
COLUMNS = ("memory", "descriptors", "threads")
"""Assessed quantities per process."""


class Sample(NamedTuple):
    """Resources of a process at a time [s since monitoring began]: bytes, counts, and seconds of processor time."""

    t: float
    process: str
    memory: int
    descriptors: int
    threads: int
    cpu: float


def held(pid: int) -> tuple[int, int, int, float]:
    """Return memory, descriptors, threads and processor time.

    Raises
    ------
    OSError : the process has ended.
    """
    place = Path(f"/proc/{pid}")
    lines = (line.split() for line in (place / "smaps_rollup").read_text().splitlines()[1:])
    sizes = {words[0]: int(words[1]) for words in lines}
    words = (place / "stat").read_text().rpartition(")")[2].split()
    cpu = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    memory = 1024 * (sizes["Anonymous:"] + sizes["Swap:"])
    return memory, len(list((place / "fd").iterdir())), int(words[17]), cpu


def label(pid: int, root: int) -> str:
    """Return the role of a process of a bridge.

    Raises
    ------
    OSError : the process has ended or has not started.
    """
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    if not words[0]:
        raise ProcessLookupError(f"Expected a running process, got {pid}, which has no command line.")
    if "armlab.bridge.servers.serve" in words:
        return f"server {words[words.index('armlab.bridge.servers.serve') + 1]}"
    if "sim" in words[:4]:
        return "simulator"
    if pid == root:
        return "loop and recorder"
    scripts = [Path(word).stem for word in words if word.endswith(".py")]
    return f"program {(scripts or [Path(words[0]).name])[0]}"


class Watch:
    """Context manager that samples processes into a file from a thread, every few seconds and at the end.

    Parameters
    ----------
    path : output file, one line per sample. period : time between samples [s].
    processes : function that returns the pid and name of each process, called for every sample.
    """

    def __init__(self, path: Path, period: float, processes: Callable[[], Iterator[tuple[int, str]]]) -> None:
        self._path, self._period, self._processes = path, period, processes
        self._over = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._over.set()
        self._thread.join()
        if kind is None:
            self._check()

    def pause(self, seconds: float) -> None:
        """Wait for a time [s] while monitoring continues.

        Raises
        ------
        ArmlabError : monitoring has failed.
        """
        self._thread.join(seconds)
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            text = f"Expected to sample the processes until the end, got {self._error!r}. Rerun the test."
            raise ArmlabError(text) from self._error

    def _run(self) -> None:
        try:
            self._look_again_and_again()
        except Exception as error:  # any error is reported to the waiting caller
            self._error = error

    def _look_again_and_again(self) -> None:
        start, is_last = time.monotonic(), False
        with self._path.open("w") as file:
            file.write(HEAD + "\n")
            while not is_last:
                is_last = self._over.is_set()
                self._look(file, time.monotonic() - start)
                self._over.wait(self._period)

    def _look(self, file: TextIO, t: float) -> None:
        for pid, name in self._processes():
            try:
                memory, descriptors, threads, cpu = held(pid)
            except OSError:  # the process has ended
                continue
            file.write(f"{t:.2f},{name},{memory},{descriptors},{threads},{cpu:.2f}\n")
        file.flush()
