"""Rigid-body base parameters, friction and ripple of all joints from a log, by weighted least squares with covariance.

    tau_i = Y_i(q, qd, qdd) base + F_f,i(qd_i, z_i) + ripple_i(q_i) + e_i

1. The same zero-phase filter runs over torque and every regressor column; then every few samples are kept.
2. Per joint, presliding distance and Stribeck speed are chosen on held-out blocks, with the rigid part held.
3. All linear parameters by least squares, joints weighted by 1 / their residual deviation, three rounds.
4. Covariance by drawing blocks again: residuals are coloured, and the formal covariance is far too small.
5. Models fitted without a fifth of the blocks give held-out residuals through the estimator's own causal filter; to
   them the torque covariance over velocity is fitted and its scale calibrated to 95.4 % inside 2 sigma.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from armlab.errors import NotExcited
from armlab.estimation import (
    BlockSums,
    Fit,
    Question,
    Rows,
    block_bootstrap,
    block_seconds,
    factorise,
    solve,
)
from armlab.identify.base_parameters import BaseParameters, base_parameters
from armlab.identify.design import Design
from armlab.identify.extrapolation import training
from armlab.identify.preparation import Prepared, prepare
from armlab.identify.validation import assess, report
from armlab.log import Table
from armlab.models import Friction, FrictionBound, Quality, Ripple, TorqueModel, velocity_covariance
from armlab.robots import Robot

__all__ = ["fit_dynamics"]

ROUNDS = 3
CUTOFF = 10.0  # Hz, corner of the estimator's causal filter

Progress = Callable[[int, int, str], None]


def fit_dynamics(
    table: Table | Sequence[Table], robot: Robot, seed: int = 0, progress: Progress | None = None
) -> Fit[TorqueModel]:
    """Identify the torque model of an arm from one or several logs of free motion.

    Parameters
    ----------
    table : logs with columns q, qd, tau (N, n) over the robot's clock, without contact.
    robot : the arm that was logged.
    seed : of the block bootstrap.
    progress : called with (done, total, what).

    Returns
    -------
    Fit of `models.TorqueModel`; its parameters are the base parameters, then viscous, coulomb_pos, coulomb_neg, offset
    and stribeck of each joint, with two ripple amplitudes where the robot's gears are known.

    Raises
    ------
    ShapeError : NaN rows, wrong joint count, velocity that is not the derivative of position.
    NotExcited : joints or directions that the log does not determine, by name.

    References
    ----------
    Gautier (1991) for base parameters, Dahl (1968) for presliding, Kunsch (1989) for the block bootstrap.
    """
    tell = progress or (lambda done, total, what: None)
    tell(0, 5, "checking the log")
    data = prepare(table, robot)
    base = base_parameters(robot)
    tell(1, 5, "building the regressor")
    design = Design.build(data, robot, base)
    design, theta, weights = _alternate(design, tell)
    tell(3, 5, "covariance from blocks")
    block = _blocks(design, theta, data)
    factors = factorise(Rows.of(design.matrix(), design.tau, block[design.rows]), len(design.names))
    solution = solve(Question.of(_leaders(design), "torque model"), factors, weights)
    theta, sums = solution.x, BlockSums.of(solution)
    cov = block_bootstrap(sums, seed=seed).cov
    tell(4, 5, "held-out residuals")
    model = _model(design, theta, cov, data, robot, base)
    model = assess(model, _fold_models(model, design, sums, block, data, robot, base), data)
    tell(5, 5, "done")
    return Fit(
        value=model,
        names=design.names,
        units=design.units,
        parameters=theta,
        cov=cov,
        sigma=1.0 / weights,
        residuals=design.residuals(theta),
        n=len(data.t),
        excitation=solution.excitation,
        summary=report,
    )


def _alternate(design: Design, tell: Progress) -> tuple[Design, np.ndarray, np.ndarray]:
    """Alternate between the linear parameters and the shape of friction until the shape stays."""
    weights = 1.0 / np.std(design.tau, axis=0)
    theta = design.solve(weights)
    for _ in range(ROUNDS):
        tell(2, 5, "choosing the shape of friction")
        shaped = design.choose_shapes(theta)
        before, after = np.stack([design.delta, design.speed]), np.stack([shaped.delta, shaped.speed])
        settled = np.allclose(before, after, rtol=0.1)
        design = shaped
        for _ in range(ROUNDS):
            theta = design.solve(weights)
            weights = 1.0 / np.sqrt(np.mean(design.residuals(theta) ** 2, axis=0))
        if settled:
            break
    return design, theta, weights


def _blocks(design: Design, theta: np.ndarray, data: Prepared) -> np.ndarray:
    """Return the block number (N,) of each sample: blocks longer than the residual remembers, without holes."""
    residuals = design.residuals(theta)
    step = float(np.median(np.diff(design.t)))
    length = min(block_seconds(residuals, step), data.seconds / 20.0)
    block = data.blocks(length)
    if block[-1] < 7:
        raise NotExcited(
            f"Expected at least 8 blocks of {length:.2g} s for a covariance, got {block[-1] + 1}. Record for longer.",
            ["covariance"],
            [f"{data.seconds:.1f} s"],
        )
    return block


def _leaders(design: Design) -> list[str]:
    """Return the leading symbol of each parameter: a whole combination fills a line."""
    return [re.split(r" [+-] ", name)[0] for name in design.names]


def _model(
    design: Design, theta: np.ndarray, cov: np.ndarray, data: Prepared, robot: Robot, base: BaseParameters
) -> TorqueModel:
    """Turn linear parameters and friction shapes into a model; covariance and quality are provisional."""
    n, p = robot.n, len(base.names)
    links, rotor = base.links_and_rotors(theta[:p])
    local = theta[p:].reshape(n, -1)
    viscous, positive, negative, offset, stribeck = local[:, :5].T
    cosine, sine = local[:, 5:].T if design.geared else np.zeros((2, n))
    friction = Friction(viscous, positive, negative, offset, stribeck, design.speed, design.delta, data.resolution)
    tiny = np.full(n, 1e-18)
    return TorqueModel(
        robot_name=robot.name,
        robot_hash=robot.hash,
        frames=robot.frames,
        prismatic=robot.prismatic,
        gravity=robot.gravity,
        link_parameters=links,
        rotor=rotor,
        friction=friction,
        ripple=Ripple(design.cycles, cosine, sine),
        covariance=velocity_covariance("const", tiny, tiny),
        bound=FrictionBound.of(friction),
        cutoff=CUTOFF,
        base_names=base.names,
        base_values=theta[:p],
        base_cov=cov[:p, :p],
        quality=_quality(data),
        training=training(data.t, data.q, data.qd, data.segments),
        sources=data.sources,
    )


def _quality(data: Prepared) -> Quality:
    unknown = np.full(data.q.shape[1], np.nan)
    return Quality(
        torque_sd=np.std(data.tau, axis=0),
        rms=unknown,
        rms_cv=unknown,
        coverage=unknown,
        seconds=data.seconds,
    )


def _fold_models(
    model: TorqueModel,
    design: Design,
    sums: BlockSums,
    block: np.ndarray,
    data: Prepared,
    robot: Robot,
    base: BaseParameters,
) -> list[tuple[TorqueModel, np.ndarray]]:
    """Return, for each fifth of the blocks, the model fitted without them and a mask (N,) of their samples."""
    folds = []
    for k in range(5):
        kept = np.arange(len(sums.rows)) % 5 != k
        theta = sums.solve(kept.astype(float))
        folds.append((_model(design, theta, model.base_cov, data, robot, base), ~kept[block]))
    return folds
