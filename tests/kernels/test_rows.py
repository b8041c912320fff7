"""Rows of a recording: packed into bytes, as records of MCAP, and as messages for other programs."""

from __future__ import annotations

import struct
import sys
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import kernels, robots
from armlab.errors import ShapeError
from armlab.log import Column, Tick
from armlab.log.recording import rows
from armlab.log.recording.ros_messages import plan, topics
from armlab.log.recording.rows import RowLayout
from armlab.state import Command, State

N = 7
EXTRA = {"fext": Column((6,), unit="N"), "mode": Column(unit="1", kind="count")}


@pytest.fixture
def layout() -> rows.RowLayout:
    return rows.RowLayout(robots.load("yumi_right"), EXTRA)


@pytest.fixture
def pack(layout: rows.RowLayout) -> Any:
    return layout.pack


def tried(pack: Any, state: Any, command: Any, tick: Any) -> bytes | tuple[type, str]:
    """Return the row, or the type of error and, for our own errors, the message."""
    try:
        return pack(state, command, tick)
    except ShapeError as error:
        return ShapeError, str(error)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        return type(error), ""


def values(rng: np.random.Generator, size: int) -> Any:
    """Return a candidate for an array of a given size: valid, nearly valid, or something entirely different."""
    plain = rng.normal(size=size)
    return [
        plain, plain, plain, plain, None, np.zeros(0), [], plain.tolist(), tuple(plain), plain.astype(">f8"),
        plain.astype(np.float32), rng.integers(-9, 9, size), rng.normal(size=(size, 2))[:, 0], plain[::-1],
        np.asfortranarray(rng.normal(size=(1, size))), plain.reshape(size, 1), np.full(size, np.nan), plain[:-1],
        rng.normal(size=size + 1), 3.0, "three", np.ma.array(plain), np.float64(2.5), object(), np.array(plain, object),
        np.zeros((0, 3)), rng.random(size) < 0.5,
    ][rng.integers(27)]  # fmt: skip


def scalar(rng: np.random.Generator, usual: Any) -> Any:
    odd = [np.int64(3), np.float64(2.5), 2.5, True, None, "three", 1 << 70, np.bool_(True), np.array(4), []]
    return usual if rng.random() < 0.95 else odd[rng.integers(len(odd))]


class Known(Mapping):
    """A mapping that is not a dict."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = data

    def __getitem__(self, name: str) -> Any:
        return self.data[name]

    def __iter__(self) -> Any:
        return iter(self.data)

    def __len__(self) -> int:
        return len(self.data)


def record(rng: np.random.Generator) -> Any:
    data = {"wrench_hat": values(rng, 6), "wrench_hat_cov": values(rng, 36), "fext": values(rng, 6), "mode": 3, "x": 1}
    data = {name: value for name, value in data.items() if rng.random() < 0.5}
    kinds = (dict, dict, dict, MappingProxyType, Known, lambda _: {}, lambda _: None, lambda _: 5)
    return kinds[rng.integers(len(kinds))](data)


def drawn(rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Return a row in which usually one or two values are odd."""
    exact, odd = {}, rng.random() * 0.3

    def array(size: int) -> Any:
        return values(rng, size) if rng.random() < odd else rng.normal(size=size)

    for name in ("q", "qd", "tau", "q_planned"):
        exact[name] = array(N)
    state = State(
        scalar(rng, 1.5), 0.004, **exact, seq=scalar(rng, 7), utilization=scalar(rng, 3.5), motors=scalar(rng, 1),
        converged=scalar(rng, True), wrench_raw=array(6), wrench=array(6), T_frame_tool=array(16),
        q_ext=values(rng, 3) if rng.random() < 0.3 else np.zeros(0),
        qd_source=scalar(rng, "measured"), tau_source=scalar(rng, "reference"), rapid_digital=rng.random() < 0.2,
        rapid_data=values(rng, 4) if rng.random() < 0.3 else np.zeros(0),
    ) if rng.random() < 0.97 else SimpleNamespace(q=1)  # fmt: skip
    command = Command(array(N), array(N), None, record=record(rng) if rng.random() < 0.5 else {})
    if rng.random() < 0.2:
        command = replace(command, q_ext=values(rng, 2), rapid_data=values(rng, 3))
    tick = Tick(
        scalar(rng, 5), 6, 1_700_000_000_000_000_000, 8, 9, 10, scalar(rng, False), q_sent=array(N),
        clamped=values(rng, N) if rng.random() < 0.3 else np.arange(N, dtype=np.uint8),
        record=record(rng) if rng.random() < 0.3 else MappingProxyType({}),
        q_ext_sent=values(rng, 2) if rng.random() < 0.2 else None,
        rapid_digital_sent=[None, True, False][rng.integers(3)] if rng.random() < 0.3 else None,
    )  # fmt: skip
    return state, (command if rng.random() < 0.9 else None), tick


