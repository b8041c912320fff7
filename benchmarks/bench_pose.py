"""One pose, and one pose with its Jacobian, as computed by a controller in every cycle."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from blocks import Contender, Table, agree, loop, table
from peers import Pinocchio, elementary_transforms

from armlab import kinematics, robots

ROBOT = "yumi_right"
CONFIGURATIONS = 2000


def run(quick: bool) -> list[Table]:
    """Compare `kinematics.forward` and `kinematics.forward_jacobian` with Pinocchio and robotics-toolbox."""
    robot = robots.load(ROBOT)
    rng = np.random.default_rng(1)
    configurations = list(rng.uniform(robot.q_min, robot.q_max, (CONFIGURATIONS, robot.n)))
    pinocchio, ets = Pinocchio(robot), elementary_transforms(robot)
    forward, both = partial(kinematics.forward, robot), partial(kinematics.forward_jacobian, robot)

    def toolbox(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return ets.eval(q), ets.jacob0(q)

    def empty(_: np.ndarray) -> np.ndarray:
        return np.empty((4, 4))

    worst = 0.0
    for q in configurations[:200]:
        T, J = both(q)
        for pose in (forward(q), pinocchio.forward(q), ets.eval(q)):
            worst = max(worst, agree("pose", pose, T))
        for pose, columns in (pinocchio.forward_jacobian(q), toolbox(q)):
            worst = max(worst, agree("pose", pose, T), agree("Jacobian", columns, J))

    def way(name: str, function: Callable[[np.ndarray], Any], role: str = "peer", **told: Any) -> Contender:
        return Contender(name, loop(function, configurations), role, **told)

    floor = way("a Python function that returns an empty 4×4 array", empty, "limit")
    poses = [
        way("armlab kinematics.forward(robot, q)", forward, "armlab"),
        way("armlab robot.chain.forward(q)", robot.chain.forward, "armlab"),
        way("Pinocchio", pinocchio.forward, bar=0.6, note="forwardKinematics, updateFramePlacement, homogeneous"),
        way("robotics-toolbox", ets.eval, bar=1 / 15, note="compiled ETS: eval"),
        floor,
    ]
    with_jacobians = [
        way("armlab kinematics.forward_jacobian(robot, q)", both, "armlab"),
        way("armlab robot.chain.forward_jacobian(q)", robot.chain.forward_jacobian, "armlab"),
        way(
            "Pinocchio",
            pinocchio.forward_jacobian,
            bar=0.35,
            note="computeFrameJacobian, updateFramePlacement, homogeneous",
        ),
        way("robotics-toolbox", toolbox, bar=1 / 15, note="compiled ETS: eval and jacob0"),
        floor,
    ]
    same = f"{ROBOT}, {robot.n} joints, varying configurations. All agree to {worst:.1g}."
    what = "The tool pose and the 6×n Jacobian in base axes at the tool point"
    rounds = 30 if quick else 200
    return [
        table("One pose", f"The tool pose as a 4×4 array. {same}", "µs", poses, rounds),
        table("One pose with its Jacobian", f"{what}. {same}", "µs", with_jacobians, rounds),
    ]
