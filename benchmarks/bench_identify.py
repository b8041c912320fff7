"""Base parameters and friction of a 7-joint arm from a million samples, beside a loop over Pinocchio's regressor.

FIGAROH would do the same job with Pinocchio's regressor in a Python loop; it cannot be installed from the pinned
peers, so its inner loop stands for it.
"""

from __future__ import annotations

import resource

import numpy as np
import pinocchio as pin
from blocks import Contender, Table, agree, once, table
from peers import Pinocchio

from armlab import identify, robots
from armlab.estimation import least_squares
from armlab.identify.base_parameters import base_parameters
from armlab.identify.design import Design
from armlab.identify.preparation import Prepared
from armlab.robots import Robot

RATE = 250.0  # Hz
BAR = 5.0  # s for a million samples: regressor, filter and weighted least squares
FEW = 20_000  # samples of the loop, scaled up


def run(quick: bool) -> list[Table]:
    """Measure the whole way from positions to parameters with covariance, in blocks."""
    robot = robots.load("yumi_left")
    samples = 100_000 if quick else 1_000_000
    data, few = _record(robot, samples), _record(robot, FEW)
    peer, base = Pinocchio(robot, np.ones((robot.n, 10))), base_parameters(robot)
    q, qd, qdd = few.q[0], few.qd[0], few.differentiate(few.qd)[0]
    ours = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity)
    worst = agree("regressor", ours, pin.computeJointTorqueRegressor(peer.model, peer.data, q, qd, qdd), 1e-9)
    scale = 1e6 / samples
    contenders = [
        Contender("armlab: regressor, filter, WLS", once(lambda: _fit(data, robot, base), scale), "armlab", BAR),
        Contender("Pinocchio regressor in a loop, stored", once(lambda: _loop(peer, few), 1e6 / FEW),
                  note="the regressor alone, neither filter nor solution"),
    ]  # fmt: skip
    found = table("Identification", "", "s", contenders, 1 if quick else 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    text = (
        f"1e6 samples of 7 joints at {RATE:g} Hz to {len(base.names)} base parameters and 5 or more of friction per "
        f"joint. Regressors agree to {worst:.1g}. Peak memory of the process with {samples:.0e} samples: {peak:.2f} GB "
        "(bar for 1e6: 2)."
    )
    return [Table(found.title, text, found.unit, found.figures, found.rounds)]


def _record(robot: Robot, samples: int) -> Prepared:
    """Return an excitation, repeated, with torques of noise: the cost does not depend on them."""
    t = np.arange(samples) / RATE
    motion = identify.excitation(robot, seconds=60, seed=0)
    q, qd, _ = motion.sample(t % 60.0)
    tau = np.random.default_rng(0).standard_normal(q.shape)
    dt = np.full(samples, 1.0 / RATE)
    return Prepared(t, dt, q, qd, tau, ((0, samples),), RATE, np.zeros(robot.n), ())


def _fit(data: Prepared, robot: Robot, base: identify.BaseParameters) -> np.ndarray:
    design = Design.build(data, robot, base)
    block = data.blocks(20.0)[design.rows]
    return least_squares(design.stream(block), design.layout.names, method="wls").x


def _loop(peer: Pinocchio, data: Prepared) -> np.ndarray:
    qdd = data.differentiate(data.qd)
    Y = np.empty((len(data.t), *np.shape(peer.data.jointTorqueRegressor)))
    for k in range(len(Y)):
        Y[k] = pin.computeJointTorqueRegressor(peer.model, peer.data, data.q[k], data.qd[k], qdd[k])
    return Y
