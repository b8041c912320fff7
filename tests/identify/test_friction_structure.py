"""The structure of friction, chosen on held-out blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.identify.columns import Decimation, FrictionColumns
from armlab.identify.friction_structure import (
    COLUMNS,
    DELTAS,
    FOLDS,
    SMOOTH_SPEEDS,
    STRIBECK_SPEEDS,
    TERMS,
    Choice,
    Chooser,
    FrictionStructure,
    choose,
    choose_here,
    mixing,
    term_names,
)
from armlab.kernels import presliding


def record(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A joint that goes to and fro at many speeds: q and qd (N, 1), 100 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(6000) * 0.01
    f, phase = rng.uniform(0.1, 0.8, 8), rng.uniform(0, 6, 8)
    wave = 2 * np.pi * f * t[:, None] + phase
    return (0.05 * np.sin(wave)).sum(axis=1)[:, None], (0.05 * 2 * np.pi * f * np.cos(wave)).sum(axis=1)[:, None]


def choice(q: np.ndarray, qd: np.ndarray, y: np.ndarray, trust: np.ndarray) -> Choice:
    """All rows of a record without a filter, in folds of half a second."""
    rows = np.arange(len(q))
    motion = FrictionColumns(Decimation(((0, len(q)),), 1, np.ones(1), rows), q, qd, np.zeros(1))
    fixed = np.column_stack([qd, np.ones_like(qd)])
    return Choice(motion, fixed, y[:, 0], rows // 50 % FOLDS, trust)


def chosen(torque, noise: float = 0.02) -> FrictionStructure:
    q, qd = record()
    y = torque(q, qd) + noise * np.random.default_rng(1).standard_normal(q.shape)
    return choose(choice(q, qd, y, np.ones(len(q))))


def test_presliding_friction_is_told_from_a_smooth_sign_and_refined() -> None:
    delta = 1.3 * DELTAS[4]
    found = chosen(lambda q, qd: presliding(q, np.array([delta]), np.zeros(1)) + 0.3 * qd)
    assert found.smooth[0] == 0
    assert found.delta[0] == pytest.approx(delta, rel=0.1)
    assert not found.terms.any()


def test_a_smooth_sign_with_root_and_asymmetry_is_found() -> None:
    v = 0.7 * SMOOTH_SPEEDS[3]

    def torque(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        s = np.tanh(qd / v)
        return 1.3 * np.maximum(s, 0) + 0.7 * np.minimum(s, 0) + s * np.sqrt(np.abs(qd))

    found = chosen(torque)
    assert found.smooth[0] == pytest.approx(v, rel=0.15)
    np.testing.assert_array_equal(found.terms[0], [True, False, True])


def test_stribeck_is_found_with_its_speed() -> None:
    speed = 1.2 * STRIBECK_SPEEDS[1]

    def torque(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        z = presliding(q, np.array([1e-3]), np.zeros(1))
        return z * (1.0 + 0.5 * np.exp(-((qd / speed) ** 2)))

    found = chosen(torque)
    assert found.terms[0, 1]
    assert found.speed[0] == pytest.approx(speed, rel=0.15)


def test_rows_without_trust_do_not_count() -> None:
    q, qd = record()
    y = presliding(q, np.array([1e-3]), np.zeros(1))
    bad = np.arange(len(q)) % 20 == 0
    y = np.where(bad[:, None], 50.0, y)
    found = choose(choice(q, qd, y, 1.0 - bad))
    assert found.delta[0] == pytest.approx(1e-3, rel=0.1)


def test_joints_are_chosen_one_after_the_other_and_joined() -> None:
    q, qd = record()
    y = presliding(q, np.array([1e-3]), np.zeros(1))
    one = choice(q, qd, y, np.ones(len(q)))
    chooser: Chooser = choose_here
    both = FrictionStructure.joined(chooser([one, replace(one, target=np.tanh(qd[:, 0] / 0.05))]))
    assert both.delta.shape == both.smooth.shape == both.speed.shape == (2,)
    assert both.terms.shape == (2, 3)
    assert both.smooth[0] == 0.0 < both.smooth[1]
    assert [bool(soft) for soft in choose(one).smooth] == [False]


@pytest.mark.parametrize("terms", TERMS)
def test_mixing_gives_the_columns_that_have_names(terms: np.ndarray) -> None:
    width = len(COLUMNS)
    names, T = term_names(terms, ripple=True), mixing(terms, width)
    assert T.shape == (width, len(names)) == (width, 5 + terms.sum())
    assert ("coulomb" in names) != terms[0]
    assert ("stribeck" in names, "root" in names) == tuple(terms[1:])
    np.testing.assert_array_equal(T.sum(axis=0) > 1, [name == "coulomb" for name in names])
    assert term_names(terms, ripple=False) == names[:-2]


def test_same_shapes_agree_to_ten_per_cent() -> None:
    one = FrictionStructure.start(3)
    assert one.same(FrictionStructure(one.delta * 1.05, one.smooth, one.speed, one.terms))
    assert not one.same(FrictionStructure(one.delta * 1.3, one.smooth, one.speed, one.terms))
    assert not one.same(FrictionStructure(one.delta, one.smooth + 0.02, one.speed, one.terms))
    assert not one.same(FrictionStructure(one.delta, one.smooth, one.speed, ~one.terms))


def test_numbers_move_by_factors_within_the_range_of_the_search() -> None:
    shapes = FrictionStructure(np.full(2, 1e-3), np.array([0.0, 0.02]), np.array([0.1, 0.5]), TERMS[[2, 3]])
    np.testing.assert_array_equal(shapes.numbers, [[1e-3, 0.1], [0.02, 0.5]])
    assert shapes.names == [("delta", "stribeck-speed"), ("tanh-speed", "stribeck-speed")]
    moved = shapes.moved(np.log([[2.0, 0.5], [3.0, 4.0]]))
    np.testing.assert_allclose(moved.numbers, [[2e-3, 0.05], [0.06, 2 * STRIBECK_SPEEDS[-1]]])
    assert moved.delta[1] == shapes.delta[1]
    assert moved.smooth[0] == 0.0
