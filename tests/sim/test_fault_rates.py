"""Rates of faults have ranges; all zero is no fault at all."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError
from armlab.sim.controller.settings import FaultRates


def test_nothing_happens_without_rates() -> None:
    assert not FaultRates().any
    assert FaultRates(loss=0.1).any


def test_rates_out_of_range() -> None:
    with pytest.raises(ConfigError, match="loss"):
        FaultRates(loss=1.1)
    with pytest.raises(ConfigError, match="pause"):
        FaultRates(pause=(1.0, np.inf))
    with pytest.raises(ConfigError, match="until"):
        FaultRates(until=np.nan)
    with pytest.raises(ConfigError, match="burst"):
        FaultRates(burst=0)
    with pytest.raises(ConfigError, match="delay"):
        FaultRates(delay=(-1.0, 0.0))
