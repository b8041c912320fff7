"""Rows as bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.log import Column, Tick
from armlab.log.recording.rows import NO_CLOCK, NO_COUNT, NO_FLAG, SELDOM, RowLayout, Slot, with_holes
from armlab.robots import Robot
from armlab.state import Command, State


def test_slots_cover_the_row_without_holes(robot: Robot) -> None:
    layout = RowLayout(robot, {"fext": Column((6,), unit="N")})
    at = 0
    for slot in layout.slots.values():
        assert isinstance(slot, Slot)
        assert slot.start == at
        assert len(slot.nothing) == slot.stop - slot.start
        at = slot.stop
    assert at == layout.size
    assert next(iter(layout.slots)) == "stamp_ns"
    assert set(layout.extra) == {"wrench_hat", "wrench_hat_cov", "fext"}


def test_packing_and_unpacking(robot: Robot, rows: Callable) -> None:
    layout = RowLayout(robot, {"fext": Column((6,), unit="N"), "mode": Column(unit="1", kind="count")})
    found = layout.unpack([layout.pack(*rows(i)) for i in range(5)])
    for i in range(5):
        state, command, tick = rows(i)
        assert np.array_equal(found["tau"][i], state.tau)
        assert np.array_equal(found["qd_ref"][i], command.qd)
        assert np.array_equal(found["clamped"][i], tick.clamped)
        assert np.array_equal(found["T_frame_tool"][i], state.T_frame_tool)
        assert np.array_equal(found["wrench_hat_cov"][i], command.record["wrench_hat_cov"])
        assert found["stamp_ns"][i] == tick.stamp_ns
        assert found["utilization"][i] == state.utilization
        assert found["mode"][i] == command.record["mode"]
    assert np.isnan(found["tau_ref"]).all()
    assert np.isnan(found["q_ext"]).all()


def test_what_is_not_there_is_missing(robot: Robot) -> None:
    layout = RowLayout(robot)
    state = State(0.0, 0.004, np.zeros(7), np.zeros(7), np.full(7, np.nan), q_ext=np.array([0.5]))
    found = layout.unpack([layout.pack(state, None, Tick(0, NO_COUNT, 9, 0, NO_COUNT, 0))])
    for name in ("q_ref", "tau", "seq_sent", "send_ns", "clamped", "wrench_hat", "utilization"):
        assert np.isnan(found[name]).all(), name
    assert (found["robot_ns"].dtype, found["robot_ns"][0]) == (np.int64, 0)  # a clock keeps its mark
    assert found["q_ext"][0, 0] == 0.5
    assert np.isnan(found["q_ext"][0, 1:]).all()
    assert np.array_equal(found["q"], np.zeros((1, 7)))


def test_wrong_sizes_name_the_column(robot: Robot, rows: Callable) -> None:
    layout = RowLayout(robot)
    state, command, tick = rows(0)
    for bad, message in (
        ((replace(state, q=np.zeros(6)), command, tick), "Expected 7 values in q, got 6."),
        ((state, Command(tau=np.zeros(8)), tick), "Expected 7 values in tau_ref, got 8."),
        ((state, command, tick._replace(clamped=np.zeros(3))), "Expected 7 values in clamped, got 3."),
        ((state, Command(record={"wrench_hat": [1.0]}), tick), "Expected 6 values in wrench_hat, got 1."),
    ):
        with pytest.raises(ShapeError, match=message.replace(".", r"\.")):
            layout.pack(*bad)


def test_packing_by_name(robot: Robot) -> None:
    layout = RowLayout(robot)
    found = layout.unpack([layout.pack_values({"q": np.ones(7), "seq": 4}), layout.pack_values({})])
    assert np.array_equal(found["q"][0], np.ones(7))
    assert np.isnan(found["q"][1]).all()
    assert found["seq"][0] == 4
    assert np.isnan(found["seq"][1])
    assert np.isnan(found["late"]).all()
    with pytest.raises(UnknownName, match="'torque'"):
        layout.pack_values({"torque": 1.0})
    with pytest.raises(ShapeError, match=r"shape \(7,\) for q, got \(6,\)"):
        layout.pack_values({"q": np.zeros(6)})


def test_marks_become_nan_and_whole_columns_stay_whole(robot: Robot) -> None:
    counts = np.array([3, NO_COUNT, 5])
    assert np.array_equal(with_holes(counts, NO_COUNT), [3.0, np.nan, 5.0], equal_nan=True)
    assert with_holes(counts, None) is counts
    assert with_holes(np.arange(3), NO_COUNT).dtype.kind == "i"
    slots = RowLayout(robot).slots
    assert [slots[name].missing for name in ("robot_ns", "seq_sent", "late", "clamped")] == [
        NO_CLOCK,
        NO_COUNT,
        NO_FLAG,
        NO_FLAG,
    ]


def test_the_end_of_a_row_is_there_when_it_is_needed(robot: Robot) -> None:
    """Rows of both kinds in one table; what RAPID never said is missing, not False."""
    layout = RowLayout(robot)
    state = State(0.0, 0.004, np.zeros(7), np.zeros(7), np.zeros(7))
    tick = Tick(0, 1, 9, 0, 5, 0)
    short = layout.pack(state, None, tick)
    command = Command(q_ext=np.array([0.5, -0.5]))
    sent = tick._replace(q_ext_sent=np.array([0.4]), rapid_data_sent=np.array([1.0, 2.0]), rapid_digital_sent=False)
    long = layout.pack(replace(state, rapid_data=np.array([7.0])), command, sent)
    assert len(long) == layout.size == len(short) + 8 * (6 + 6 + 40 + 40 + 2)
    found = layout.unpack([short, long])
    for name in SELDOM:
        assert np.isnan(found[name][0]).all(), name
    assert found["q_ext_ref"][1, :3].tolist()[:2] == [0.5, -0.5]
    assert found["q_ext_sent"][1, 0] == 0.4
    assert (found["rapid_data"][1, 0], found["rapid_digital"][1], found["rapid_digital_sent"][1]) == (7.0, 0.0, 0.0)
    assert found["rapid_data_sent"][1, :2].tolist() == [1.0, 2.0]
    alone = layout.unpack([short])
    assert np.isnan(alone["rapid_data"]).all()
    assert set(alone) == set(found)
