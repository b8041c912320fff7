"""Contacts during the calibration of a force sensor: where they would spoil the start, or lead to another answer."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.calibrate import fit_force_sensor
from armlab.calibrate.gravity_load.model import Load, WeightEquation, likely_samples, mirror_solution
from armlab.lie import so3

G = np.array([0.0, 0.0, -9.82])
TILT = np.radians(30.0)


@pytest.mark.parametrize("known", [True, False], ids=["noise given", "noise estimated"])
@pytest.mark.parametrize(("torque", "unknown"), [(None, True), (0.005, True), (0.005, False)])
@pytest.mark.parametrize(("N", "bad"), [(100, 30), (20, 4)])
def test_contacts_do_not_lead_to_another_answer(weights, known, torque, unknown, N, bad) -> None:
    """Small tilts and unknown gravity: started from all samples, most of these fits ended half a turn away."""
    for run in range(3):
        data = weights.draw([20, run], N, tilt=TILT, torque=torque)
        y = weights.touched(np.random.default_rng(run), data.y, slice(0, bad))
        fit = fit_force_sensor(
            data.RA, y, gravity="unknown" if unknown else G, robust=True,
            noise=(0.1 if torque is None else (0.1, torque)) if known else None,
        )  # fmt: skip
        assert fit.outliers[:bad].all()
        assert fit.outliers.sum() <= bad + 3
        e = so3.log(data.R.T @ fit.value.R_tool_sensor)
        assert e @ np.linalg.solve(fit.cov[:3, :3], e) < 25.0
        np.testing.assert_allclose(fit.value.mass * fit.value.gravity, G, atol=6 * 0.1)


@pytest.mark.parametrize("pull", [G, None], ids=["known", "unknown gravity"])
def test_a_start_leaves_contacts_out(weights, pull) -> None:
    data = weights.draw(21, tilt=TILT, contacts=30)
    y = data.y
    found = likely_samples(WeightEquation(data.RA, y, pull, True, None, None, ("force [N]",) * 3, "force sensor"))
    assert not found[:30].any()
    assert found[30:].sum() > 60
    few = WeightEquation(data.RA[:5], y[:5], pull, True, None, None, ("force [N]",) * 3, "force sensor")
    assert likely_samples(few).all()  # as many unknowns: nothing to tell by


@pytest.mark.parametrize("torque", [None, 0.0], ids=["forces", "torques"])
def test_the_twin_reads_the_same_to_first_order(weights, torque) -> None:
    for tilt in (0.2, 0.02):
        data = weights.draw(22, sigma=0.0, tilt=tilt, torque=torque)
        equation = WeightEquation(data.RA, data.y, None, True, None, None, ("f",) * data.y.shape[1], "force sensor")
        other = mirror_solution(equation, Load(data.R, G, data.bias, data.centre))
        assert other is not None
        assert np.abs(so3.log(data.R.T @ other.R)).max() > 1.0
        np.testing.assert_array_equal(other.gamma, -G)
        swing = np.abs(data.y - data.y.mean(axis=0)).max()
        assert np.abs(equation.evaluate(other)[0].r).max() < tilt * swing


def test_where_there_is_no_twin(weights) -> None:
    for tilt, bias in ((None, True), (0.1, False)):
        data = weights.draw(23, tilt=tilt)
        equation = WeightEquation(data.RA, data.y, None, bias, None, None, ("f",) * 3, "force sensor")
        assert mirror_solution(equation, Load(data.R, G, data.bias, data.centre)) is None
