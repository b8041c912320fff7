"""Force sensors with unequal noise, a known mass and poses in either form, whatever else is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.calibrate import fit_force_sensor
from armlab.errors import NotExcited
from armlab.lie import se3, so3

G = np.array([0.0, 0.0, -9.82])
NOISE = {3: 0.1, 6: (0.1, 0.005)}


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("torque", [None, 0.005], ids=["forces", "torques"])
@pytest.mark.parametrize("robust", [False, True])
def test_a_known_mass_is_kept_in_every_kind_of_fit(weights, bias, torque, robust) -> None:
    data = weights.draw(14, torque=torque)
    y = data.y if bias else data.y - data.bias
    y[:4] += 20.0 * robust
    fit = fit_force_sensor(data.RA, y, gravity=G, mass=1.0, bias=bias, noise=NOISE[y.shape[1]], robust=robust)
    assert fit.value.mass == pytest.approx(1.0, abs=1e-12)
    assert "mass" not in fit.names
    assert len(fit.names) == 3 + 3 * bias + (3 + 3 * bias) * (torque is not None)
    assert fit.outliers[:4].all() == robust
    np.testing.assert_allclose(so3.log(data.R.T @ fit.value.R_tool_sensor), 0.0, atol=5 * fit.sd[:3].max())
    if not bias:
        np.testing.assert_array_equal(fit.value.bias[: y.shape[1]], 0.0)


@pytest.mark.parametrize("width", [3, 6])
def test_unequal_noise_counts_by_its_size(weights, width) -> None:
    """One axis ten times worse than another, correlated, growing from sample to sample."""
    told, equal = [], []
    for run in range(25):
        data, rng = weights.draw([15, run], torque=None if width == 3 else 0.005), np.random.default_rng([15, run])
        scale = np.array([0.05, 0.5, 0.1, 0.002, 0.02, 0.005])[:width]
        mix = scale[:, None] * (np.eye(width) + 0.3 * rng.standard_normal((width, width)))
        size = np.linspace(0.2, 3.0, 100)[:, None]
        y = data.exact + size * rng.standard_normal((100, width)) @ mix.T
        cov = size[:, :, None] ** 2 * (mix @ mix.T)
        fit = fit_force_sensor(data.RA, y, gravity=G, noise=cov)
        for one, values in ((fit, told), (fit_force_sensor(data.RA, y, gravity=G), equal)):
            v = one.value
            e = [so3.log(data.R.T @ v.R_tool_sensor), [v.mass - 1.0], v.bias[:3] - data.bias[:3]]
            e += [v.centre - data.centre, v.bias[3:] - data.bias[3:]] if width == 6 else []
            e = np.concatenate(e)
            values.append(e @ np.linalg.solve(fit.cov, e) / len(e))
    assert 0.8 < np.mean(told) < 1.2
    assert np.mean(equal) > 4.0 * np.mean(told)


@pytest.mark.parametrize("width", [3, 6])
def test_noise_in_its_forms_is_the_same_noise(weights, width) -> None:
    data = weights.draw(16, torque=None if width == 3 else 0.005)
    S = np.diag(np.repeat(np.square(NOISE[width]), 3))
    first, *others = (fit_force_sensor(**data.given, noise=n) for n in (NOISE[width], S, np.tile(S, (100, 1, 1))))
    for other in others:
        np.testing.assert_allclose(other.parameters, first.parameters, atol=1e-9)
        np.testing.assert_allclose(other.cov, first.cov, rtol=1e-6, atol=1e-12)


def test_orientations_and_poses_are_the_same(weights) -> None:
    """Defect of the original: it failed on 4x4 poses."""
    data = weights.draw(17)
    poses = se3.from_rp(data.RA, np.random.default_rng(0).standard_normal((100, 3)))
    first, second = (fit_force_sensor(T, data.y, gravity=G) for T in (data.RA, poses))
    assert first.parameters.tobytes() == second.parameters.tobytes()


def test_torques_sharpen_the_rotation(weights) -> None:
    """Defect of the original: torques were never used."""
    data = weights.draw(18, torque=0.005)
    both = fit_force_sensor(**data.given, noise=NOISE[6])
    forces = fit_force_sensor(data.RA, data.y[:, :3], gravity=G, noise=0.1)
    assert np.trace(both.cov[:3, :3]) < 0.5 * np.trace(forces.cov[:3, :3])


def test_two_orientations_leave_the_centre_of_mass_along_their_axis(weights) -> None:
    """Gravity moves along one line over the tool: also the centre of mass along it is not told."""
    data = weights.draw(19, torque=0.005)
    RA, y = np.tile(data.RA[:2], (50, 1, 1)), np.tile(data.exact[:2], (50, 1))
    with pytest.raises(NotExcited, match=r"rotation about tool axis \(.*\), bias and centre of mass along it"):
        fit_force_sensor(RA, y, gravity=G)
    with pytest.raises(NotExcited, match=r"rotation about tool axis \(.*\), bias along it"):
        fit_force_sensor(RA, y[:, :3], gravity=G)
