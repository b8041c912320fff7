"""Programs at the ends of a path: `Reader`, `Writer`, and the processor time of a process and its children."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from machine import family

from armlab.errors import ArmlabError

SETTLED = 2.0  # s excluded after the first message
PATIENCE = 60.0  # s
LAST = 0.1  # s excluded before the last joint state, whose wrench may still be in transit
NEAR = 1000  # ns, tolerance for stamps in microseconds, or in seconds as float


class Received(NamedTuple):
    """Messages received by a reader: latencies [s], messages in order, and messages due."""

    latency: np.ndarray
    received: int
    due: int

    @property
    def missing(self) -> float:
        """Share of messages that did not arrive or arrived out of order."""
        return 1.0 - self.received / self.due


class Reader:
    """Context manager for a reading program."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._out = tempfile.TemporaryFile()  # noqa: SIM115 - a full pipe would stop it
        self._command = list(command)
        self.process = subprocess.Popen(
            self._command, env={**os.environ, **environment}, stdout=self._out, stderr=subprocess.PIPE
        )

    def __enter__(self) -> Reader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _killed(self.process)
        self._out.close()

    def begun(self) -> None:
        """Wait for the first message."""
        _wait_for("reading", self.process, self._command)

    def wait(self, seconds: float) -> bool:
        """Return whether the program ends by itself in time."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)
        return self.process.poll() is not None

    def received(self, sent: np.ndarray, kinds: str = "JW") -> Received:
        """Return the received messages of these kinds with these stamps once the reader has ended.

        All kinds are counted from `SETTLED` after the first joint state until shortly before the last.
        """
        self._out.seek(0)
        lines = self._out.read().decode().splitlines()
        found = {
            kind: np.array([line.split()[1:3] for line in lines if line.startswith(kind)], dtype=np.int64).reshape(
                -1, 2
            )
            for kind in kinds
        }
        if len(found["J"]) < 2:
            raise ArmlabError(f"Expected joint states, got {len(found['J'])} from {' '.join(self._command)[:200]}.")
        begin, end = found["J"][0, 0] + round(1e9 * SETTLED), found["J"][-1, 0] - round(1e9 * LAST)
        due = int(np.sum((sent >= begin - NEAR) & (sent <= end + NEAR)))
        counted = [one[(one[:, 0] >= begin) & (one[:, 0] <= end)] for one in found.values()]
        received = sum(int(np.sum(np.diff(one[:, 0], prepend=0) > 0)) for one in counted)
        latency = np.concatenate([1e-9 * (one[:, 1] - one[:, 0]) for one in counted])
        return Received(latency, received, due * len(kinds))


class Writer:
    """Context manager for a bare publisher that is ready to send."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._out = tempfile.TemporaryFile()  # noqa: SIM115 - as above
        self._command = list(command)
        self.process = subprocess.Popen(
            self._command,
            env={**os.environ, **environment},
            stdin=subprocess.PIPE,
            stdout=self._out,
            stderr=subprocess.PIPE,
        )

    def __enter__(self) -> Writer:
        _wait_for("ready", self.process, self._command)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _killed(self.process)
        self._out.close()

    def end(self) -> np.ndarray:
        """Stop the program, and return the stamps that it sent."""
        self.process.communicate(timeout=PATIENCE)
        self._out.seek(0)
        return np.array(self._out.read().split(), dtype=np.int64)


def _killed(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stderr):
        if pipe is not None:
            pipe.close()


def _wait_for(word: str, process: subprocess.Popen[bytes], command: Sequence[str]) -> None:
    """Wait until a program prints a word to standard error."""
    pipe, said, until = process.stderr, b"", time.monotonic() + PATIENCE
    while word.encode() not in said:
        part = b""
        if pipe is not None and select.select([pipe], [], [], max(0.0, until - time.monotonic()))[0]:
            part = os.read(pipe.fileno(), 4096)
        if not part:
            words = " ".join(said.decode(errors="replace").split()[-40:])
            raise ArmlabError(f"Expected {' '.join(command)[:200]} to print {word!r}, but it did not. Output: {words}")
        said += part


def processor_time(process: int) -> float:
    """Return the processor time [s] of a process and its children."""
    total = 0.0
    for one in family(process):
        with contextlib.suppress(OSError):
            words = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
            total += (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    return total


def usage(process: int, reader: Reader, most: float) -> float:
    """Return a process's processor time per second, from `SETTLED` after a reader's first message until its end."""
    reader.begun()
    time.sleep(SETTLED)
    before, began = processor_time(process), time.monotonic()
    used = passed = 0.0
    while not reader.wait(0.25) and passed < most:
        used, passed = processor_time(process) - before, time.monotonic() - began
    if not passed:
        raise ArmlabError("Expected a reader to read for some time, but it ended immediately.")
    return used / passed
