"""The regression problem: columns, shapes of friction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab import robots
from armlab.identify import base_parameters, excitation, prepare
from armlab.identify.design import Design
from armlab.identify.dynamics import settle
from armlab.identify.shapes import DELTAS, STRIBECK_SPEEDS


def test_design_finds_the_shape_of_friction_and_the_parameters_of_a_clean_log(truth) -> None:
    """Noise-free data, truth between the grids DELTAS and STRIBECK_SPEEDS: both shapes come out within 15 %."""
    robot = truth.robot
    data = prepare(truth.log(excitation(robot, seconds=20, seed=2), noise=0.0), robot)
    design, theta = settle(Design.build(data, robot, base_parameters(robot)), "wls")
    assert truth.friction.delta[0] not in DELTAS
    assert not design.shapes.smooth.any()
    np.testing.assert_allclose(design.shapes.delta, truth.friction.delta, rtol=0.15)
    np.testing.assert_allclose(design.shapes.speed, STRIBECK_SPEEDS[1], rtol=0.15)
    assert design.shapes.terms[:, :2].all()
    relative = np.sqrt(np.mean(design.residuals(theta) ** 2, axis=0)) / np.std(design.tau, axis=0)
    assert np.all(relative < 5e-3)
    assert len(design.units) == len(design.names) == len(design.lower) == len(theta)
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
    assert not any("ripple" in name for name in silent.names)
    assert len(silent.names) == len(silent.units) == 50 + 5 * 7
    geared = Design.build(data, robot, base)
    assert geared.geared
    np.testing.assert_allclose(geared.cycles, [200, 200, 200, 200, 200, 202, 200], rtol=1e-12)
