"""The compiled movement primitives are held to their NumPy specification."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ShapeError
from armlab.kernels import _reference
from armlab.motion.primitive.equation import placed

native = pytest.importorskip("armlab.kernels._native", reason="the extension is not built here", exc_type=ImportError)

PHASES = ("canonical", "time", "position", "periodic")


def arguments(phase: str, m: int, n: int, alpha: float, damping: float, seed: int) -> tuple[Any, ...]:
    rng = np.random.default_rng(seed)
    centres, widths = placed("time" if phase == "periodic" else phase, "time", m, 3.0, 0.8)
    return centres, widths, rng.normal(size=(m, n)), alpha, alpha**2 * damping, 1.0, 0.4, phase


def assert_close(ours: Any, wanted: Any) -> None:
    for a, b in zip(ours, wanted, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(b).max(initial=0.0)))


cases = st.fixed_dictionaries(
    {
        "phase": st.sampled_from(PHASES),
        "m": st.integers(3, 60),
        "n": st.integers(1, 8),
        "alpha": st.sampled_from([0.3, 4.0, 25.0, 100.0]),
        "damping": st.sampled_from([0.01, 0.25 * (1 - 1e-9), 0.25, 0.25 * (1 + 1e-9), 3.0]),
        "seed": st.integers(0, 999),
    }
)


@given(cases, st.sampled_from([None, 1, 3, 17]), st.booleans(), st.sampled_from([1e-3, 0.05, 1.0]))
@settings(max_examples=30)
def test_rollout_is_the_reference(case: dict[str, Any], K: int | None, own: bool, longest: float) -> None:
    ours, wanted = native.Primitive(*arguments(**case)), _reference.Primitive(*arguments(**case))
    rng = np.random.default_rng(case["seed"])
    if case["phase"] == "position":
        longest, K = min(longest, 0.05 / case["alpha"]), K and min(K, 2)  # few of the reference's slow steps
    n, t = case["n"], np.cumsum(rng.uniform(0.1, 1.0, 6)) * longest
    parts = rng.normal(size=(4, *(() if K is None else (K,)), n))
    weights = rng.normal(size=(K or 1, case["m"], n)) if own else None
    assert_close(ours.rollout(t, 0.4, *parts, weights), wanted.rollout(t, 0.4, *parts, weights))
    if case["phase"] != "position":
        assert_close(ours.response(t, 0.4, 0.02), wanted.response(t, 0.4, 0.02))


@given(cases, st.sampled_from([0.0, 12.5]), st.booleans())
@settings(max_examples=20)
def test_stepper_is_the_reference(case: dict[str, Any], rate: float, brakes: bool) -> None:
    rng = np.random.default_rng(case["seed"])
    n, limit = case["n"], np.full(case["n"], 30.0) if brakes else None
    start = (*rng.normal(size=(4, n)), 0.4)
    goal, dt = rng.normal(size=(2, n)), rng.uniform(1e-4, 2e-3, 30)
    runs = []
    for module in (native, _reference):
        stepper = module.PrimitiveStepper(module.Primitive(*arguments(**case)), rate)
        stepper.start(*start)
        rows = [(*stepper.outputs(), stepper.forcing)]
        for k, h in enumerate(dt):
            if k == 10:
                stepper.change_goal(*goal, limit)
            if k == 20:
                stepper.change_tau(0.7)
            rows.append((*stepper.step(h), stepper.forcing))
        runs.append([*np.array(rows).swapaxes(0, 1), np.array([stepper.tau, stepper.elapsed])])
    assert_close(*runs)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("phase", PHASES)
def test_basis_and_forcing_are_the_reference(batch: tuple[int, ...], phase: str) -> None:
    args = arguments(phase, 12, 3, 25.0, 0.25, 1)
    x = np.random.default_rng(0).uniform(-1.0, 2.0, batch)
    own = np.broadcast_to(x[..., None], (*batch, 3)) if phase == "position" else x
    ours, wanted = native.Primitive(*args), _reference.Primitive(*args)
    for name, at in (("basis", x), ("forcing", own)):
        a, b = getattr(ours, name)(at), getattr(wanted, name)(at)
        assert_close([a], [b])
        for one in (ours, wanted):
            out = np.empty_like(a)
            assert getattr(one, name)(at, out=out) is out


@pytest.mark.parametrize("phase", PHASES)
def test_design_is_the_basis_in_a_corner_of_zeros(phase: str) -> None:
    args, rng = arguments(phase, 12, 3, 25.0, 0.25, 1), np.random.default_rng(2)
    x, factors = rng.uniform(-1.0, 2.0, 9), rng.normal(size=9)
    for module in (native, _reference):
        p = module.Primitive(*args)
        found = p.design(x, factors, 11, 14)
        assert found.shape == (14, 11)
        np.testing.assert_allclose(found[:12, :9], (p.basis(x) * factors[:, None]).T, rtol=1e-14, atol=1e-16)
        assert not found[12:].any()
        assert not found[:, 9:].any()
        for bad in ((x, factors[:8], 11, 14), (x, factors * np.nan, 11, 14), (x, factors, 8, 14), (x, factors, 11, 11)):
            with pytest.raises(ShapeError):
                p.design(*bad)
    assert_close([native.Primitive(*args).design(x, factors, 11, 14)], [found])


def test_kernels_are_exact_to_the_last_digits() -> None:
    """Their exponential is the core's own: every size of it, from 1 down to where kernels are left out."""
    centres = np.array([0.0, 1.0])
    p = native.Primitive(centres, np.array([1.0, 0.11]), np.zeros((2, 1)), 25.0, 156.25, 1.0, 0.25, "canonical")
    x = np.linspace(0.0, 2.0, 2001)
    off = 0.5 * x**2 - 0.5 * ((x - 1.0) / 0.11) ** 2
    wanted = np.stack([1 / (1 + np.exp(off)), 1 / (1 + np.exp(-off))], axis=1)
    np.testing.assert_allclose(p.basis(x), np.where(wanted < 1e-17, 0.0, wanted), rtol=4e-15, atol=1e-17)


