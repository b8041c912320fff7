"""Who has a port or a socket that is taken: `holder` and `program`, from what Linux shows of the processes."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Literal

__all__ = ["holder", "program"]

_LISTENING = "0A"  # state of a TCP socket in /proc/net/tcp


def holder(port: int, kind: Literal["udp", "tcp"] = "udp") -> str:
    """Return who holds a port, "process 4711 (armlab sim ...)", or "" when that cannot be told.

    Processes of other users stay hidden.

    Parameters
    ----------
    port : its number. kind : udp, or tcp for who listens there.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        inodes = _inodes(port, kind)
        for process in Path("/proc").iterdir():
            if process.name.isdigit() and _has_socket(process, inodes):
                return program(int(process.name))
    return ""


def program(process: int) -> str:
    """Return a process in words, "process 4711 (armlab sim ...)", without its command when that is hidden.

    Parameters
    ----------
    process : its number.
    """
    with contextlib.suppress(OSError), Path(f"/proc/{process}/cmdline").open("rb") as file:
        command = " ".join(file.read(200).replace(b"\0", b" ").decode(errors="replace").split())
        return f"process {process} ({command})"
    return f"process {process}"


def _inodes(port: int, kind: str) -> set[str]:
    with Path(f"/proc/net/{kind}").open(encoding="ascii") as file:
        rows = [line.split() for line in file.readlines()[1:]]
    mine = [row for row in rows if int(row[1].rpartition(":")[2], 16) == port]
    return {f"socket:[{row[9]}]" for row in mine if kind == "udp" or row[3] == _LISTENING}


def _has_socket(process: Path, inodes: set[str]) -> bool:
    with contextlib.suppress(OSError):
        return any(str(entry.readlink()) in inodes for entry in (process / "fd").iterdir())
    return False
