"""Rows encoded by the compiled kernel and by the reference: the same records, index entries and refusals."""

from __future__ import annotations

import struct
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.kernels import _reference
from armlab.log import Column
from armlab.log.recording.ros_messages import plan, topics
from armlab.log.recording.rows import RowLayout

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

MESSAGE = bytes(16)


@pytest.fixture(scope="module")
def layout() -> RowLayout:
    return RowLayout(robots.load("yumi_right"), {"fext": Column((6,), unit="N")})


@pytest.fixture(scope="module")
def encoders(layout: RowLayout) -> list[Any]:
    found = topics(layout, robots.load("yumi_right").joint_names)
    plans = [plan(number + 3, topic, layout.slots) for number, topic in enumerate(found)]
    return [backend.RowEncoder(plans) for backend in (_native, _reference)]


def drawn(layout: RowLayout, rng: np.random.Generator, most: float) -> bytes:
    """Return a row of random numbers, in which some columns are missing and some are extreme."""
    values: dict[str, Any] = {"stamp_ns": int(rng.integers(-(1 << 63), (1 << 63) - 1)) >> rng.integers(0, 40)}
    for name, slot in layout.slots.items():
        if name == "stamp_ns" or rng.random() < most:
            continue
        size = slot.column.shape
        values[name] = rng.normal(size=size) if slot.dtype == "<f8" else rng.integers(0, 100, size)
        if slot.dtype == "<f8" and rng.random() < 0.1:
            values[name] = values[name] * rng.choice([0.0, np.inf, -np.inf, np.nan, 1e300, -1e-300])
    if rng.random() < 0.5:
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.7 else np.diag(rng.choice([-1.0, 1.0], 3))
        values["T_frame_tool"] = np.block([[R, rng.normal(size=(3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
    row = layout.pack_values(values)
    return row if rng.random() < 0.5 else row[: layout.slots["q_ext_ref"].start]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("count", [1, 7, 40])  # with many the compiled kernel lets the interpreter go
def test_random_rows_give_the_same_records(encoders: list[Any], layout: RowLayout, count: int) -> None:
    rng = np.random.default_rng(count)
    for trial in range(240 // count):
        rows = [drawn(layout, rng, rng.random()) for _ in range(count)]
        first, at = [(None, 0), (5, 77), (0xFFFFFFFE, 0), (-3, 1 << 40)][trial % 4]
        native, reference = (encoder.encode(rows, first, at) for encoder in encoders)
        assert native == reference
        stamps = [int.from_bytes(row[:8], "little", signed=True) for row in rows]
        assert native[2:] == (min(stamps), max(stamps))
        assert len(native[1][3]) == 16 * count  # each row has its tick


def test_index_entries_point_at_the_records(encoders: list[Any], layout: RowLayout) -> None:
    rng = np.random.default_rng(9)
    rows = [drawn(layout, rng, 0.5) for _ in range(20)]
    for encoder in encoders:
        data, entries, _, _ = encoder.encode(rows, at=1000)
        found = 0
        for channel, index in entries.items():
            for stamp, at in struct.iter_unpack("<QQ", index):
                assert struct.unpack_from("<H", data, at - 1000 + 9) == (channel,)
                assert struct.unpack_from("<Q", data, at - 1000 + 15) == (stamp,)
                found += 31 + struct.unpack_from("<Q", data, at - 1000 + 1)[0] - 22
        assert found == len(data)


def test_rows_that_are_too_short_are_refused(encoders: list[Any], layout: RowLayout) -> None:
    whole = layout.pack_values({})
    for encoder in encoders:
        with pytest.raises(ShapeError, match=r"^Expected at least one row, got none\.$"):
            encoder.encode([])
    for size in (0, 15, 16, 100, layout.slots["q_ext_ref"].start - 1):
        sentences = []
        for encoder in encoders:
            with pytest.raises(ShapeError, match=rf"^Expected a row of \d+ bytes or more, got {size}\.$") as caught:
                encoder.encode([whole, whole[:size]])
            sentences.append(str(caught.value))
        assert sentences[0] == sentences[1]


def test_topics_that_contradict_themselves_are_refused() -> None:
    for columns, variants, is_pose, message in (
        ([], [], False, "for each set of optional columns, got 0"),
        ([(0, bytes(8), True)], [(MESSAGE, [])], False, "for each set of optional columns, got 1"),
        ([], [(bytes(11), [])], False, "copies inside of the message"),
        ([], [(MESSAGE, [(12, 0, 5)])], False, "copies inside of the message"),
        ([], [(MESSAGE, [(-1, 0, 1)])], False, "copies inside of the message"),
        ([], [(MESSAGE, [(0, 0, -1)])], False, "copies inside of the message"),
        ([], [(MESSAGE, [(12, -1, 1)])], False, "copies inside of the message"),
        ([], [(MESSAGE, [(0, 0, 16)])], True, "of a pose the one"),
        ([], [(bytes(70), [])], True, "of a pose the one"),
    ):
        for backend in (_native, _reference):
            with pytest.raises(ShapeError, match=message):
                backend.RowEncoder([(1, True, columns, variants, is_pose)])
