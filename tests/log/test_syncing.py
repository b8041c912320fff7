"""A file is synced by a thread of its own."""

from __future__ import annotations

import errno
import threading

import pytest

from armlab.log.recording.recorder import Syncing


def test_who_asks_does_not_wait_for_the_disk() -> None:
    gate, reached, synced = threading.Event(), threading.Event(), []

    def slow() -> None:
        reached.set()
        gate.wait()
        synced.append(True)

    syncing = Syncing(slow, "sync")
    syncing.ask()
    reached.wait()  # it hangs in the disk
    syncing.ask()
    assert not synced
    gate.set()
    syncing.close()
    assert synced


def test_an_error_comes_to_who_asks_next() -> None:
    def broken() -> None:
        raise OSError(errno.EIO, "Input/output error")

    syncing = Syncing(broken, "sync")
    syncing.ask()
    syncing._thread.join()
    with pytest.raises(OSError, match="Input/output error"):
        syncing.ask()
    with pytest.raises(OSError, match="Input/output error"):
        syncing.close()
