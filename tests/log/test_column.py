"""`Column`: what a column is, resolved against the glossary."""

from __future__ import annotations

import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.log.column import KINDS, Column


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


def test_headings() -> None:
    assert Column(unit="N m").heading("tau") == "tau [N m]"
    assert Column(unit="1").heading("seq") == "seq"
    assert set(KINDS) == {"real", "angle", "pose", "quaternion", "count", "flag", "text"}
