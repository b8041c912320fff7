"""Inverse kinematics of random reachable poses without an initial guess, and along a path from the previous posture."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from blocks import Contender, Table, once, table
from peers import closed_loop_inverse, elementary_transforms

from armlab import kinematics, robots
from armlab.lie import so3
from armlab.robots import Robot

ROBOTS = ("yumi_left", "irb2400", "irb7600", "ur5e")
TOLERANCE = 1e-9  # m and rad
STARTS = 100
PART_OF_CLIK = 20  # the Python loop solves only every twentieth pose


def run(quick: bool) -> list[Table]:
    """Compare `kinematics.inverse` with robotics-toolbox's ik_LM and a Python loop with Pinocchio."""
    poses, rounds = (1000, 2) if quick else (10_000, 3)
    return [*(_random_poses(robots.load(name), poses, rounds) for name in ROBOTS), _path(rounds)]


def _random_poses(robot: Robot, count: int, rounds: int) -> Table:
    q = np.random.default_rng(5).uniform(robot.q_min, robot.q_max, (count, robot.n))
    T = kinematics.forward(robot, q)
    some = T[:: PART_OF_CLIK * (1 if count > 1000 else 5)]
    ets, clik = elementary_transforms(robot), closed_loop_inverse(robot, TOLERANCE, STARTS)
    ours = partial(kinematics.inverse, robot)

    def loop(function: Callable[[np.ndarray], np.ndarray], goals: np.ndarray) -> np.ndarray:
        return np.array([function(goal) for goal in goals])

    def toolbox(goal: np.ndarray) -> np.ndarray:
        return ets.ik_LM(goal, slimit=STARTS, tol=5e-13, joint_limits=True)[0]

    def way(name: str, function: Callable[[], object], goals: int, role: str = "peer", **told: object) -> Contender:
        return Contender(name, once(function, 1.0 / goals), role, **told)  # type: ignore[arg-type]

    def one_by_one() -> np.ndarray:
        return loop(lambda goal: ours(goal).q, T)

    contenders = [
        way("armlab inverse(robot, T), one by one", one_by_one, count, "armlab"),
        way("armlab inverse(robot, T), all at once", lambda: ours(T), count, "armlab"),
        way(
            "robotics-toolbox",
            lambda: loop(toolbox, T),
            count,
            bar=0.25,
            note=f"compiled ik_LM (Chan), tol=5e-13 of the squared error, slimit={STARTS}, within the limits",
        ),
        way("Pinocchio", lambda: loop(clik, some), len(some), bar=0.1, note=f"Python loop, {len(some)} of the poses"),
    ]
    theirs = loop(toolbox, T)
    told = [
        f"armlab {_success(robot, ours(T).q, T, TOLERANCE)}",
        f"robotics-toolbox {_success(robot, theirs, T, TOLERANCE)}, and {_success(robot, theirs, T, 1e-5)} to 1e-5",
        f"Pinocchio {_success(robot, loop(clik, some), some, TOLERANCE)}",
    ]
    text = (
        f"{robot.name}, {robot.n} joints, {count} poses from uniformly distributed postures within the limits. Each "
        f"solver starts without an initial guess and may use {STARTS} starts. Solved to 1e-9 m and 1e-9 rad within the "
        f"limits: {'; '.join(told)}."
    )
    return table(f"Inverse kinematics, {robot.name}", text, "µs", contenders, rounds, warm=False)  # already warmed up


def _success(robot: Robot, q: np.ndarray, T: np.ndarray, tolerance: float) -> str:
    """Return the fraction of goals reached within the limits, checked by forward kinematics."""
    found = kinematics.forward(robot, q)
    position = np.linalg.norm(found[:, :3, 3] - T[:, :3, 3], axis=1)
    rotation = so3.angle(found[:, :3, :3], T[:, :3, :3])
    slack = 1e-14  # tolerance for the rounding of forward kinematics
    inside = np.all((robot.q_min <= q) & (q <= robot.q_max), axis=1)
    return f"{np.mean((position <= tolerance + slack) & (rotation <= tolerance + slack) & inside):.2%}"


def _path(rounds: int) -> Table:
    """Measure a path of the YuMi's tool sampled every 4 ms, with each pose solved from the previous posture."""
    robot = robots.load("yumi_left")
    s = np.linspace(0.0, 2.0 * np.pi, 1000)[:, None]
    amplitude = np.array([0.4, 0.3, 0.4, 0.3, 0.5, 0.3, 0.6])
    T = kinematics.forward(robot, robot.q_home + amplitude * (1.0 - np.cos(s * [1, 2, 1, 3, 2, 1, 2])) / 4)
    ets, q_home = elementary_transforms(robot), np.array(robot.q_home)

    def follow(step: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[], np.ndarray]:
        def block() -> np.ndarray:
            q, rows = q_home, []
            for goal in T:
                q = step(goal, q)
                rows.append(q)
            return np.array(rows)

        return block

    def toolbox(goal: np.ndarray, q: np.ndarray) -> np.ndarray:
        return ets.ik_LM(goal, q0=q, tol=5e-13, joint_limits=True)[0]

    ours = follow(lambda goal, q: kinematics.inverse(robot, goal, q).q)
    theirs = follow(toolbox)
    path, peer = partial(kinematics.inverse_path, robot, T, q_home), "robotics-toolbox"
    contenders = [
        Contender("armlab inverse_path(robot, T, q)", once(path, 1.0 / len(T)), "armlab", 0.2, over=peer),
        Contender("armlab inverse(robot, T, q)", once(ours, 1.0 / len(T)), "armlab", 0.75, "pose by pose", peer),
        Contender(peer, once(theirs, 1.0 / len(T)), note="compiled ik_LM (Chan), tol=5e-13, q0 from the last pose"),
    ]
    jump = np.abs(np.diff(path().q, axis=0)).max()
    text = (
        f"yumi_left, {len(T)} poses 4 ms apart, each solved from the previous posture. Solved to 1e-9 m and 1e-9 "
        f"rad: armlab {_success(robot, path().q, T, TOLERANCE)}, with no joint moving more than {jump:.2g} rad per "
        f"step; robotics-toolbox {_success(robot, theirs(), T, TOLERANCE)}."
    )
    return table("Inverse kinematics along a path", text, "µs", contenders, 3 * rounds)