@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore:Warning. converting a masked")
def test_random_rows_hold_their_values_or_are_refused(pack: Any, layout: rows.RowLayout) -> None:
    rng, packed, lengths = np.random.default_rng(3), 0, set()
    for _ in range(1500):
        state, command, tick = drawn(rng)
        row = tried(pack, state, command, tick)
        lengths.add(len(row) if isinstance(row, bytes) else row)
        if not isinstance(row, bytes):
            continue
        packed += 1
        sources = {"q": state.q, "qd": state.qd, "tau": state.tau, "q_planned": state.q_planned, "q_sent": tick.q_sent}
        sources |= {name: getattr(state, name) for name in ("wrench_raw", "wrench", "T_frame_tool")}
        sources |= {"q_ref": command and command.q, "qd_ref": command and command.qd}
        for name, value in sources.items():
            slot = layout.slots[name]
            count = int(np.prod(slot.column.shape))
            wanted = np.zeros(0) if value is None else np.asarray(value, float).ravel()
            wanted = wanted if wanted.size else np.full(count, np.nan)
            np.testing.assert_array_equal(np.frombuffer(row, "<f8", count, slot.start), wanted, err_msg=name)
    assert 375 < packed < 1312
    assert len([length for length in lengths if isinstance(length, int)]) == 2  # with the end and without it
    assert (ShapeError, "Expected 7 values in q, got 6.") in lengths


def test_objects_of_other_classes_are_asked_for_their_attributes(pack: Any) -> None:
    rng = np.random.default_rng(1)
    state = State(0.5, 0.004, *rng.normal(size=(3, N)))
    tick = Tick(1, 2, 3, 4, 5, 6)
    fields = {name: getattr(state, name) for name in State.__dataclass_fields__}
    expected = pack(state, Command(state.q), tick)
    own = SimpleNamespace(**fields), SimpleNamespace(q=state.q, qd=None, tau=None, q_ext=None, record={})
    own += (SimpleNamespace(**{**tick._asdict(), "rapid_data_sent": None}),)
    assert pack(*own) == expected
    with pytest.raises(AttributeError):
        pack(None, None, tick)
    with pytest.raises(AttributeError):
        pack(state, None, (1, 2, 3))


def test_values_are_neither_kept_nor_lost(pack: Any) -> None:
    q, rng = np.ones(N), np.random.default_rng(2)
    state = State(0.5, 0.004, q, *rng.normal(size=(2, N)))
    tick, held = Tick(1, 2, 3, 4, 5, 6), {"fext": [1, 2, 3, 4, 5, 6.0]}
    command = Command(record=held)
    counts = [sys.getrefcount(one) for one in (q, state, tick, command, held, held["fext"])]
    row = pack(state, command, tick)
    for _ in range(50):
        assert pack(state, command, tick) == row
        with pytest.raises(ShapeError):
            pack(replace(state, q=np.ones(3)), command, tick)
    assert [sys.getrefcount(one) for one in (q, state, tick, command, held, held["fext"])] == counts


@pytest.mark.parametrize(("n", "size"), [(7, 5), (7, 56), (8, 1)])
def test_limits_have_one_byte_each(n: int, size: int) -> None:
    robot = robots.from_links("arm", [np.eye(4)] * (n + 1))
    tick = Tick(1, 2, 3, 4, 5, 6, clamped=np.zeros(size, np.uint8))
    with pytest.raises(ShapeError, match=f"^Expected {n} values in clamped, got {size}\\.$"):
        RowLayout(robot).pack(State(0.5, 0.004, *np.zeros((3, n))), None, tick)


