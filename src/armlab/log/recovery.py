"""`recover`: an unfinished or damaged recording becomes a whole file, the original untouched."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from armlab.errors import LogError
from armlab.log.formats import check_readable
from armlab.log.mcap_chunk import unpacked
from armlab.log.mcap_records import CHUNK, MESSAGE, Contents, contents, records
from armlab.log.mcap_writer import McapWriter
from armlab.log.reading import opened

__all__ = ["Recovery", "recover"]

_EVENTS = "rcl_interfaces/msg/Log"  # on the real clock also where the rows are not, as in lockstep

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class Recovery:
    """What `recover` did.

    Attributes
    ----------
    path : the whole file. messages : how many it holds. torn : bytes at the end of the original that were lost.
    lost_chunks : chunks left out because they were damaged. seconds : from the first to the last
    message, events apart.
    """

    path: Path
    messages: int
    torn: int
    lost_chunks: int
    seconds: float


def recover(path: str | Path, to: str | Path | None = None, *, progress: Progress | None = None) -> Recovery:
    """Write a whole copy of an unfinished or damaged MCAP file: every message that can still be read.

    Parameters
    ----------
    path : the file; it is not changed.
    to : where to write, ``<name>.recovered.mcap`` beside the file when None; never over a file that exists.
    progress : called with (bytes done, bytes in all, what).

    Raises
    ------
    LogError : the file is not MCAP or holds no readable message; the copy cannot be written or exists.
    """
    path = Path(path)
    target = path.with_name(f"{path.stem}.recovered.mcap") if to is None else Path(to)
    check_readable(path)
    if target.exists():
        raise LogError(f"Expected no file at {target}, got one; move it away or give another name.")
    part = target.with_name(f"{target.name}.part")
    with opened(path) as view:
        found = contents(view)
        if not found.channels:
            raise LogError(f"Expected messages in {path}, got none that can be read in {len(view)} bytes.")
        try:
            file = part.open("xb", buffering=0)  # never over a file, which may be the one that is read
        except OSError as error:
            raise LogError(f"Expected to create {part}, got: {error.strerror}.") from None
        try:
            with file:
                messages, lost, seconds = _copy(view, found, file, progress)
                os.fsync(file.fileno())
            _rename(part, target)
        except OSError as error:
            raise LogError(f"Expected to write {target}, got: {error.strerror}.") from None
        finally:
            with contextlib.suppress(OSError):
                part.unlink()
    lost += sum(kind == CHUNK for kind, _ in found.damaged)
    return Recovery(target, messages, found.torn, lost, seconds)


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


def _copy(view: memoryview, found: Contents, file: BinaryIO, progress: Progress | None) -> tuple[int, int, float]:
    """Write all that can be read; return messages, chunks lost, and seconds between first and last message,
    events apart.
    """
    writer = McapWriter(file, found.profile, found.library)
    for name, pairs in found.metadata.items():
        writer.metadata(name, pairs)
    for attached in found.attachments:
        data = bytes(view[slice(*attached.data)])
        writer.attach(attached.log_ns, attached.name, attached.media_type, data)
    numbers = _register(writer, found)
    count = lost = 0
    times: list[int] = []
    for data, at in _pieces(view, found):
        if data is None:
            lost += 1
            continue
        for kind, start, stop in records(memoryview(data), 0, len(data)):
            if kind != MESSAGE or stop - start < 22:
                continue
            channel, sequence, log, publish = struct.unpack_from("<HIQQ", data, start)
            if channel in numbers:
                writer.message(numbers[channel], sequence, log, publish, data[start + 22 : stop])
                if found.channels[channel].type != _EVENTS:
                    times = [min(log, *times), max(log, *times)] if times else [log, log]
                count += 1
        writer.close_chunk()  # chunk for chunk, as the recorder wrote them
        if progress:
            progress(at, len(view), "copied")
    writer.finish()
    return count, lost, (times[-1] - times[0]) / 1e9 if times else 0.0


def _register(writer: McapWriter, found: Contents) -> dict[int, int]:
    """Register the channels in the new file; return their numbers there by their old ones."""
    schemas: dict[tuple[str, str, str], int] = {}
    numbers = {}
    for number, channel in found.channels.items():
        key = (channel.type, channel.schema_encoding, channel.schema)
        if key not in schemas:
            schemas[key] = writer.schema(channel.type, channel.schema_encoding, channel.schema.encode())
        numbers[number] = writer.channel(channel.topic, channel.encoding, schemas[key], channel.metadata)
    return numbers


def _pieces(view: memoryview, found: Contents) -> Iterator[tuple[bytes | None, int]]:
    """Yield the records of each chunk, None for a damaged one, and where in the file it ends."""
    if found.loose:
        yield b"".join(bytes(view[start - 9 : stop]) for start, stop in found.loose), found.loose[-1][1]
    for chunk in found.chunks:
        try:
            data = unpacked(view, chunk)
        except LogError:
            data = None
        yield data, chunk.stop
