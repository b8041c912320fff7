"""The signal operator against its oracle: outputs, counters and messages."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import kernels
from armlab.errors import ShapeError

from .. import oracles
from ..oracles.signals import KINDS

DT = 0.004
sample = st.one_of(st.floats(-10, 10), st.sampled_from([np.nan, np.inf, 0.0]))


@given(
    kind=st.sampled_from(KINDS),
    x=st.lists(st.tuples(sample, sample), min_size=1, max_size=20),
    steps=st.one_of(st.none(), st.lists(st.floats(1e-4, 0.1), min_size=20, max_size=20)),
    init=st.one_of(st.none(), st.floats(-1, 1), st.just([0.5, -0.5])),
    timed=st.booleans(),
)
@settings(max_examples=100)
def test_both_give_the_same(kind, x, steps, init, timed) -> None:
    values = np.array(x)
    t = None if steps is None else np.cumsum(steps)[: len(values)]
    dt = DT if timed or t is None else np.nan
    pair = [side.SignalOperator(kind, 2 * np.pi, 0.7, dt, init) for side in (kernels, oracles)]
    native, reference = (operator.run(values, t) for operator in pair)
    np.testing.assert_allclose(native, reference, rtol=1e-12, atol=1e-12)
    assert (pair[0].gaps, pair[0].skipped) == (pair[1].gaps, pair[1].skipped)
    assert pair[0].longest_gap == pytest.approx(pair[1].longest_gap)


@pytest.mark.parametrize(
    "misuse",
    [
        lambda op: op("lowpass", 1.0, 0.7, np.nan).step(1.0),
        lambda op: op("lowpass", 1.0, 0.7, DT).run(1.0),
        lambda op: op("lowpass", 1.0, 0.7, DT).step(None),
        lambda op: op("lowpass", 1.0, 0.7, DT).run(None),
        lambda op: op("lowpass", 1.0, 0.7, DT).run(np.zeros(3), np.zeros(2)),
        lambda op: op("euler", 0.0, 0.0, DT, [1.0, 2.0]).step(np.zeros(3)),
        lambda op: op("euler", 0.0, 0.0, DT, np.nan),
        lambda op: op("wavelet", 0.0, 0.0, DT),
    ],
)
def test_misuse_is_refused_in_a_sentence(misuse) -> None:
    with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
        misuse(kernels.SignalOperator)
