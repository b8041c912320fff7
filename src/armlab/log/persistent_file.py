"""`PersistentFile`: a file that stays writable when other code in this process closes its descriptor."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

from armlab._descriptors import Descriptor, apart

__all__ = ["PersistentFile"]

_FLAGS = os.O_WRONLY | getattr(os, "O_CLOEXEC", 0)


class PersistentFile:
    """A new file, opened for writing, not buffered.

    Each call looks first whether the descriptor still belongs to the file. If not, the file is opened again by its
    path, and writing goes on at the same place.

    Parameters
    ----------
    path : file that does not exist.

    Attributes
    ----------
    name : absolute path. closed : whether `close` was called.

    Raises
    ------
    FileExistsError : the file exists. OSError : by every method, when the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.name = str(Path(path).absolute())
        self.closed = False
        self._at = 0
        self._lock = threading.Lock()  # of the descriptor: threads that write and sync may both find it closed
        self._descriptor = Descriptor(os.open(self.name, _FLAGS | os.O_CREAT | os.O_EXCL, 0o666))

    def fileno(self) -> int:
        """Return the descriptor, which may be another one next time."""
        with self._lock:
            if self.closed:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            if not self._descriptor.is_open:
                self._descriptor = self._reopened()
            return self._descriptor.number

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Write, and return how many bytes the system took."""
        done = os.write(self.fileno(), data)
        self._at += done
        return done

    def seek(self, at: int) -> int:
        """Go on at another place, counted in bytes from the beginning."""
        self._at = os.lseek(self.fileno(), at, os.SEEK_SET)
        return self._at

    def truncate(self, size: int) -> int:
        """Cut the file to a size; the place stays."""
        os.ftruncate(self.fileno(), size)
        return size

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        with self._lock:
            self._descriptor.close()
            self.closed = True

    def _reopened(self) -> Descriptor:
        number = apart(os.open(self.name, _FLAGS))
        if not self._descriptor.same_file(number):
            os.close(number)
            raise FileNotFoundError(errno.ENOENT, "its descriptor was closed, and another file has its name")
        os.lseek(number, self._at, os.SEEK_SET)
        return Descriptor(number)
