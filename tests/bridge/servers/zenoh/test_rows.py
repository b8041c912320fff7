"""`Inbox`: what waits is bounded in number and in bytes."""

from __future__ import annotations

import itertools
import threading
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.servers.row import LARGEST, RowSchema, RowWriter
from armlab.bridge.servers.zenoh.rows import Gaps, Inbox, checksum, undamaged
from armlab.log import Tick
from armlab.state import State

from .conftest import PATIENCE


def test_the_oldest_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.zenoh.rows._LARGEST", 10_000)
    inbox: Inbox[int] = Inbox(5)
    for number in range(8):
        inbox.put(number)
    assert [inbox.get() for _ in range(6)] == [3, 4, 5, 6, 7, None]
    for number in range(4):
        inbox.put(number, 4000)
    assert [inbox.get() for _ in range(3)] == [2, 3, None]
    inbox.put(9, 10**9)  # one message is always kept
    assert (len(inbox), inbox.get(), inbox._size) == (1, 9, 0)


def test_who_waits_is_woken() -> None:
    inbox: Inbox[str] = Inbox(5)
    assert not inbox.wait(0.0)
    assert inbox.get(0.01) is None
    sender = threading.Timer(0.05, inbox.put, ["came"])
    sender.start()
    assert inbox.wait(PATIENCE)
    assert inbox.get(PATIENCE) == "came"
    sender.join()


ARMS = [robots.load(name) for name in ("yumi_left", "yumi_right")]
SCHEMA = RowSchema.of(ARMS)


def rows(count: int) -> list[bytes]:
    """Rows of the left arm, of a cell whose arms take turns."""
    writer, found = RowWriter(SCHEMA), []
    for number in range(count):
        for arm in ARMS:
            nothing: Any = np.full(7, np.nan)
            state = State(0.0, 0.004, np.array(arm.q_home), nothing, nothing, robot=arm.name)
            data = writer.row(state, None, Tick(number, -1, 0, 0, -1, 0), 0)
            if arm is ARMS[0]:
                found.append(data)
    return found


ROWS = rows(60)


@given(st.sets(st.integers(0, 59), min_size=1))
def test_what_is_missing_is_counted(kept: set[int]) -> None:
    gaps = Gaps(SCHEMA, "yumi_left")
    order = sorted(kept)
    missing = [gaps.take(ROWS[k]) for k in order]
    assert missing == [0, *(b - a - 1 for a, b in itertools.pairwise(order))]
    assert (gaps.rows, gaps.lost, gaps.starts) == (len(order), order[-1] - order[0] + 1 - len(order), 1)


def test_a_bridge_that_starts_again_is_no_loss() -> None:
    gaps = Gaps(SCHEMA, "yumi_left")
    for k in (10, 11, 13, 0, 1, 4):
        gaps.take(ROWS[k])
    assert (gaps.rows, gaps.lost, gaps.starts) == (6, 3, 2)


def test_an_arm_that_is_not_in_the_rows() -> None:
    with pytest.raises(KeyError):
        Gaps(SCHEMA, "irb2400")


class Bytes(NamedTuple):
    data: bytes

    def to_bytes(self) -> bytes:
        return self.data


class Sample(NamedTuple):
    payload: Bytes
    attachment: Any


def test_the_check_value_of_the_polynomial() -> None:
    """That of the catalogue of parametrised CRC algorithms: CRC-32 of "123456789", here little-endian."""
    assert checksum(b"123456789") == bytes.fromhex("2639f4cb")


@given(st.binary(min_size=1, max_size=400), st.data())
def test_a_row_with_another_message_in_it_is_none(row: bytes, draw: st.DataObject) -> None:
    """Up to 32 bits in a row are always noticed; here one byte."""
    at = draw.draw(st.integers(0, len(row) - 1))
    other = bytearray(row)
    other[at] ^= draw.draw(st.integers(1, 255))
    attached = Bytes(checksum(row))
    assert undamaged(Sample(Bytes(row), attached)) == row
    assert undamaged(Sample(Bytes(bytes(other)), attached)) is None


def test_a_row_without_a_sum_is_none() -> None:
    assert undamaged(Sample(Bytes(b"row"), None)) is None
    assert undamaged(Sample(Bytes(b"row"), Bytes(b""))) is None
    assert undamaged(Sample(Bytes(b"row"), Bytes(checksum(b"row") + b"\0"))) is None


def test_a_row_that_is_larger_than_rows_are_is_none() -> None:
    for row in (bytes(LARGEST), bytes(LARGEST + 1)):
        assert (undamaged(Sample(Bytes(row), Bytes(checksum(row)))) is None) == (len(row) > LARGEST)
