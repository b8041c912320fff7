"""Friction: terms, maps over position, ripple lines, warm-up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.kernels import presliding
from armlab.models import (
    Friction,
    FrictionBound,
    FrictionMap,
    RadialBasis,
    Ripple,
    RippleLines,
    WarmUp,
    load,
    save,
    speed_basis,
)


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


# Friction over position and speed.


def basis(n: int = 2) -> RadialBasis:
    positions, speeds = np.linspace(-2, 2, 8), np.geomspace(0.05, 1.0, 5)
    return RadialBasis(*(np.tile(x, (n, 1)) for x in (positions, np.full(8, 0.5), speeds, np.gradient(speeds))))


def test_the_functions_sum_to_one_inside_and_outside() -> None:
    rng = np.random.default_rng(0)
    q, qd = rng.uniform(-3, 3, 500), rng.uniform(-2, 2, 500)
    phi = basis().functions(1, q, qd, rng.uniform(-1, 1, 500))
    np.testing.assert_allclose(phi.sum(axis=1), 1.0, rtol=0, atol=1e-12)
    assert phi.shape == (500, basis().size)
    assert np.isfinite(basis().functions(0, np.array([1e6]), np.array([-1e6]), np.array([-1.0]))).all()


def test_only_the_side_of_the_motion_counts_and_rest_blends_both() -> None:
    b = basis()
    forward, rest = (
        b.functions(0, np.array([0.3]), np.array([v]), np.array([s]))[0] for v, s in ((0.2, 1.0), (0.0, 0.0))
    )
    assert not forward[40:].any()
    np.testing.assert_allclose(rest[:40], rest[40:], rtol=0, atol=1e-15)


def test_outside_is_told() -> None:
    assert basis().outside([[0.0, 0.0], [2.5, 0.0]], [[0.0, 2.0], [0.1, -0.5]]).tolist() == [
        [False, True],
        [True, False],
    ]


def test_torque_is_functions_times_coefficients() -> None:
    rng = np.random.default_rng(1)
    b, k = basis(), rng.standard_normal((2, 2, 8, 5))
    q, qd, z = rng.uniform(-1, 1, (3, 60, 2))
    expected = np.stack([b.functions(i, q[:, i], qd[:, i], z[:, i]) @ k[i].ravel() for i in range(2)], axis=1)
    np.testing.assert_allclose(FrictionMap(b, k).torque(q, qd, z), expected, rtol=0, atol=1e-12)


def test_a_model_keeps_its_map(tmp_path, model) -> None:
    part = FrictionMap(basis(7), np.random.default_rng(0).standard_normal((7, 2, 8, 5)))
    more = replace(model, friction_map=part)
    again = load(save(more, tmp_path / "model.toml"))
    q, qd = np.random.default_rng(1).standard_normal((2, 40, 7))
    assert np.array_equal(again.torque(q, qd), more.torque(q, qd))
    with pytest.raises(ShapeError, match="map positions"):
        replace(model, friction_map=FrictionMap(basis(2), np.zeros((2, 2, 8, 5))))


def test_wrong_centres_are_refused() -> None:
    b = basis()
    with pytest.raises(ShapeError, match="speeds above 0"):
        replace(b, speeds=b.speeds - 0.05)
    with pytest.raises(ShapeError, match="positive widths"):
        replace(b, position_widths=0 * b.position_widths)
    with pytest.raises(ShapeError, match="shape"):
        replace(b, speeds=b.speeds[:1])
    with pytest.raises(ShapeError, match="coefficients"):
        FrictionMap(b, np.zeros((2, 2, 8, 4)))


# Torque ripple over position and speed.


def lines(**change: object) -> RippleLines:
    """Two joints, the second with two lines of one direction."""
    speeds, widths = speed_basis(-1.0, 1.0)
    fields = {
        "joint": [1, 1], "cycles": [100.0, 200.0], "speeds": np.stack([speeds, speeds]),
        "widths": np.stack([widths, widths]), "coefficients": np.ones((2, 1, 8, 2)),
    }  # fmt: skip
    return RippleLines(**{**fields, **change})  # type: ignore[arg-type]


def test_equal_amplitudes_are_a_plain_line() -> None:
    q, qd = np.random.default_rng(0).uniform(-2, 2, (2, 50, 2))
    torque = lines().torque(q, qd, np.sign(qd))
    expected = sum(np.cos(c * q[:, 1]) + np.sin(c * q[:, 1]) for c in (100.0, 200.0))
    np.testing.assert_allclose(torque[:, 1], expected, rtol=0, atol=1e-12)
    assert not torque[:, 0].any()
    assert lines().n == 2


def test_each_direction_may_have_its_own_amplitude() -> None:
    speeds, widths = speed_basis(0.0, 1.0)
    both = np.zeros((1, 2, 8, 2))
    both[0, 0, :, 0], both[0, 1, :, 1] = 2.0, 3.0
    part = RippleLines([0], [50.0], speeds[None], widths[None], both)
    q = np.linspace(0, 1, 30)[:, None]
    np.testing.assert_allclose(part.torque(q, 0 * q + 0.3, 0 * q + 1), 2 * np.cos(50 * q), rtol=0, atol=1e-12)
    np.testing.assert_allclose(part.torque(q, 0 * q - 0.3, 0 * q - 1), 3 * np.sin(50 * q), rtol=0, atol=1e-12)


def test_a_model_keeps_its_lines(tmp_path, model) -> None:
    from dataclasses import replace

    speeds, widths = speed_basis(0.0, 2.0)
    part = RippleLines([0, 6], [100.0, 202.0], np.tile(speeds, (7, 1)), np.tile(widths, (7, 1)),
                       np.random.default_rng(0).standard_normal((2, 2, 8, 2)))  # fmt: skip
    more = replace(model, lines=part)
    again = load(save(more, tmp_path / "model.toml"))
    q, qd = np.random.default_rng(1).standard_normal((2, 40, 7))
    assert np.array_equal(again.torque(q, qd), more.torque(q, qd))
    assert not np.allclose(more.torque(q, qd), model.torque(q, qd))
    with pytest.raises(ShapeError, match="line speeds"):
        replace(model, lines=lines())


def test_wrong_lines_are_refused() -> None:
    with pytest.raises(ShapeError, match="joint by joint"):
        lines(joint=[1, 0])
    with pytest.raises(ShapeError, match="ascending speeds"):
        lines(widths=np.zeros((2, 8)))
    with pytest.raises(ShapeError, match="finite cycles"):
        lines(cycles=[1.0, np.nan])
    with pytest.raises(ShapeError, match="coefficients"):
        lines(coefficients=np.ones((2, 3, 8, 2)))
    with pytest.raises(ShapeError, match="2 Gaussians"):
        speed_basis(1.0, 1.0)


# Friction that changes with its own heat.


def warm_up(n: int = 1, **change: object) -> WarmUp:
    fields = {"of_coulomb": -0.1, "of_viscous": -0.4, "time": 100.0, "power": 2.0, "start": 0.0}
    return WarmUp(**{name: np.full(n, change.get(name, value)) for name, value in fields.items()})  # type: ignore[arg-type]


def test_warmth_settles_at_one_under_the_reference_power() -> None:
    x = warm_up().warmth(np.full((1001, 1), 2.0), np.ones(1001))
    assert x[0, 0] == 0.0
    assert x[100, 0] == pytest.approx(1 - np.exp(-1.0))
    assert x[-1, 0] == pytest.approx(1.0, abs=1e-4)
    assert np.all(warm_up(time=0.0, start=0.3).warmth(np.ones((5, 1)), np.ones(5)) == 0.3)


def test_a_model_warms_up_along_a_record(tmp_path, model) -> None:
    """At constant velocity the viscous and Coulomb torque go with the warmth, which goes with their power."""
    part = warm_up(7, time=5.0)
    warm = load(save(replace(model, warm_up=part), tmp_path / "model.toml"))
    t = np.arange(0, 40, 0.01)
    qd = np.full((len(t), 7), 0.3)
    q, dt = np.cumsum(qd, axis=0) * 0.01, np.full(len(t), 0.01)
    change = (warm.torque(q, qd, dt=dt) - model.torque(q, qd)) / model.gains
    f = model.friction
    x = (change / -(0.4 * f.viscous * 0.3 + 0.1 * f.coulomb_pos))[200:]
    settled = x[-1]
    rubbing = f.viscous * (1 - 0.4 * settled) * 0.3 + f.coulomb_pos * (1 - 0.1 * settled)
    rubbing = rubbing + f.stribeck * np.exp(-((0.3 / f.stribeck_speed) ** 2))
    np.testing.assert_allclose(settled, np.abs(rubbing * 0.3) / 2.0, rtol=1e-2)
    assert np.array_equal(warm.torque(q, qd), model.torque(q, qd))  # without steps it stays cold


def test_wrong_warm_up_is_refused() -> None:
    with pytest.raises(ShapeError, match="power > 0"):
        warm_up(power=0.0)
    with pytest.raises(ShapeError, match="finite time"):
        warm_up(time=np.nan)
    with pytest.raises(ShapeError, match="one number per joint"):
        replace(warm_up(), start=np.zeros(2))
