"""Arms, and an EGM message writer that shares nothing with the code under test."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from tomllib import loads
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

YUMI = (1, 2, 7, 3, 4, 5, 6)


def arm(coupling: Any, axes: tuple[int, ...] = (), linear: tuple[int, ...] = ()) -> Any:
    """Return the properties of a robot for the codec; `linear`: prismatic joints, from 0."""
    n = len(coupling)
    prismatic = np.isin(np.arange(n), linear)
    return SimpleNamespace(
        n=n, prismatic=prismatic, abb_axes=axes or tuple(range(1, n + 1)), coupling=np.array(coupling)
    )


@pytest.fixture(scope="session")
def six() -> Any:
    return arm(np.eye(6))


@pytest.fixture(scope="session")
def yumi() -> Any:
    return arm(np.eye(7), YUMI)


@pytest.fixture(scope="session")
def scara() -> Any:
    return arm(np.eye(4), linear=(2,))


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


class Wire:
    """Protobuf writer: `u` integer field, `d` double field, `m` message field, `packed` packed doubles."""

    @staticmethod
    def u(field: int, value: int) -> bytes:
        return varint(field << 3) + varint(value)

    @staticmethod
    def d(field: int, *values: float) -> bytes:
        return b"".join(varint(field << 3 | 1) + struct.pack("<d", value) for value in values)

    @staticmethod
    def m(field: int, *parts: bytes) -> bytes:
        body = b"".join(parts)
        return varint(field << 3 | 2) + varint(len(body)) + body

    def packed(self, field: int, *values: float) -> bytes:
        return self.m(field, struct.pack(f"<{len(values)}d", *values))

    def header(self, seqno: int = 0, tm: int = 0, mtype: int = 2) -> bytes:
        return self.m(1, self.u(1, seqno), self.u(2, tm), self.u(3, mtype))

    def joints(self, *values: float) -> bytes:
        return self.d(1, *values)

    def robot(self, joints: bytes, *more: bytes, seqno: int = 0, tm: int = 0, external: bytes = b"") -> bytes:
        parts = [self.m(1, joints)] + ([self.m(3, external)] if external else [])
        return self.header(seqno, tm) + self.m(2, *parts) + b"".join(more)


@pytest.fixture(scope="session")
def wire() -> Wire:
    return Wire()


@pytest.fixture(scope="session")
def vector() -> Callable[[str], bytes]:
    path = Path(__file__).parents[2] / "vectors" / "egm" / "messages.toml"
    table = loads(path.read_text(encoding="utf-8"))
    return lambda name: bytes.fromhex(table[name]["hex"])
