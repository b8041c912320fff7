"""`Column`: what a column is, resolved against the glossary."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import glossary
from armlab.errors import ShapeError, UnknownName
from armlab.log.column import KINDS, Column, frozen, stored


def test_known_names_are_filled_from_the_glossary() -> None:
    column = Column(shape=(7,)).resolved("q")
    assert (column.unit, column.frame, column.kind) == ("rad", "joint", "angle")


def test_new_names_state_their_unit() -> None:
    column = Column(shape=(6,), unit="N", frame="base").resolved("fext")
    assert (column.unit, column.frame, column.kind) == ("N", "base", "real")
    with pytest.raises(ShapeError, match="unit"):
        Column(shape=(6,)).resolved("fext")


def test_contradictions_are_refused() -> None:
    with pytest.raises(ShapeError, match="Expected unit 'rad'"):
        Column(shape=(7,), unit="deg").resolved("q")
    with pytest.raises(ShapeError, match=r"\(N, 6, 6\)"):
        Column(shape=(6,)).resolved("wrench_hat_cov")
    with pytest.raises(UnknownName, match="real"):
        Column(unit="1", kind="double").resolved("mine")


def test_symbols_of_motion_leave_columns_alone() -> None:
    """x is the phase of a primitive in the glossary, and a coordinate in most files."""
    column = Column(shape=(), unit="m").resolved("x")
    assert (column.unit, column.kind) == ("m", "real")
    assert glossary.lookup("x").unit == "1"
    assert "x" not in glossary.columns()
    assert glossary.columns()["q"] is glossary.lookup("q")


def test_headings() -> None:
    assert Column(unit="N m").heading("tau") == "tau [N m]"
    assert Column(unit="1").heading("seq") == "seq"
    assert set(KINDS) == {"real", "angle", "pose", "quaternion", "count", "flag", "text"}


def test_stored_values_have_the_type_of_their_kind() -> None:
    for name, values, dtype in (
        ("q", [[1, 2]], "<f8"),
        ("seq", [1.0, 2.0], "<i8"),
        ("late", [0, 1], "|b1"),
        ("dt", np.ones(2, dtype=np.float32), "<f8"),
        ("dt", np.ones(2, dtype=">f8"), "<f8"),
    ):
        array, column, note = stored(name, values, None)
        assert array.dtype.str == dtype
        assert not array.flags.writeable
        assert column.shape == array.shape[1:]
        assert note == ""
    array, column, note = stored("late", [0.0, np.nan], None)
    assert column.kind == "real"
    assert "flag with missing values" in note
    for name, values in (("seq", [2.0**70]), ("late", [2]), ("dt", 1.0)):
        with pytest.raises(ShapeError):
            stored(name, values, None)


def test_frozen_copies_only_what_someone_could_still_write_to() -> None:
    mine = np.arange(6.0)
    assert not np.shares_memory(frozen(mine), mine)
    whole = frozen(mine)
    assert frozen(whole) is whole
    assert np.shares_memory(frozen(whole[2:4]), whole)
    assert frozen(whole[::2]).flags.c_contiguous
    fixed = np.frombuffer(b"12345678", dtype="<f8")
    assert np.shares_memory(frozen(fixed), fixed)
    buffer = bytearray(8)
    view = np.frombuffer(buffer, dtype="<f8")
    view.flags.writeable = False
    kept = frozen(view)
    buffer[:] = b"\xff" * 8
    assert kept[0] == 0.0


def test_the_clock_is_no_column() -> None:
    with pytest.raises(ShapeError, match="columns besides t, the clock"):
        stored("t", [0.0, 1.0], Column(unit="s"))