def test_batch_is_bit_for_bit_a_loop() -> None:
    p = native.Primitive(*arguments("canonical", 30, 3, 25.0, 0.25, 0))
    rng = np.random.default_rng(1)
    t, parts, weights = np.linspace(0, 1, 50), rng.normal(size=(4, 21, 3)), rng.normal(size=(21, 30, 3))
    together = p.rollout(t, 0.3, *parts)
    own = p.rollout(t, 0.3, *parts, weights)
    for k in range(21):
        for many, one in zip(together, p.rollout(t, 0.3, *parts[:, k])):
            np.testing.assert_array_equal(many[:, k] if many.ndim == 3 else many, one)
        for many, one in zip(own, p.rollout(t, 0.3, *parts[:, k : k + 1], weights[k : k + 1])):
            np.testing.assert_array_equal(many[:, k : k + 1] if many.ndim == 3 else many, one)


@pytest.mark.parametrize("module", [native, _reference], ids=["native", "reference"])
def test_bad_arguments_are_refused(module: Any) -> None:
    good = arguments("canonical", 5, 2, 25.0, 0.25, 0)
    for i, bad in ((1, -good[1]), (2, good[2][:4]), (2, good[2] * np.nan), (3, 0.0), (5, np.nan), (7, "clock")):
        with pytest.raises(ShapeError):
            module.Primitive(*good[:i], bad, *good[i + 1 :])
    p, two = module.Primitive(*good), np.zeros(2)
    for t, tau, y0 in (([0, 0], 1.0, two), ([0, np.nan], 1.0, two), ([0, 1], 0.0, two), ([0, 1], 1.0, np.zeros(3))):
        with pytest.raises(ShapeError):
            p.rollout(np.array(t, dtype=float), tau, y0, two, two, two)
    with pytest.raises(ShapeError, match="weights"):
        p.rollout(np.array([0.0, 1.0]), 1.0, two, two, two, two, np.zeros((1, 4, 2)))
    position = module.Primitive(*good[:7], "position")
    with pytest.raises(ShapeError, match="not linear"):
        position.response(np.array([0.0, 1.0]), 1.0, 0.1)
    with pytest.raises(ShapeError, match="1e7"):
        position.rollout(np.array([0.0, 1e9]), 1.0, two, two, two, two)
    stepper = module.PrimitiveStepper(p)
    stepper.start(two, two, two, two, 1.0)
    for dt in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ShapeError):
            stepper.step(dt)
    with pytest.raises(ShapeError):
        stepper.change_goal(two, two, -two - 1)
    with pytest.raises(ShapeError):
        stepper.change_tau(0.0)
