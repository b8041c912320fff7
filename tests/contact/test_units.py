"""Every method: the wrench does not depend on the units, and a joint is trusted less when it is said to be noisier."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import identify
from armlab.contact import Estimator
from armlab.log import Table
from armlab.models import FORCE_RATES, PRIOR, TorqueModel, velocity_covariance

WAYS: dict[str, dict[str, Any]] = {
    **{name: {"method": name} for name in ("map", "bounded", "clip", "interval", "ls", "lund", "observer", "kf")},
    "kf with bias": {"method": "kf", "bias": True},
}
CHECKED = [name for name in WAYS if name != "lund"]


@pytest.fixture(scope="module")
def log(truth) -> Table:
    """A hard push in motion: the bound of no joint hides it."""
    wrench = np.array([12.0, -9.0, 10.0, 0.4, 0.5, -0.3])
    motion = identify.dither(truth.robot.q_home + np.array([0.2, 0.1, -0.3, 0.2, 0.1, 0.3, 0.0]), seconds=1.0)
    return truth.log(motion, seed=3, wrench=lambda t: np.tile(wrench, (len(t), 1))).between(0.3, 0.6)


def in_units(model: TorqueModel, force: float, length: float) -> TorqueModel:
    """The model where one newton is `force` units of force and one metre `length` units of length."""
    torque, f, r, c, b = force * length, model.friction, model.ripple, model.covariance, model.bound
    frames = np.array(model.frames)
    frames[:, :3, 3] *= length
    links = model.link_parameters * np.r_[force / length, np.full(3, force), np.full(6, torque)]
    torques = ("viscous", "coulomb_pos", "coulomb_neg", "offset", "stribeck", "root")
    return replace(
        model,
        frames=frames,
        gravity=model.gravity * length,
        link_parameters=links,
        rotor=model.rotor * torque,
        friction=replace(f, **{name: getattr(f, name) * torque for name in torques}),
        ripple=replace(r, cosine=r.cosine * torque, sine=r.sine * torque),
        covariance=velocity_covariance(c.kind, c.C0 * torque**2, c.Cinf * torque**2, c.shape, c.alpha2),
        bound=replace(b, torque=b.torque * torque, floor=b.floor * torque),
    )


def estimate(
    way: str, model: TorqueModel, truth: Any, log: Table, force: float = 1.0, length: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Wrench (N, 6) and covariance (N, 6, 6), told in newtons and metres."""
    scale = np.r_[np.full(3, force), np.full(3, force * length)]
    options = dict(WAYS[way])
    if options["method"] == "kf":
        options["force_rate"] = np.array(FORCE_RATES["normal"]) * scale
    estimator = Estimator(in_units(model, force, length), truth.robot, prior=np.array(PRIOR) * scale, **options)
    table = estimator.run(log.with_column("tau", log["tau"] * force * length))
    return table["wrench_hat"] / scale, table["wrench_hat_cov"] / np.outer(scale, scale)


@pytest.mark.parametrize(("force", "length"), [(1e-3, 1.0), (1.0, 1e3), (1e-3, 1e3)], ids=["kN", "mm", "kN mm"])
@pytest.mark.parametrize("way", CHECKED)
def test_the_wrench_is_the_same_in_all_units(truth, model, log, way: str, force: float, length: float) -> None:
    F, cov = estimate(way, model, truth, log)
    other, other_cov = estimate(way, model, truth, log, force, length)
    accuracy = 1e-6 if way == "clip" else 1e-9  # clip stops at a tolerance
    np.testing.assert_allclose(other / PRIOR, F / PRIOR, rtol=0, atol=accuracy * np.abs(F / PRIOR).max())
    sizes = np.outer(PRIOR, PRIOR)
    np.testing.assert_allclose(other_cov / sizes, cov / sizes, rtol=0, atol=accuracy * np.abs(cov / sizes).max())


def test_the_printed_formula_depends_on_units(truth, model, log) -> None:
    """J C_tau J^T and C_F^-1 do not have one unit: why "lund" is to compare only."""
    F, other = (estimate("lund", model, truth, log, force, 1.0)[0] for force in (1.0, 1e-3))
    assert np.abs(other - F).max() > 0.1 * np.abs(F).max()


def sensitivity(way: str, model: TorqueModel, truth: Any, log: Table, joint: int, factor: float) -> float:
    """How much a torque more at one joint changes the last wrench, in units of the prior; its sd is `factor` times."""
    scale = np.where(np.arange(7) == joint, factor, 1.0) ** 2
    c = model.covariance
    noisy = replace(model, covariance=velocity_covariance(c.kind, c.C0 * scale, c.Cinf * scale, c.shape, c.alpha2))
    more = log.with_column("tau", log["tau"] + 0.02 * (np.arange(7) == joint))
    change = estimate(way, noisy, truth, more)[0][-1] - estimate(way, noisy, truth, log)[0][-1]
    return float(np.linalg.norm(change / PRIOR))


@pytest.mark.parametrize("way", CHECKED)
def test_a_joint_that_is_said_to_be_noisier_is_trusted_less(truth, model, log, way: str) -> None:
    tell = Estimator(model, truth.robot, "bounded").run(log)["wrench_active"][-1]
    assert tell.sum() >= 2
    for joint in np.flatnonzero(tell)[:2]:
        assert sensitivity(way, model, truth, log, joint, 2.0) < sensitivity(way, model, truth, log, joint, 1.0)
