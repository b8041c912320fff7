"""The compiled two-degree-of-freedom law and its NumPy reference: the same states, references and sentences."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ShapeError
from armlab.kernels import _reference
from armlab.kernels._reference.primitive import PHASES

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

SIDES = (_native, _reference)
SPEED = np.array([1.0, 0.7, -2.0])


def law_of(side: Any, phase: str, n: int, m: int, seed: int, change: dict[int, Any] | None = None) -> Any:
    """A law of either side, with some of its arguments (by number, from tau = 0) changed."""
    draw = np.random.default_rng(seed)
    centres, weights = np.linspace(0.05, 1.0, m), 30 * draw.normal(size=(m, n))
    primitive = side.Primitive(centres, np.full(m, 0.08), weights, 25.0, 156.25, 1.0, 0.4, phase)
    zone, gains = np.where(np.arange(n) % 2, 0.01, 0.0), np.array([25.0, 10.0, 1e3, 5.0, 0.05])
    given = [0.5, *draw.normal(size=(3, n)), gains, zone, np.ones(n)]
    for i, value in (change or {}).items():
        given[i] = value
    return side.TwoDof(primitive, *given)


def state(n: int, seed: int, x: float, apart: float) -> np.ndarray:
    draw = np.random.default_rng(seed)
    yc = draw.normal(size=n)
    parts = (yc, draw.normal(size=n), 0.02 * draw.normal(size=n), yc + apart, draw.normal(size=n), [x, 0.0])
    return np.concatenate(parts)


@given(
    phase=st.sampled_from(PHASES),
    n=st.integers(1, 8),
    m=st.integers(1, 40),
    seed=st.integers(0, 99),
    x=st.sampled_from([0.0, 1e-6, 0.4, 1.0, 1.04, 3.0]),
    apart=st.sampled_from([0.0, 0.03, 0.06]),
    steps=st.integers(1, 3),
)
@settings(max_examples=60)
def test_both_give_the_same(phase, n, m, seed, x, apart, steps) -> None:
    start, driven = state(n, seed, x, apart), np.where(np.arange(n) % 2, np.nan, 0.1)
    ya, yad = start[:n] + 0.01, np.zeros(n)
    ways = []
    for side in SIDES:
        law = law_of(side, phase, n, m, seed)
        y = law.advance(start, 0.004, steps, driven, SPEED)
        then, found = law.follow(y, 0.004, steps, SPEED, ya, yad)
        passed, _ = law.follow(y, 0.004, steps, SPEED, np.full(n, np.nan), yad)
        ways.append((y, law.reference(y, SPEED), law.slopes(y, SPEED), then, found, passed, law.time_constant(y)))
    for native, reference in zip(*ways, strict=True):
        np.testing.assert_allclose(native, reference, rtol=1e-12, atol=1e-12 * (1 + np.abs(reference).max()))


@pytest.mark.parametrize("side", SIDES)
def test_freezes_and_thaws(side) -> None:
    law = law_of(side, "canonical", 2, 9, 1)
    y, still = state(2, 1, 0.5, 0.06), np.zeros(2)
    y = law.advance(y, 0.004, 1, still, np.ones(3))
    assert y[-1] == 1
    y[6:8] = y[:2] + 0.045  # above 0.8 e_max
    assert law.advance(y, 0.004, 1, still, np.ones(3))[-1] == 1
    y[6:8] = y[:2] + 0.039
    assert law.advance(y, 0.004, 1, still, np.ones(3))[-1] == 0


def test_inputs_stay_and_may_be_read_only() -> None:
    for side in SIDES:
        law, y = law_of(side, "time", 3, 9, 1), state(3, 1, 0.5, 0.0)
        y.flags.writeable = False
        before = y.copy()
        law.follow(y, 0.004, 1, SPEED, y[:3], y[3:6])
        law.advance(y, 0.0, 1, y[:3], SPEED)
        np.testing.assert_array_equal(y, before)


@pytest.mark.parametrize(
    "change",
    [
        {0: 0.0},
        {1: np.zeros(5)},
        {2: np.full(2, np.nan)},
        {3: None},
        {4: np.array([25.0, 10.0, -1.0, 5.0, 1.0])},
        {4: np.array([25.0, 10.0, 1.0, 5.0, np.nan])},
        {5: np.full(2, -1.0)},
        {6: np.zeros(2)},
    ],
)
def test_both_refuse_parameters_with_one_sentence(change: dict[int, Any]) -> None:
    said = []
    for side in SIDES:
        with pytest.raises(ShapeError, match=r"^Expected .*\.$") as refused:
            law_of(side, "time", 2, 9, 0, change)
        said.append(str(refused.value))
    assert said[0].split(",")[0] == said[1].split(",")[0]


@pytest.mark.parametrize(
    "misuse",
    [
        lambda law, y: law.advance(y[1:], 0.1, 1, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, -0.1, 1, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, np.nan, 1, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, 0.1, 0, np.zeros(2), SPEED),
        lambda law, y: law.advance(y, 0.1, 1, np.zeros(3), SPEED),
        lambda law, y: law.advance(y, 0.1, 1, np.zeros(2), np.zeros(2)),
        lambda law, y: law.follow(y, 0.1, 1, SPEED, np.zeros(3), np.zeros(2)),
        lambda law, y: law.follow(y, 0.1, 1, SPEED, np.zeros(2), None),
        lambda law, y: law.reference(None, SPEED),
        lambda law, y: law.slopes(y[1:], SPEED),
        lambda law, y: law.time_constant(y[:3]),
    ],
)
def test_both_refuse_calls_with_a_sentence(misuse) -> None:
    for side in SIDES:
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse(law_of(side, "canonical", 2, 9, 0), state(2, 0, 1.0, 0.0))
