"""`recover` writes a whole file from an unfinished or damaged one; copying parts of MCAP files into a new one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from armlab.errors import LogError
from armlab.log.file_formats.description import Progress
from armlab.log.file_formats.opening import check_readable, naming, opened
from armlab.log.mcap.records import CHUNK, Channel, Contents, contents, messages_in, pieces, records_at
from armlab.log.mcap.writer import McapWriter


@contextlib.contextmanager
def new_file(target: Path, part: Path, *, replace: bool) -> Iterator[BinaryIO]:
    """Open a file under another, free name; it gets its own when the block has ended well, else nothing is left."""
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
    """Give the finished copy its name, unless something has got it in the meantime."""
    try:
        os.link(part, target)  # never over a file, as a rename would
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        target.open("xb").close()
        part.replace(target)


def copied_channel(writer: McapWriter, channel: Channel) -> int:
    """Write a channel of another file and return its number in the new one."""
    schema = writer.schema(channel.type, channel.schema_encoding, channel.schema.encode(errors="surrogateescape"))
    return writer.channel(channel.topic, channel.encoding, schema, channel.metadata)


_EVENTS = "rcl_interfaces/msg/Log"  # on the real clock also where the rows are not, as in lockstep


@dataclass(frozen=True, slots=True)
class Recovery:
    """What `recover` did.

    `path`: the whole file; `messages`: how many it holds; `torn`: bytes at the end of the original that were lost;
    `lost_chunks`: chunks left out because they were damaged; `seconds`: from the first to the last message, events
    apart.
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
    check_readable(path)
    target = path.with_name(f"{path.stem}.recovered.mcap") if to is None else Path(to)
    if target.exists():
        raise LogError(f"Expected no file at {target}, got one; move it away or give another name.")
    with opened(path) as view:
        with naming(path):
            found = contents(view)
        if not found.channels:
            raise LogError(f"Expected messages in {path}, got none that can be read in {len(view)} bytes.")
        with new_file(target, target.with_name(f"{target.name}.part"), replace=False) as file:
            messages, lost, seconds = _copy(view, found, file, progress)
    lost += sum(kind == CHUNK for kind, _ in found.damaged)
    return Recovery(target, messages, found.torn, lost, seconds)


def _copy(view: memoryview, found: Contents, file: BinaryIO, progress: Progress | None) -> tuple[int, int, float]:
    """Write all that can be read; return messages, chunks lost, and seconds from first to last, events apart."""
    writer = McapWriter(file, found.profile, found.library)
    for name, pairs in found.metadata.items():
        writer.metadata(name, pairs)
    for attached in found.attachments:
        data = bytes(view[slice(*attached.data)])
        writer.attach(attached.log_ns, attached.name, attached.media_type, data)
    numbers = {number: copied_channel(writer, channel) for number, channel in found.channels.items()}
    count = lost = 0
    times: list[int] = []
    for piece in pieces(found):
        data = records_at(view, found, piece)
        if data is None:
            lost += 1
            continue
        for channel, sequence, log, publish, message in messages_in(data):
            if channel in numbers:
                writer.message(numbers[channel], sequence, log, publish, message)
                if found.channels[channel].type != _EVENTS:
                    times = [min(log, *times), max(log, *times)] if times else [log, log]
                count += 1
        writer.close_chunk()  # chunk for chunk, as the recorder wrote them
        if progress and piece:
            progress(piece.stop, len(view), "copied")
    writer.finish()
    return count, lost, (times[-1] - times[0]) / 1e9 if times else 0.0
