"""`Syncing`: a file is brought to the disk by a thread of its own, so that nobody who writes waits for the disk."""

from __future__ import annotations

import threading
from collections.abc import Callable

__all__ = ["Syncing"]


class Syncing:
    """Thread that syncs a file when asked.

    What is written while the disk is slow is in the kernel's memory: it survives the end of the process, and goes to
    the disk with the next sync.

    Parameters
    ----------
    sync : brings the file to the disk; called in the thread. name : of the thread.
    """

    def __init__(self, sync: Callable[[], None], name: str) -> None:
        self._sync = sync
        self._asked = threading.Event()
        self._closed = False
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ask(self) -> None:
        """Have the file synced soon.

        Raises
        ------
        OSError : an earlier sync has failed.
        """
        self._check()
        self._asked.set()

    def close(self) -> None:
        """End the thread, after the sync in progress.

        Raises
        ------
        OSError : a sync has failed; the kernel says so once, so that the next one seems to do well.
        """
        self._closed = True
        self._asked.set()
        self._thread.join()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            while True:
                self._asked.wait()
                self._asked.clear()
                if self._closed:
                    return
                self._sync()
        except OSError as error:
            self._error = error
