"""Programs started by a soak test, with output to files; none outlives the test."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from armlab.errors import ArmlabError

__all__ = ["Program"]

_PATIENCE = 90.0  # s, because twenty programs start simultaneously
_LOOK = 0.05  # s


class Program:
    """Context manager for a program whose standard output and error are ``NAME.out`` and ``NAME.err`` in a folder."""

    def __init__(self, name: str, command: Sequence[str], folder: Path, environment: Mapping[str, str] = {}) -> None:
        self.name, self.out, self.err = name, folder / f"{name}.out", folder / f"{name}.err"
        with self.out.open("w") as out, self.err.open("w") as err:
            self.process = subprocess.Popen(
                list(command),
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,  # Ctrl-C reaches only the soak test
            )

    def __enter__(self) -> Program:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def said(self) -> str:
        """Return the complete output."""
        return self.out.read_text(errors="replace") + self.err.read_text(errors="replace")

    def await_word(self, word: str) -> None:
        """Wait until the program has printed a word.

        Raises
        ------
        ArmlabError : the program ended first, or did not print the word in time.
        """
        until = time.monotonic() + _PATIENCE
        while word not in self.said():
            if self.process.poll() is not None or time.monotonic() > until:
                raise ArmlabError(f"Expected {self.name} to print {word!r}, got: {self.said()[-1000:]}")
            time.sleep(_LOOK)

    def end(self, number: int = signal.SIGTERM) -> int:
        """Terminate the program, wait for it to exit, and return its exit status.

        Raises
        ------
        TimeoutExpired : the program did not end.
        """
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(_PATIENCE)
