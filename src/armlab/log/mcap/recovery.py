"""Recovery of unfinished or corrupt MCAP files, and helpers that copy parts of MCAP files."""

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
    """Open a file under a temporary name; rename it on success, or remove it on failure."""
    try:
        file = part.open("xb", buffering=0)  # "x" never overwrites an existing file, which may be the input
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
    """Rename the finished copy to its final name, unless another file now has this name."""
    try:
        os.link(part, target)  # unlike renaming, linking never replaces an existing file
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        target.open("xb").close()
        part.replace(target)


def copied_channel(writer: McapWriter, channel: Channel) -> int:
    """Copy a channel from another file, and return its id in the new file."""
    schema = writer.schema(channel.type, channel.schema_encoding, channel.schema.encode(errors="surrogateescape"))
    return writer.channel(channel.topic, channel.encoding, schema, channel.metadata)


_EVENTS = "rcl_interfaces/msg/Log"  # events have wall-clock stamps even if the rows do not, as in lockstep


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of `recover`.

    `path`: the recovered file. `messages`: number of messages. `torn`: number of bytes lost at the end of the original.
    `lost_chunks`: number of corrupt chunks. `seconds`: time from the first to the last message, excluding events.
    """

    path: Path
    messages: int
    torn: int
    lost_chunks: int
    seconds: float


def recover(path: str | Path, to: str | Path | None = None, *, progress: Progress | None = None) -> Recovery:
    """Write a finished copy of an unfinished or corrupt MCAP file, with every readable message.

    Parameters
    ----------
    path : the file; not modified.
    to : output file; default: ``<name>.recovered.mcap`` next to the input. The output file must not already exist.
    progress : called with (bytes done, total bytes, what).

    Raises
    ------
    LogError : the file is not an MCAP file or has no readable message, or the output exists or cannot be written.
    """
    path = Path(path)
    check_readable(path)
    target = path.with_name(f"{path.stem}.recovered.mcap") if to is None else Path(to)
    if target.exists():
        raise LogError(f"Expected no file at {target}, but one already exists. Move the file or choose another name.")
    with opened(path) as view:
        with naming(path):
            found = contents(view)
        if not found.channels:
            raise LogError(f"Expected messages in {path}, got no readable message in {len(view)} bytes.")
        with new_file(target, target.with_name(f"{target.name}.part"), replace=False) as file:
            messages, lost, seconds = _copy(view, found, file, progress)
    lost += sum(kind == CHUNK for kind, _ in found.damaged)
    return Recovery(target, messages, found.torn, lost, seconds)


def _copy(view: memoryview, found: Contents, file: BinaryIO, progress: Progress | None) -> tuple[int, int, float]:
    """Write all readable data; return the message count, lost chunks, and duration [s], excluding events."""
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
        writer.close_chunk()  # keeps the chunk boundaries of the recorder
        if progress and piece:
            progress(piece.stop, len(view), "copied")
    writer.finish()
    return count, lost, (times[-1] - times[0]) / 1e9 if times else 0.0
