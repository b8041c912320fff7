"""Rigid-body dynamics: single calls compared with Pinocchio, and a million torques compared with NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from blocks import Contender, Table, agree, loop, once, table
from peers import Pinocchio
from plain import oracles

from armlab import dynamics, robots
from armlab.robots import inertia

ROBOT = "yumi_right"
CONFIGURATIONS = 1000
BLOCK = 1000  # block size at which NumPy is fastest for the batch


def run(quick: bool) -> list[Table]:
    """Measure the functions of `armlab.dynamics`."""
    rng, arm = np.random.default_rng(3), robots.load(ROBOT)
    bodies = inertia.from_body(rng.uniform(1, 5, arm.n), rng.normal(scale=0.1, size=(arm.n, 3)), 0.02 * np.eye(3))
    robot = replace(arm, inertias=bodies)
    single = robots.from_poe("single", [[0, 0, 0, 0, 0, 1]], np.eye(4), inertias=bodies[:1])
    peer = Pinocchio(robot, bodies)
    model, data = peer.model, peer.data
    q = rng.uniform(robot.q_min, robot.q_max, (CONFIGURATIONS, robot.n))
    motions = list(zip(q, *rng.normal(scale=[[[2.0]], [[5.0]]], size=(2, *q.shape))))
    calls: dict[str, tuple[str, Callable[..., Any], Callable[..., Any], int]] = {
        "Inverse dynamics": ("rnea", dynamics.inverse_dynamics, pin.rnea, 3),
        "Gravity": ("computeGeneralizedGravity", dynamics.gravity, pin.computeGeneralizedGravity, 1),
        "Mass matrix": ("crba", dynamics.mass_matrix, pin.crba, 1),
        "Coriolis matrix": ("computeCoriolisMatrix", dynamics.coriolis_matrix, pin.computeCoriolisMatrix, 2),
        "Forward dynamics": ("aba", dynamics.forward_dynamics, pin.aba, 3),
        "Derivatives of inverse dynamics": (
            "computeRNEADerivatives", dynamics.inverse_dynamics_derivatives, pin.computeRNEADerivatives, 3,
        ),
        "Derivatives of forward dynamics": (
            "computeABADerivatives", dynamics.forward_dynamics_derivatives, pin.computeABADerivatives, 3,
        ),
    }  # fmt: skip
    tables = []
    for title, (name, ours, theirs, count) in calls.items():
        rows = [motion[:count] for motion in motions]
        for row in rows[:50]:
            found, expected = ours(robot, *row), theirs(model, data, *row)
            parts = zip(found[:2], expected[:2]) if isinstance(found, tuple) else [(found, expected)]
            for one, other in parts:  # Pinocchio fills only the upper triangle of M
                agree(title, *(np.triu(part) if name == "crba" else part for part in (one, other)))
        contenders = [
            Contender(
                f"armlab dynamics.{ours.__name__}", loop(lambda row, call=ours: call(robot, *row), rows), "armlab"
            ),
            Contender("Pinocchio", loop(lambda row, call=theirs: call(model, data, *row), rows), bar=0.6, note=name),
            Contender(
                "armlab, a robot with one joint",
                loop(lambda row, call=ours: call(single, *row), [[part[:1] for part in row] for row in rows]),
                "armlab",
                note="mostly the overhead of a call",
            ),
        ]
        text = f"{ROBOT} with synthetic masses, {robot.n} joints, varying motions."
        tables.append(table(f"{title}, one call", text, "µs", contenders, 30 if quick else 200))
    return [*tables, _batch(robot, 100_000 if quick else 1_000_000)]


def _batch(robot: robots.Robot, count: int) -> Table:
    """Return the table for many inverse dynamics evaluations in one call."""
    motion = np.random.default_rng(4).normal(size=(3, count, robot.n))
    chain = oracles.Chain(robot.frames, robot.prismatic)

    def plain(rows: np.ndarray) -> list[np.ndarray]:
        starts = range(0, rows.shape[1], BLOCK)
        return [chain.rnea(*rows[:, k : k + BLOCK], robot.gravity, robot.inertias) for k in starts]

    few = motion[:, :BLOCK]
    agree("inverse dynamics", plain(few)[0], dynamics.inverse_dynamics(robot, *few))
    tenth = motion[:, : count // 10]
    contenders = [
        Contender("armlab inverse_dynamics", once(partial(dynamics.inverse_dynamics, robot, *motion)), "armlab"),
        Contender("NumPy", once(partial(plain, tenth), scale=10.0), bar=1 / 15, note="in blocks; 10 x a tenth"),
    ]
    return table(f"{count:,} inverse dynamics", "One call with new arrays.", "ms", contenders, 5)