def test_places_that_contradict_themselves_are_refused() -> None:
    kinds = (State, Command, Tick)
    eight = bytes(8)
    for place, message in (
        (("a", "state", "seq", "odd", eight, None), "Expected one of the forms count, .* for a, got odd"),
        (("a", "planet", "seq", "count", eight, None), "fit the form count for a"),
        (("a", "state", "seq", "count", bytes(4), None), "fit the form count for a"),
        (("a", "state", "converged", "flag", bytes(4), None), "fit the form flag for a"),
        (("a", "state", "qd_source", "code", eight, None), "fit the form code for a"),
        (("a", "state", "rapid_digital", "heard", eight, "data"), "Expected the data column before a"),
    ):
        with pytest.raises(ShapeError, match=message):
            kernels.RowPacker(kinds, [place], "none")


MESSAGE = bytes(16)


@pytest.fixture(scope="module")
def logged() -> RowLayout:
    return RowLayout(robots.load("yumi_right"), {"fext": Column((6,), unit="N")})


@pytest.fixture(scope="module")
def encoder(logged: RowLayout) -> Any:
    found = topics(logged, robots.load("yumi_right").joint_names)
    plans = [plan(number + 3, topic, logged.slots) for number, topic in enumerate(found)]
    return kernels.RowEncoder(plans)


def drawn_values(layout: RowLayout, rng: np.random.Generator, most: float) -> bytes:
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
@pytest.mark.parametrize("count", [1, 7, 40])  # with many, the compiled kernel releases the interpreter
def test_index_entries_point_at_the_records(encoder: Any, logged: RowLayout, count: int) -> None:
    rng = np.random.default_rng(count)
    for first, at in ((None, 0), (5, 77), (0xFFFFFFFE, 0), (-3, 1 << 40)):
        rows = [drawn_values(logged, rng, rng.random()) for _ in range(count)]
        data, entries, *ends = encoder.encode(rows, first, at)
        stamps = [int.from_bytes(row[:8], "little", signed=True) for row in rows]
        assert ends == [min(stamps), max(stamps)]
        assert len(entries[3]) == 16 * count  # each row has its tick
        found = 0
        for channel, index in entries.items():
            for stamp, place in struct.iter_unpack("<qQ", index):
                assert struct.unpack_from("<H", data, place - at + 9) == (channel,)
                assert struct.unpack_from("<q", data, place - at + 15) == (stamp,)
                found += 31 + struct.unpack_from("<Q", data, place - at + 1)[0] - 22
        assert found == len(data)


def test_rows_that_are_too_short_are_refused(encoder: Any, logged: RowLayout) -> None:
    whole = logged.pack_values({})
    with pytest.raises(ShapeError, match=r"^Expected at least one row, got none\.$"):
        encoder.encode([])
    for size in (0, 15, 16, 100, logged.slots["q_ext_ref"].start - 1):
        with pytest.raises(ShapeError, match=rf"^Expected a row of \d+ bytes or more, got {size}\.$"):
            encoder.encode([whole, whole[:size]])


def test_topics_that_contradict_themselves_are_refused() -> None:
    for columns, variants, is_pose, message in (
        ([], [], False, "for each set of optional columns, got 0"),
        ([(0, bytes(8), True)], [(MESSAGE, [])], False, "for each set of optional columns, got 1"),
        ([], [(bytes(11), [])], False, "copies inside the message"),
        ([], [(MESSAGE, [(12, 0, 5)])], False, "copies inside the message"),
        ([], [(MESSAGE, [(-1, 0, 1)])], False, "copies inside the message"),
        ([], [(MESSAGE, [(0, 0, -1)])], False, "copies inside the message"),
        ([], [(MESSAGE, [(12, -1, 1)])], False, "copies inside the message"),
        ([], [(MESSAGE, [(0, 0, 16)])], True, "one of 7 numbers for a pose"),
        ([], [(bytes(70), [])], True, "one of 7 numbers for a pose"),
    ):
        with pytest.raises(ShapeError, match=message):
            kernels.RowEncoder([(1, True, columns, variants, is_pose)])
