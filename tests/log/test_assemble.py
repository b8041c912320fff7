"""Clocks and rows of recordings."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.log import Column
from armlab.log.assembly import in_time_order, recording_clock, recording_table, rows_in_order, wall_at_zero

STAMPS = 10**18 + np.arange(6) * 4_000_000


def test_the_robots_clock_where_it_always_advances() -> None:
    robot_ns = 5 * 10**18 + np.arange(6) * 4_032_000
    t, clock = recording_clock({"robot_ns": robot_ns, "session_t": np.arange(6) * 0.004032}, STAMPS)
    assert clock == "robot"
    assert t == pytest.approx(np.arange(6) * 0.004032, abs=1e-15)


@pytest.mark.parametrize("step", [-3_600_000_000_000, 3_600_000_000_000, -1_000_000])
def test_a_robot_clock_that_was_set_is_not_trusted(step: int) -> None:
    robot_ns = 5 * 10**18 + np.arange(6) * 4_032_000
    robot_ns[3:] += step - 4_032_000 * (step == -1_000_000)
    t, clock = recording_clock({"robot_ns": robot_ns, "session_t": np.arange(6) * 0.004032}, STAMPS)
    assert clock == "robot"
    assert t == pytest.approx(np.arange(6) * 0.004032)


def test_sessions_are_placed_by_the_stamps() -> None:
    session_t = np.array([1.0, 1.004, 1.008, 0.0, 0.004, 0.008])
    stamps = STAMPS + np.repeat([0, 2_000_000_000], 3)
    t, clock = recording_clock({"session_t": session_t, "session": np.repeat([1, 2], 3)}, stamps)
    assert clock == "robot"
    assert t == pytest.approx([0.0, 0.004, 0.008, 2.012, 2.016, 2.020])


def test_stamps_when_there_is_nothing_else() -> None:
    t, clock = recording_clock({}, STAMPS)
    assert clock == "bridge"
    assert t == pytest.approx(np.arange(6) * 0.004)
    assert len(recording_clock({}, STAMPS[:0])[0]) == 0


def test_time_order_counts_rows_that_do_not_advance() -> None:
    keep, lost = in_time_order(np.array([0.0, 1.0, 1.0, 0.5, 2.0, np.nan, 3.0]))
    assert keep.tolist() == [True, True, False, False, True, False, True]
    assert lost == 3


def test_rows_whose_time_does_not_advance_are_dropped_or_spread() -> None:
    given = np.array([0.0, 1.0, 1.0, 0.5, 2.0])
    t, kept, notes = rows_in_order(given, raw=True)
    assert kept.all()
    assert notes == ()
    assert (np.diff(t) > 0).all()
    np.testing.assert_allclose(t, [0.0, 1.0, 1.0, 1.0, 2.0], atol=1e-8)
    with pytest.warns(UserWarning, match="raw=True keeps them"):
        t, kept, notes = rows_in_order(given, raw=False, row="line {}".format, of=" of /x")
    assert t[kept].tolist() == [0.0, 1.0, 2.0]
    assert notes == ("2 rows of /x dropped: their time does not advance (line 2, line 3)",)
    with pytest.warns(UserWarning, match=r"7 rows .* \(row 1, row 2, row 3, row 4, row 5, \.\.\.\)"):
        rows_in_order(np.zeros(8), raw=False)
    assert rows_in_order(given[[0, 1, 4]], raw=False)[2] == ()


def test_empty_columns_and_unused_axes_are_left_out() -> None:
    q_ext = np.full((6, 6), np.nan)
    q_ext[:, :2] = 1.0
    values = {"q": np.zeros((6, 3)), "tau": np.full((6, 3), np.nan), "q_ext": q_ext, "seq": np.arange(6)}
    table = recording_table(values, dict.fromkeys(values, Column()), STAMPS)
    assert table.names == ("q", "q_ext", "seq")
    assert table["q_ext"].shape == (6, 2)
    assert table.t0_ns == 10**18


def test_the_wall_clock_of_zero_where_t_begins_later() -> None:
    t = np.array([2.5, 3.0])
    assert wall_at_zero(t, STAMPS[:2]) == STAMPS[0] - 2_500_000_000
    assert wall_at_zero(t[:0], STAMPS[:0]) == 0
    table = recording_table({"t": t, "q": np.zeros((2, 7))}, {"t": Column(), "q": Column()}, STAMPS[:2])
    assert table.t0_ns == STAMPS[0] - 2_500_000_000
