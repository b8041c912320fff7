"""`recover`: an unfinished or damaged recording becomes a whole file, the original untouched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from armlab.errors import LogError
from armlab.log.formats import check_readable, naming, opened
from armlab.log.mcap_copy import Registry, messages_in, new_file, pieces, records_at
from armlab.log.mcap_records import CHUNK, Contents, contents
from armlab.log.mcap_writer import McapWriter

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
    """Write all that can be read; return messages, chunks lost, and seconds between first and last message,
    events apart.
    """
    writer = McapWriter(file, found.profile, found.library)
    for name, pairs in found.metadata.items():
        writer.metadata(name, pairs)
    for attached in found.attachments:
        data = bytes(view[slice(*attached.data)])
        writer.attach(attached.log_ns, attached.name, attached.media_type, data)
    registry = Registry(writer)
    numbers = {number: registry.channel(channel) for number, channel in found.channels.items()}
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
