"""The shape of friction and the linear parameters, settled together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.identify import base_parameters, prepare
from armlab.identify.regression import Design
from armlab.identify.solve import ROBUST, alternate, linearised, short_blocks, solved


@pytest.mark.slow  # 5 s beside other work
def test_settle_uses_the_rows_it_is_told_and_spares_outliers(truth, excited) -> None:
    """Half of the blocks spoilt: used, they ruin the fit; left out, the other half gives it."""
    robot = truth.robot
    data = prepare(excited.between(0.0, 16.0), robot)
    half = data.blocks(1.0) % 2 == 1
    spoilt = replace(data, tau=data.tau + np.where(half[:, None], 5.0, 0.0))
    design = Design.build(spoilt, robot, base_parameters(robot))
    use = ~half[design.rows]
    use = np.all([np.roll(use, k) for k in range(-16, 17)], axis=0)  # the filter carries steps over the edge of a block
    found, theta = alternate(design, "wls", use=use)
    error = found.residuals(theta)[use]
    assert np.all(np.std(error, axis=0) < 0.05 * np.std(data.tau, axis=0))


@pytest.mark.parametrize("method", ROBUST)
def test_where_all_has_settled_there_is_no_step_left(short_arm, method) -> None:
    """The distance of presliding is that of least squares: a straight line there leads nowhere else."""
    data = prepare(short_arm.log(3, 3000), short_arm.robot)
    design, theta = alternate(Design.build(data, short_arm.robot, base_parameters(short_arm.robot)), method)
    assert not design.layout.slopes.any()
    assert np.linalg.norm(solved(design, None, method).x - theta) < 0.05 * np.linalg.norm(theta)
    sloped = linearised(design, theta, method)
    assert sloped.layout.slopes.sum() == sloped.free.sum() == 2
    again = linearised(*alternate(design, method), method)
    np.testing.assert_allclose(again.shapes.delta, design.shapes.delta, rtol=0.01)
    np.testing.assert_allclose(design.shapes.delta, 1e-3, rtol=0.15)


def test_numbers_that_the_log_does_not_tell_have_no_slope(short_arm) -> None:
    """Torque of noise alone: no straight line holds for a distance that nothing shows."""
    log = short_arm.log(0, 3000)
    data = prepare(log, short_arm.robot)
    noise = replace(data, tau=np.random.default_rng(0).standard_normal(data.tau.shape))
    design = Design.build(noise, short_arm.robot, base_parameters(short_arm.robot))
    theta = np.full(len(design.layout.names), 1e-3)
    assert not linearised(design, theta, "wls").free.any()


def test_blocks_are_short_but_not_too_many(short_arm) -> None:
    data = prepare(short_arm.log(0, 3000), short_arm.robot)
    assert short_blocks(data) == 0.25
    assert short_blocks(replace(data, t=data.t * 100.0, dt=data.dt * 100.0)) > 0.25
