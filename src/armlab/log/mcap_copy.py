"""Parts of MCAP files go into a new one, which is whole or is not there."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from armlab.errors import LogError
from armlab.log.mcap_chunk import Chunk, unpacked
from armlab.log.mcap_records import MESSAGE, Channel, Contents, records
from armlab.log.mcap_writer import McapWriter

__all__ = ["Registry", "messages_in", "new_file", "pieces", "records_at"]

_MESSAGE = struct.Struct("<HIQQ")


@contextlib.contextmanager
def new_file(target: Path, part: Path, *, replace: bool) -> Iterator[BinaryIO]:
    """Open a file under another name; it gets its own when the block has ended well, else nothing is left.

    Parameters
    ----------
    target : the file. part : name until it is whole, in the same folder; must be free.
    replace : a file that exists is replaced; else it is refused, also one that comes in the meantime.

    Raises
    ------
    LogError : it cannot be created or written, or exists.
    """
    try:
        file = part.open("xb", buffering=0)  # never over a file, which may be the one that is read
    except OSError as error:
        raise LogError(f"Expected to create {part}, got: {error.strerror}.") from None
    try:
        with file:
            yield file
            os.fsync(file.fileno())
        part.replace(target) if replace else _rename(part, target)
    except OSError as error:
        raise LogError(f"Expected to write {target}, got: {error.strerror}.") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


def _rename(part: Path, target: Path) -> None:
    """Give the finished copy its name, unless something has got it in the meantime.

    Raises
    ------
    FileExistsError : it has. OSError : the name cannot be given.
    """
    try:
        os.link(part, target)  # never over a file, as a rename would
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        target.open("xb").close()
        part.replace(target)


class Registry:
    """Schemas and channels of a new file: a schema that comes again is not written again.

    Parameters
    ----------
    writer : of the file.
    """

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._schemas: dict[tuple[str, str, str], int] = {}

    def channel(self, channel: Channel) -> int:
        """Write a channel and return its number in the new file."""
        key = (channel.type, channel.schema_encoding, channel.schema)
        if key not in self._schemas:
            self._schemas[key] = self._writer.schema(key[0], key[1], key[2].encode(errors="surrogateescape"))
        return self._writer.channel(channel.topic, channel.encoding, self._schemas[key], channel.metadata)


def pieces(found: Contents) -> list[Chunk | None]:
    """Return what the messages of a file are in: the chunks, then None for those outside them, if any.

    `decode` reads them in this order too: rows of a copy stay in the order in which the file itself is read.
    """
    return [*found.chunks, *([None] if found.loose else [])]


def records_at(view: memoryview, found: Contents, piece: Chunk | None) -> bytes | None:
    """Return the records of a piece, None when it is damaged."""
    if piece is None:
        return b"".join(bytes(view[start - 9 : stop]) for start, stop in found.loose)
    try:
        return unpacked(view, piece)
    except LogError:
        return None


def messages_in(data: bytes) -> Iterator[tuple[int, int, int, int, bytes]]:
    """Yield (channel, sequence, log time, publish time, message) of the messages among records."""
    for kind, start, stop in records(memoryview(data), 0, len(data)):
        if kind == MESSAGE and stop - start >= _MESSAGE.size:
            yield (*_MESSAGE.unpack_from(data, start), data[start + _MESSAGE.size : stop])
