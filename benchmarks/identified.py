"""Torque model identified from a synthetic log, and a log to run it on, for an arm with known truth from `sim`."""

from __future__ import annotations

import numpy as np

from armlab import identify, sim
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.friction import Friction
from armlab.robots import Robot

PERIOD = 0.004
SUBSTEPS = 4  # friction steps per sample of the log
WRENCH = np.array([3.0, -2.0, 4.0, 0.1, 0.2, -0.1])


def log(robot: Robot, seconds: float, seed: int, wrench: np.ndarray | None = None) -> Table:
    """Return a 250 Hz log of an excitation with friction and noise, under a constant wrench on the tool."""
    truth = sim.synthetic_truth(robot)
    fine = np.arange(0, seconds, PERIOD / SUBSTEPS)
    q, qd, qdd = identify.design_excitation(robot, seconds=seconds, seed=seed).sample(fine)
    friction = Friction(
        viscous=truth.viscous,
        coulomb_pos=truth.coulomb_pos,
        coulomb_neg=truth.coulomb_neg,
        offset=truth.offset,
        stribeck=0.3 * truth.coulomb_pos,
        stribeck_speed=truth.stribeck_speed,
        delta=truth.delta,
        resolution=np.zeros(robot.n),
    )
    z = presliding(q, friction.delta, friction.resolution)
    t, q, qd, qdd, z = (x[::SUBSTEPS] for x in (fine, q, qd, qdd, z))
    tau = robot.chain.rnea(q, qd, qdd, robot.gravity, truth.pi) + truth.rotor * qdd + friction.torque(qd, z)
    if wrench is not None:
        tau = tau - wrench @ robot.chain.jacobian(q)
    rng = np.random.default_rng(seed)
    tau = tau + truth.tau_noise * rng.standard_normal(tau.shape)
    qd = qd + truth.qd_noise * rng.standard_normal(qd.shape)
    return Table(t, {"q": np.round(q / truth.q_step) * truth.q_step, "qd": qd, "tau": tau})


def model(robot: Robot, seconds: float) -> TorqueModel:
    """Return the model identified from such a log."""
    return identify.fit_dynamics(log(robot, seconds, seed=1), robot).value


def with_masses(robot: Robot, links: np.ndarray) -> np.ndarray:
    """Return (n, 10) parameters with the same torques as `links`, but with masses as realistic as possible.

    The identified vector has minimum norm and contains massless links, which peers cannot handle. Directions that no
    motion excites (the null space of the regressor) are free and are taken from the truth.
    """
    rng = np.random.default_rng(3)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 200, robot.n))
    regressor = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity).reshape(-1, 10 * robot.n)
    _, values, rows = np.linalg.svd(regressor, full_matrices=False)
    seen = rows[values > 1e-9 * values[0]]
    missing = sim.synthetic_truth(robot).pi.ravel() - links.ravel()
    return links + (missing - seen.T @ (seen @ missing)).reshape(links.shape)
