"""A file is synced by a thread of its own."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import pytest

from armlab.log.syncing import Syncing


def test_who_asks_does_not_wait_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, reached, synced = threading.Event(), threading.Event(), []

    def slow(number: int) -> None:
        reached.set()
        gate.wait()
        synced.append(os.fstat(number).st_size)

    monkeypatch.setattr(os, "fsync", slow)
    with (tmp_path / "run").open("wb", buffering=0) as file:
        syncing = Syncing(file.fileno(), "sync")
        syncing.ask()
        reached.wait()  # it hangs in the disk
        file.write(b"123")
        syncing.ask()
    gate.set()  # the file is closed by now
    syncing.close()
    assert synced[0] == 3


def test_an_error_comes_to_who_asks_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    with (tmp_path / "run").open("wb") as file:
        syncing = Syncing(file.fileno(), "sync")
        syncing.ask()
        syncing._thread.join()
        with pytest.raises(OSError, match="Input/output error"):
            syncing.ask()
        with pytest.raises(OSError, match="Input/output error"):
            syncing.close()
