"""Excitation: unit-free judgement, and refusal by name."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited
from armlab.estimation import Excitation, check_excitation

NAMES = ("mass", "offset", "viscous")


def gram(scale: np.ndarray | float = 1.0) -> np.ndarray:
    A = np.random.default_rng(0).standard_normal((100, 3)) * scale
    return A.T @ A


def test_check_excitation_is_free_of_units() -> None:
    plain, scaled = check_excitation(gram(), NAMES, "model"), check_excitation(gram([1e6, 1.0, 1e-9]), NAMES, "model")
    assert isinstance(plain, Excitation)
    np.testing.assert_allclose(plain.singular_values, scaled.singular_values, rtol=1e-6)
    assert plain.rank == plain.expected == 3
    assert plain.condition < 2
    assert "good" in plain.text()


def test_a_column_without_signal_is_named() -> None:
    dead = gram([1.0, 0.0, 1.0])
    with pytest.raises(NotExcited, match="none at all for: offset") as caught:
        check_excitation(dead, NAMES, "model")
    assert caught.value.directions == ("offset",)


def test_a_direction_that_two_parameters_share_is_named() -> None:
    A = np.random.default_rng(0).standard_normal((100, 3))
    A[:, 2] = A[:, 0] + 1e-7 * A[:, 1]
    with pytest.raises(NotExcited, match=r"mass and viscous|viscous and mass") as caught:
        check_excitation(A.T @ A, NAMES, "model")
    assert len(caught.value.directions) == len(caught.value.spread) == 1


def test_measuring_does_not_judge() -> None:
    A = np.random.default_rng(0).standard_normal((100, 3))
    A[:, 2] = A[:, 0] + 1e-7 * A[:, 1]
    found = Excitation.of(A.T @ A, NAMES)
    assert (found.rank, found.expected) == (2, 3)
    assert found.condition > 1e6
    assert "mass" in found.weakest
    assert "viscous" in found.weakest


def test_condition_of_a_rank_deficient_matrix_is_infinite() -> None:
    assert Excitation(1, 2, np.array([1.0, 0.0]), "x").condition == float("inf")
    assert "weak" in Excitation(2, 2, np.array([1.0, 1e-3]), "x").text()
