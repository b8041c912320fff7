"""`Simulator`: the simulated robots as a process, started for a link and stopped with it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress

from armlab._descriptors import Descriptor
from armlab.errors import LinkError

__all__ = ["Simulator"]

_KEPT_LINES = 20
_PATIENCE = 5.0  # s to end by itself before it is killed


class Simulator:
    """One ``python -m armlab sim`` process that sends to ports of this computer.

    It gets its own process group, so that Ctrl-C reaches the bridge alone, which brings the arm to rest first.

    Parameters
    ----------
    robots : names in the library, or robot files. ports : where each shall send.
    options : further options by name: "seed" -> "1" becomes ``--seed 1``; "true" a bare ``--name``.

    Attributes
    ----------
    lines : the last lines it wrote.
    """

    def __init__(self, robots: Sequence[str], ports: Sequence[int], options: Mapping[str, str]) -> None:
        to = ",".join(f"127.0.0.1:{port}" for port in ports)
        arguments = [sys.executable, "-m", "armlab", "sim", *robots, "--to", to, "--extension"]
        for name, value in options.items():
            if value.lower() != "false":
                arguments += [f"--{name}"] if value.lower() in ("", "true") else [f"--{name}", value]
        self._command = " ".join(["armlab", *arguments[3:]])
        arguments += ["--parent", str(os.getpid())]  # told, not found: this process may end before the other looks
        self.lines: deque[str] = deque(maxlen=_KEPT_LINES)
        number, errors = os.pipe()
        self._errors = Descriptor(number)
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        )
        os.close(errors)
        self._reader = threading.Thread(target=self._read, name="simulator messages", daemon=True)
        self._reader.start()

    def gone(self) -> str:
        """Return why it has ended, "" while it runs.

        Raises
        ------
        LinkError : it ended with an error; quotes what it wrote.
        """
        status = self._process.poll()
        if status is None:
            return ""
        self._reader.join(_PATIENCE)
        if status == 0:
            return "the simulated robot ended"
        said = " ".join(line for line in self.lines if line) or "nothing"
        raise LinkError(f"Expected `{self._command}` to go on, but it ended with status {status}. It said: {said}")

    def stop(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._reader.join(_PATIENCE)
        self._errors.close()

    def _read(self) -> None:
        with suppress(OSError), os.fdopen(self._errors.number, errors="replace", closefd=False) as file:
            for line in file:
                self.lines.append(line.strip())
