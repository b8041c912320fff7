"""The regression problem of a record: columns, places of the parameters, rows for the solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.identify import base_parameters, design_excitation, prepare
from armlab.identify.friction_structure import DELTAS, STRIBECK_SPEEDS
from armlab.identify.regression import Design, Layout
from armlab.identify.solve import alternate


@pytest.mark.slow  # 5 s beside other work
def test_design_finds_the_shape_of_friction_and_the_parameters_of_a_clean_log(truth) -> None:
    """Noise-free data, truth between the grids DELTAS and STRIBECK_SPEEDS: both shapes come out within 15 %."""
    robot = truth.robot
    data = prepare(truth.log(design_excitation(robot, seconds=20, seed=2), noise=0.0), robot)
    design, theta = alternate(Design.build(data, robot, base_parameters(robot)), "wls")
    assert truth.friction.delta[0] not in DELTAS
    assert not design.shapes.smooth.any()
    np.testing.assert_allclose(design.shapes.delta, truth.friction.delta, rtol=0.15)
    np.testing.assert_allclose(design.shapes.speed, STRIBECK_SPEEDS[1], rtol=0.15)
    assert design.shapes.terms[:, :2].all()
    relative = np.sqrt(np.mean(design.residuals(theta) ** 2, axis=0)) / np.std(design.tau, axis=0)
    assert np.all(relative < 5e-3)
    assert len(design.layout.units) == len(design.layout.names) == len(design.layout.lower) == len(theta)
    assert design.model(theta).shape == design.tau.shape == (len(design.rows), 7)
    pieces = list(design.stream(np.zeros(len(design.rows), dtype=int)))
    assert sum(len(piece.y) for piece in pieces) == design.tau.size


def test_without_known_gears_there_is_no_ripple_line(truth, excited) -> None:
    """Ratio 1 would make cos 2q and sin 2q of it: harmonics of gravity."""
    robot = truth.robot
    data = prepare(excited, robot)
    base = base_parameters(robot)
    assert robots.load("irb7600").coupling[0, 0] == 1.0
    silent = Design.build(data, replace(robot, coupling=np.eye(7)), base)
    assert not silent.geared
    assert not any("ripple" in name for name in silent.layout.names)
    assert len(silent.layout.names) == len(silent.layout.units) == 50 + 5 * 7
    geared = Design.build(data, robot, base)
    assert geared.geared
    np.testing.assert_allclose(geared.made.cycles, [200, 200, 200, 200, 200, 202, 200], rtol=1e-12)


def test_ripple_that_folds_back_is_not_fitted(truth, excited) -> None:
    """At 50 Hz a line of 200 rad/rad passes too fast in most samples; at 250 Hz it is cut where it is too fast."""
    robot, base = truth.robot, base_parameters(truth.robot)
    with pytest.warns(UserWarning, match=r"ripple below 12\.5 Hz, a quarter.*axis_1.*no ripple is fitted"):
        coarse = Design.build(prepare(excited.rows(slice(None, None, 5)), robot), robot, base)
    assert not coarse.geared
    data = prepare(excited, robot)
    told = Design.build(prepare(excited.rows(slice(None, None, 5)), robot), robot, base, geared=True)
    assert told.layout.names == Design.build(data, robot, base).layout.names, "another record may decide"
    fixed = Design.build(data, robot, base, cutoff=np.inf, every=1).fixed
    fast = 202 * np.abs(data.qd[:, 5]) > 2 * np.pi * 62.5
    assert 0.0 < fast.mean() < 0.5
    assert not fixed[fast, 5, 2:].any()
    np.testing.assert_allclose(np.hypot(*fixed[~fast, 5, 2:].T), 1.0)


def test_a_motor_that_moves_two_joints_brings_shared_columns(truth, excited) -> None:
    """Motor 7 turns with q6 + q7: its inertia and friction act on both rows, and come out."""
    robot = truth.robot
    gears = np.linalg.inv(robot.coupling)
    gears[6, 5] = gears[6, 6]
    robot = replace(robot, coupling=np.linalg.inv(gears))
    data = prepare(excited, robot)
    base = base_parameters(robot)
    design = Design.build(data, robot, base)
    assert design.layout.names[-3:] == tuple(f"{term} of motor axis_6" for term in ("rotor", "viscous", "coulomb"))
    np.testing.assert_array_equal(design.made.motors, [[0, 0, 0, 0, 0, 1, 1]])
    theta = np.zeros(len(design.layout.names))
    theta[-3:] = 0.02, 0.3, 0.5
    speed = data.qd[:, 5] + data.qd[:, 6]
    torque = 0.02 * data.differentiate(speed) + 0.3 * speed + 0.5 * np.tanh(speed / 0.02)
    expected = np.zeros_like(design.tau)
    expected[:, 5:] = design.thinning.run(lambda a, b: torque[a:b, None], 1)
    np.testing.assert_allclose(design.model(theta), expected, atol=1e-9)


def test_joints_whose_torque_is_not_measured_are_left_out(truth, excited) -> None:
    robot, measured = truth.robot, [1, 3, 4]
    base = base_parameters(robot, joints=measured)
    design = Design.build(prepare(excited, robot), robot, base, joints=measured, cutoff=np.inf, every=10)
    assert design.tau.shape == (750, 3)
    assert len(base.names) < 50
    np.testing.assert_array_equal(design.tau, excited["tau"][::10][:, measured])
    friction, ripple = design.drives(np.arange(1.0, len(design.layout.names) + 1))
    assert np.all(friction.viscous[measured] > 0)
    assert not friction.viscous[[0, 2, 5, 6]].any()
    assert not ripple.cosine[[0, 2, 5, 6]].any()


def test_slopes_are_the_derivatives_of_the_torque_over_the_logarithms(short_arm) -> None:
    """A shape moved by a little changes the torque by slope times step; parameters come back in their units."""
    robot = short_arm.robot
    design = Design.build(prepare(short_arm.log(0, 2000), robot), robot, base_parameters(robot))
    theta = np.linspace(1.0, 2.0, len(design.layout.names))
    sloped = design.with_slopes(theta)
    assert sloped.free.all()
    at = np.flatnonzero(sloped.layout.slopes)
    assert [sloped.layout.names[k].split()[0] for k in at] == ["delta", "stribeck-speed"] * 2
    x = np.zeros(len(sloped.layout.names))
    x[~sloped.layout.slopes] = theta
    moved = x
    for k, step in zip(at, (1e-3, -1e-3, 2e-3, 1e-3)):
        moved = x.copy()
        moved[k] = step
        change = design.with_shapes(sloped.moved(moved)).model(theta) - design.model(theta)
        np.testing.assert_allclose(sloped.model(moved) - sloped.model(x), change, atol=3e-3 * np.abs(change).max())
        found, cov = sloped.in_units(moved, np.eye(len(x)))
        assert found[k] == pytest.approx(sloped.shapes.numbers.ravel()[list(at).index(k)] * np.exp(step))
        assert cov[k, k] == pytest.approx(found[k] ** 2)
    assert sloped.drives(moved)[0].stribeck_speed[1] == pytest.approx(0.1 * np.exp(1e-3))
    only = design.with_slopes(theta, np.array([[True, False], [False, False]]))
    assert only.layout.slopes.sum() == 1


# Names, units, bounds and places of the parameters.


def test_every_parameter_has_one_name_unit_bound_and_place(short_arm) -> None:
    robot = short_arm.robot
    base = base_parameters(robot)
    p, motors = len(base.names), np.array([[1.0, 1.0]])
    terms = (("viscous", "coulomb", "offset", "delta"), ("viscous", "coulomb+", "coulomb-", "offset", "root"))
    layout = Layout(robot, base, np.arange(2), motors, np.array([1]), terms)
    assert len(layout.names) == len(layout.units) == len(layout.lower) == len(layout.slopes) == p + 4 + 5 + 3
    assert len(set(layout.names)) == len(layout.names)
    np.testing.assert_array_equal(np.flatnonzero(layout.slopes), [p + 3])
    assert layout.names[p + 3] == f"delta {robot.joint_names[0]}"
    assert layout.units[p + 3] == "rad"
    assert layout.units[p + 8] == "N m sqrt(s/rad)"
    np.testing.assert_array_equal(layout.lower[p : p + 4], [0.0, 0.0, -np.inf, -np.inf])
    for i, (columns, own) in enumerate(zip(layout.columns, ([*range(p, p + 4)], [*range(p + 4, p + 9)]))):
        motor = [p + 9, p + 10, p + 11]
        np.testing.assert_array_equal(columns, [*np.flatnonzero(base.seen[i]), *own, *motor])


# Rows of a design in pieces: together they are all of it, once for each reading.
