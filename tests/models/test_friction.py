"""Friction with a presliding state, and ripple."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.kernels import presliding
from armlab.models import Friction, FrictionBound, Ripple


def friction(**change: object) -> Friction:
    fields = {
        "viscous": [2.0], "coulomb_pos": [3.0], "coulomb_neg": [4.0], "offset": [0.5], "stribeck": [1.0],
        "stribeck_speed": [0.05], "delta": [1e-3], "resolution": [0.0],
    }  # fmt: skip
    return Friction(**{**fields, **change})  # type: ignore[arg-type]


def test_friction_torque_is_the_formula() -> None:
    f = friction()
    assert f.torque([1.0], [1.0])[0] == pytest.approx(2 + 3 + 0.5 + np.exp(-400))
    assert f.torque([-1.0], [-1.0])[0] == pytest.approx(-2 - 4 + 0.5 - np.exp(-400))
    assert f.torque([0.0], [0.5])[0] == pytest.approx(1.5 + 0.5 + 0.5)
    assert f.static[0] == pytest.approx(4.5)


def test_the_root_term_grows_with_the_root_of_speed() -> None:
    f, plain = friction(root=[0.7]), friction()
    assert f.torque([4.0], [1.0])[0] - plain.torque([4.0], [1.0])[0] == pytest.approx(1.4)
    assert f.torque([-4.0], [-1.0])[0] - plain.torque([-4.0], [-1.0])[0] == pytest.approx(-1.4)
    assert f.torque([0.0], [1.0])[0] == plain.torque([0.0], [1.0])[0]
    assert np.array_equal(plain.root, [0.0])
    assert np.array_equal(plain.smooth_speed, [0.0])
    assert f.rows.shape == (10, 1)
    assert f.rows[8, 0] == 0.7


def test_a_smooth_sign_takes_the_place_of_presliding() -> None:
    f = friction(smooth_speed=[0.05], stribeck=[0.0])
    for z in (-1.0, 0.0, 1.0):
        assert f.torque([0.05], [z])[0] == pytest.approx(2 * 0.05 + 3 * np.tanh(1.0) + 0.5)
        assert f.torque([-0.05], [z])[0] == pytest.approx(-2 * 0.05 - 4 * np.tanh(1.0) + 0.5)


def test_presliding_is_exact_for_constant_direction_and_holds_at_rest() -> None:
    q = np.concatenate([np.linspace(0, 2e-3, 50), np.full(20, 2e-3), np.linspace(2e-3, 1e-3, 7)])[:, None]
    z = presliding(q, np.array([1e-3]), np.array([0.0]))[:, 0]
    assert z[49] == pytest.approx(1 - np.exp(-2.0), abs=1e-12)
    assert np.all(z[50:70] == z[49])
    assert z[-1] == pytest.approx(-1 + (z[49] + 1) * np.exp(-1.0), abs=1e-12)


def test_the_last_digit_of_an_encoder_does_not_wear_the_state_down() -> None:
    q = np.concatenate([np.linspace(0, 1e-2, 50), 1e-2 - 1e-5 * (np.arange(1000) % 2)])[:, None]
    held = presliding(q, np.array([1e-4]), np.array([0.5e-5]))
    worn = presliding(q, np.array([1e-4]), np.array([0.0]))
    assert held[-1, 0] > 0.99
    assert abs(worn[-1, 0]) < 0.2


def test_ripple_torque() -> None:
    r = Ripple(cycles=[200.0], cosine=[0.3], sine=[0.4])
    assert r.torque([np.pi / 400])[0] == pytest.approx(0.4)


def test_the_bound_near_rest_is_static_friction_and_fades_with_speed() -> None:
    bound = FrictionBound.of(friction(), floor=np.array([0.1]))
    assert bound.torque_at([0.0])[0] == pytest.approx(4.5 + 0.1)
    assert bound.torque_at([[0.02], [-0.02]])[:, 0] == pytest.approx(4.5 * np.exp(-1) + 0.1)
    assert bound.torque_at([1.0])[0] == pytest.approx(0.1)
    assert FrictionBound.of(friction()).floor[0] == 0.0
    for wrong in ({"torque": [-1.0]}, {"speed": [0.0]}, {"floor": [-0.1]}):
        with pytest.raises(ShapeError, match="friction bound"):
            FrictionBound(**{"torque": [1.0], "speed": [0.02], "floor": [0.0], **wrong})


def test_bad_fields_are_refused() -> None:
    with pytest.raises(ShapeError, match="finite viscous"):
        friction(viscous=[np.nan])
    with pytest.raises(ShapeError, match="delta > 0"):
        friction(delta=[0.0])
    with pytest.raises(ShapeError, match="smooth_speed >= 0"):
        friction(smooth_speed=[-0.1])
    with pytest.raises(ShapeError, match="like the other fields"):
        friction(offset=[1.0, 2.0])
