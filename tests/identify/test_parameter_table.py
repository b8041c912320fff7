"""Every parameter with value, deviation, unit and name."""

from __future__ import annotations

import pytest

from armlab.estimation import Fit
from armlab.identify.validation import parameter_rows, parameter_text
from armlab.models import TorqueModel


def test_every_parameter_has_its_line(fitted: Fit[TorqueModel]) -> None:
    rows = parameter_rows(fitted)
    assert len(rows) == len(fitted.names)
    for row, x, sd, unit, name in zip(rows, fitted.parameters, fitted.sd, fitted.units, fitted.names):
        assert float(row[0]) == pytest.approx(x, rel=1e-3)
        assert float(row[1]) == pytest.approx(sd, rel=0.1)
        assert row[2:] == (unit, name)


def test_the_text_has_aligned_columns(fitted: Fit[TorqueModel]) -> None:
    head, *lines = parameter_text(fitted).splitlines()
    at = head.index("parameter")
    assert [line[at:] for line in lines] == list(fitted.names)
    assert {line.index("+-") for line in lines} == {head.index("sd") - 3}
