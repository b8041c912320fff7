"""One step of the contact-force estimator, back to back and paced like a control loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
from blocks import Contender, Table, agree, alternate, each, figures
from identified import PERIOD, WRENCH, log, model, with_masses
from pinocchio_estimator import PinocchioEstimator
from pinocchio_momentum import PinocchioMomentum
from plain import oracles

from armlab import robots
from armlab.contact import Estimator
from armlab.models import TorqueModel
from armlab.robots import Robot
from armlab.state import State

ROBOT = "yumi_right"
BAR = 0.15  # relative to Pinocchio with NumPy
OF_MAP = {"bounded": 3.0, "observer": 1.5, "kf": 2.5}  # relative to the method "map"


def run(quick: bool) -> list[Table]:
    """Compare `contact.Estimator.step` with NumPy and with the same computation built from Pinocchio functions."""
    robot = robots.load(ROBOT)
    whole = model(robot, seconds=15)
    torque_model = replace(whole, parameters=None)  # the peers lack the parameter covariance
    states = list(log(robot, 15, seed=4, wrench=WRENCH).states())
    ours = Estimator(torque_model, robot)
    pinocchio = PinocchioEstimator(torque_model, robot, with_masses(robot, torque_model.link_parameters), ours.prior)
    reference = _in_numpy(torque_model, robot)
    worst = _check(ours, pinocchio, reference, states[:1000])

    def contenders(count: int, period: float) -> list[Contender]:
        def block(estimator: Any) -> Callable[[], np.ndarray]:
            return each(estimator.step, states[:count], estimator.reset, period)

        def nothing(_: State) -> None:
            return None

        return [
            Contender("armlab contact.Estimator.step(state)", block(ours), "armlab"),
            Contender(
                "armlab, wider outside the identified motion",
                block(Estimator(whole, robot)),
                "armlab",
                note="with the identified parameter covariance",
            ),
            Contender(
                "Pinocchio with NumPy",
                block(pinocchio),
                "peer",
                None if period else BAR,
                "rnea, computeFrameJacobian, LAPACK dposv",
            ),
            Contender("armlab's reference kernel", block(reference), note="plain NumPy"),
            Contender("a Python function that does nothing", each(nothing, states[:count], None, period), "limit"),
        ]

    what = f"Wrench, covariance and observability of {ROBOT} from one state; forces agree to {worst:.1g} N."
    tight = f"{what} Consecutive steps, each timed separately."
    paced = (
        f"{what} One step every {1e3 * PERIOD:g} ms with sleep in between, as in a control loop, so the caches are "
        "cold, especially on a shared machine."
    )
    return [
        *_tables("Estimator step", tight, contenders(1000, 0.0), 5 if quick else 15),
        *_tables("Estimator step, paced", paced, contenders(250, PERIOD), 2 if quick else 5),
        *_momentum(torque_model, robot, states, 5 if quick else 15),
        _methods(torque_model, robot, states, 5 if quick else 15),
    ]


def _momentum(torque_model: TorqueModel, robot: Robot, states: Sequence[State], rounds: int) -> list[Table]:
    """Compare the momentum methods with the same computation built from Pinocchio functions."""
    links, tables = with_masses(robot, torque_model.link_parameters), []
    for method, name in (("kf", "Kalman filter"), ("observer", "Momentum observer")):
        ours = Estimator(torque_model, robot, method)
        peer = PinocchioMomentum(torque_model, robot, links, ours.prior, method == "kf")
        worst = 0.0
        for state in states[:1000]:
            wrench, (F, cov) = ours.step(state), peer.step(state)
            worst = max(worst, agree(f"wrench of {name}", F, wrench.wrench, 1e-6))
            agree(f"covariance of {name}", cov, wrench.cov, 1e-6)
        note = "crba, computeCoriolisMatrix, computeGeneralizedGravity, computeFrameJacobian, LAPACK dposv"
        contenders = [
            Contender(f'method="{method}", step(state)', each(ours.step, states[:1000], ours.reset), "armlab"),
            Contender("Pinocchio with NumPy", each(peer.step, states[:1000], peer.reset), bar=BAR, note=note),
        ]
        text = f"Wrench and covariance of {ROBOT} from one state, back to back; forces agree to {worst:.1g} N."
        tables += _tables(f"{name} step", text, contenders, rounds)
    return tables


def _methods(torque_model: TorqueModel, robot: Robot, states: Sequence[State], rounds: int) -> Table:
    """Measure all methods of the estimator side by side."""
    ways = {"map": {}, "bounded": {}, "observer": {}, "kf": {}, "kf, bias=True": {"bias": True}, "interval": {}}
    contenders = []
    for name, options in ways.items():
        estimator = Estimator(torque_model, robot, name.split(",")[0], **options)
        step = each(estimator.step, states[:1000], estimator.reset)
        contenders.append(Contender(name, step, "armlab", OF_MAP.get(name), over="map" if name in OF_MAP else ""))
    text = (
        f"One estimator step for {ROBOT} with each method, back to back; median of a block. Ratios are relative to "
        "the first method."
    )
    return Table("Estimator methods, p50", text, "µs", figures(contenders, alternate(contenders, rounds)), rounds)


def _tables(title: str, text: str, contenders: Sequence[Contender], rounds: int) -> list[Table]:
    samples = alternate(contenders, rounds)
    p50 = figures(contenders, samples, np.median)
    unbound = [replace(contender, bar=None) for contender in contenders]  # the target applies to the median
    p99 = figures(unbound, samples, lambda block: float(np.percentile(block, 99)))
    return [
        Table(f"{title}, p50", f"{text} Median of a block.", "µs", p50, rounds),
        Table(f"{title}, p99", f"{text} 99th percentile of a block.", "µs", p99, rounds),
    ]


def _in_numpy(torque_model: TorqueModel, robot: Robot) -> Estimator:
    """Return the estimator with the reference kernels, which otherwise run only without the extension."""
    torque = "armlab.models.torque"
    with (
        patch(f"{torque}.Chain", oracles.Chain),
        patch(f"{torque}.Drive", oracles.Drive),
        patch(f"{torque}.WrenchEstimator", oracles.WrenchEstimator),
    ):
        return Estimator(replace(torque_model), robot)


def _check(ours: Estimator, pinocchio: PinocchioEstimator, reference: Estimator, states: Sequence[State]) -> float:
    worst = 0.0
    for state in states:
        wrench, same = ours.step(state), reference.step(state)
        F, cov, observability, error, variance = pinocchio.step(state)
        worst = max(
            worst,
            agree("wrench", F, wrench.wrench, 1e-7),
            agree("wrench of the reference", same.wrench, wrench.wrench, 1e-7),
        )
        agree("covariance", cov, wrench.cov, 1e-6)
        agree("covariance of the reference", same.cov, wrench.cov, 1e-6)
        agree("observability", observability, wrench.observability, 1e-8)
        agree("torque error", error, wrench.torque_error, 1e-8)
        agree("torque variance", variance, wrench.torque_variance, 1e-8)
    return worst
