"""The sum attached to every row: a row that was damaged on its way is not read as one."""

from __future__ import annotations

import struct
import zlib
from typing import Any

from armlab.bridge.row_schema import LARGEST
from armlab.bridge.zenoh.session import data_of

__all__ = ["checksum", "undamaged"]

_SUM = struct.Struct("<I")


def checksum(data: bytes) -> bytes:
    """Return the CRC-32 of a row, 4 bytes, little-endian.

    Parameters
    ----------
    data : the row.

    Reference: ISO 3309, the CRC-32 of zlib and Ethernet.
    """
    return _SUM.pack(zlib.crc32(data))


def undamaged(sample: Any) -> bytes | None:
    """Return the row of a sample, None when the sum attached is another one or there is none, or it is no row's size.

    Parameters
    ----------
    sample : of the key "state", "live" or "view".
    """
    data = sample.payload.to_bytes()
    return data if len(data) <= LARGEST and data_of(sample.attachment) == checksum(data) else None
