"""Base parameters and friction of a 7-joint arm from a million samples, compared with Pinocchio's regressor and
FIGAROH.

FIGAROH (1.0.2) builds its regressor with Pinocchio in a Python loop, finds the base parameters by a QR factorisation of
the data, and solves ordinary least squares. It is not among the pinned peers, because it depends on a viewer and an SDP
modeller. If it is installed, it identifies from the same samples as armlab; otherwise the table says so.
"""

from __future__ import annotations

import resource

import numpy as np
import pinocchio as pin
from blocks import Contender, Table, agree, once, table
from peers import Pinocchio

from armlab import identify, robots
from armlab.dynamics import BaseParameters, base_parameters
from armlab.estimation import Rows, least_squares
from armlab.identify.record import Record
from armlab.identify.regression import Design
from armlab.robots import Robot

RATE = 250.0  # Hz
BAR = 1.0  # regressor, filter and weighted least squares, relative to the peer's regressor alone
FEW = 20_000  # samples in the peer's loop, extrapolated
SAME = 5_000  # samples of the comparison with FIGAROH and its dense regressor
BLOCK = 1000  # samples per block of armlab's regressor


def run(quick: bool) -> list[Table]:
    """Measure the complete identification, from positions to parameters with covariance, in blocks."""
    robot = robots.load("yumi_left")
    samples = 100_000 if quick else 1_000_000
    data, few = _record(robot, samples), _record(robot, FEW)
    peer, base = Pinocchio(robot, np.ones((robot.n, 10))), base_parameters(robot)
    q, qd, qdd = few.q[0], few.qd[0], few.differentiate(few.qd)[0]
    ours = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity)
    worst = agree("regressor", ours, pin.computeJointTorqueRegressor(peer.model, peer.data, q, qd, qdd), 1e-9)
    scale = 1e6 / samples
    contenders = [
        Contender("armlab: regressor, filter, WLS", once(lambda: _fit(data, robot, base), scale), "armlab"),
        Contender("Pinocchio regressor in a loop, stored", once(lambda: _loop(peer, few), 1e6 / FEW), bar=BAR,
                  note="only the regressor, without filter or solution"),
    ]  # fmt: skip
    found = table("Identification", "", "s", contenders, 1 if quick else 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    text = (
        f"1e6 samples of 7 joints at {RATE:g} Hz to {len(base.names)} base parameters and at least 5 friction "
        f"parameters per joint. Regressors agree to {worst:.1g}. Peak memory of the process with {samples:.0e} "
        f"samples: {peak:.2f} GB (target for 1e6: 2)."
    )
    return [
        Table(found.title, text, found.unit, found.figures, found.rounds),
        _beside_figaroh(robot, 1 if quick else 5),
    ]


def _beside_figaroh(robot: Robot, rounds: int) -> Table:
    """Compare OLS identifications of base parameters, viscous and Coulomb friction, rotors and offsets."""
    data, base = _record(robot, SAME), base_parameters(robot)
    qdd = data.differentiate(data.qd)
    contenders = [
        Contender("armlab: regressor, OLS", once(lambda: _plain(data, qdd, robot, base), 1e6 / SAME), "armlab")
    ]
    text = (
        f"Scaled up from {SAME} samples to 1e6. Parameters: viscous and Coulomb friction, rotor and offset of each "
        "joint."
    )
    try:
        from figaroh.tools.qrdecomposition import QRDecomposer
        from figaroh.tools.regressor import RegressorBuilder, RegressorConfig
    except ImportError as error:
        found = table("Identification beside FIGAROH", "", "s", contenders, rounds)
        return Table(found.title, f"{text} FIGAROH omitted: {error}.", found.unit, found.figures, found.rounds)
    peer = Pinocchio(robot, np.ones((robot.n, 10)))
    config = RegressorConfig(has_friction=True, has_actuator_inertia=True, has_joint_offset=True)
    active = {"act_idxv": list(range(robot.n))}

    def theirs() -> np.ndarray:
        W = RegressorBuilder(peer, config).build_basic_regressor(data.q, data.qd, qdd, active)
        kept = np.flatnonzero(np.einsum("ij,ij->j", W, W) > 1e-6)
        decomposer = QRDecomposer(relative_tolerance=1e-8)
        W_base, _, _, phi = decomposer.double_decomposition(data.tau.T.ravel(), W[:, kept], [f"p{k}" for k in kept])
        return (W_base @ phi).reshape(robot.n, -1).T

    ours = _columns(data, qdd, robot, base, slice(None)) @ _plain(data, qdd, robot, base)
    worst = agree("fitted torque", ours, theirs(), 1e-6)
    contenders.append(Contender("FIGAROH: regressor, QR, OLS", once(theirs, 1e6 / SAME), bar=1.0))
    found = table("Identification beside FIGAROH", "", "s", contenders, rounds)
    text += f" Torques of the two fits agree to {worst:.1g} N m. FIGAROH stores the dense regressor."
    return Table(found.title, text, found.unit, found.figures, found.rounds)


def _plain(data: Record, qdd: np.ndarray, robot: Robot, base: BaseParameters) -> np.ndarray:
    """Return the ordinary least-squares parameters without a filter."""
    block = np.arange(len(data.t)) // BLOCK
    parts = [slice(a, a + BLOCK) for a in range(0, len(data.t), BLOCK)]
    made = ((_columns(data, qdd, robot, base, part), part) for part in parts)
    rows = (row for A, part in made for row in Rows.of(A, data.tau[part], block[part]))
    names = [f"p{k}" for k in range(len(base.kept) + 3 * robot.n)]
    return least_squares(rows, names, method="ols").x


def _columns(data: Record, qdd: np.ndarray, robot: Robot, base: BaseParameters, rows: slice) -> np.ndarray:
    """Return the columns (N, n, p): base parameters, then viscous and Coulomb friction and offset of each joint."""
    q, qd, joints = data.q[rows], data.qd[rows], range(robot.n)
    own = np.zeros((4, len(q), robot.n, robot.n))
    for diagonal, values in zip(own, (qdd[rows], qd, np.sign(qd), np.ones_like(qd))):
        diagonal[:, joints, joints] = values
    rigid = robot.chain.rigid_regressor(q, qd, qdd[rows], robot.gravity)
    return np.concatenate([np.concatenate([rigid, own[0]], axis=2)[:, :, base.kept], *own[1:]], axis=2)


def _record(robot: Robot, samples: int) -> Record:
    """Return a repeated excitation with noise as torques, because torques do not affect the cost."""
    t = np.arange(samples) / RATE
    motion = identify.design_excitation(robot, seconds=60, seed=0)
    q, qd, _ = motion.sample(t % 60.0)
    tau = np.random.default_rng(0).standard_normal(q.shape)
    dt = np.full(samples, 1.0 / RATE)
    return Record(t, dt, q, qd, tau, ((0, samples),), RATE, np.zeros(robot.n), ())


def _fit(data: Record, robot: Robot, base: BaseParameters) -> np.ndarray:
    design = Design.build(data, robot, base)
    block = data.blocks(20.0)[design.rows]
    return least_squares(design.stream(block), design.layout.names, method="wls").x


def _loop(peer: Pinocchio, data: Record) -> np.ndarray:
    qdd = data.differentiate(data.qd)
    Y = np.empty((len(data.t), *np.shape(peer.data.jointTorqueRegressor)))
    for k in range(len(Y)):
        Y[k] = pin.computeJointTorqueRegressor(peer.model, peer.data, data.q[k], data.qd[k], qdd[k])
    return Y
