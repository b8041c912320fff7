"""Something else in place of samples, times or numbers: one sentence, never another error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab import signals
from armlab.errors import ArmlabError

X = np.sin(np.arange(100) / 10.0)
T = np.arange(100) / 100.0
CALLS: dict[str, Callable] = {
    "samples": lambda x: signals.lowpass_offline(x, 100.0, 5.0),
    "rate": lambda x: signals.lowpass_offline(X, x, 5.0),
    "cutoff": lambda x: signals.lowpass_offline(X, 100.0, x),
    "order": lambda x: signals.lowpass_offline(X, 100.0, 5.0, x),
    "factor": lambda x: signals.decimate(X, 100.0, x),
    "times": lambda x: signals.central_diff(X, x),
    "bandwidth": lambda x: signals.smooth_diff(X, T, x),
    "operator": lambda x: signals.filtfilt(x, X, T),
    "step": lambda x: signals.Integrator("x" if x is None else x),
    "corner": lambda x: signals.LowPass2(x, 0.01),
    "quality": lambda x: signals.Notch(10.0, x),
    "time constant": lambda x: signals.ExpFilter(x, 0.01),
}


@pytest.mark.parametrize("other", [None, "5", -1.0, np.nan, np.inf, [[1, 2], [3]], np.zeros((0, 2)), 1j], ids=repr)
@pytest.mark.parametrize("what", CALLS)
def test_it_gets_a_sentence(what: str, other: object) -> None:
    with pytest.raises(ArmlabError, match=r"^Expected .*\.$"):
        CALLS[what](other)
