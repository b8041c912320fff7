"""A million poses in one call, with and without Jacobians, and what the machine allows."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from blocks import Contender, Table, agree, loop, once, table
from machine import arithmetic, writer
from peers import BlockedNumpy, Pinocchio, elementary_transforms

from armlab import kinematics, robots
from armlab.kernels import _reference
from armlab.robots import Robot

ROBOT = "yumi_right"
IN_CACHE = 500  # poses whose results, Jacobians too, stay in the second-level cache
REFERENCE_BLOCK = 1000  # where the reference kernel is fastest


def run(quick: bool) -> list[Table]:
    """Measure batches of `kinematics.forward` and `Chain.forward_jacobian`."""
    robot = robots.load(ROBOT)
    count = 100_000 if quick else 1_000_000
    q = np.random.default_rng(2).uniform(robot.q_min, robot.q_max, (count, robot.n))
    return [_poses(robot, q, 5 if quick else 25), _poses_and_jacobians(robot, q, 5 if quick else 25)]


def _poses(robot: Robot, q: np.ndarray, rounds: int) -> Table:
    pinocchio, ets, numpy = Pinocchio(robot), elementary_transforms(robot), BlockedNumpy(robot)
    reference = _reference.Chain(robot.frames, robot.prismatic)
    few = q[:3000]
    T = kinematics.forward(robot, few)
    ways = (numpy.forward(few), reference.forward(few), pinocchio.forward_batch(few), ets.eval(few))
    worst = max(agree("poses", way, T) for way in ways)
    out = np.ones((len(q), 4, 4))
    in_cache = np.empty((IN_CACHE, 4, 4))
    contenders = [
        Contender("armlab kinematics.forward(robot, q)", once(partial(kinematics.forward, robot, q)), "armlab"),
        Contender("armlab with out=", once(partial(kinematics.forward, robot, q, out)), "armlab"),
        Contender("NumPy, blocked", once(partial(numpy.forward, q)), bar=1 / 15, note="written for speed"),
        _tenth("armlab's reference kernel, blocked", partial(_by_blocks, reference.forward), q),
        Contender("robotics-toolbox", once(partial(ets.eval, q)), note="compiled ETS: eval of all rows"),
        _tenth("Pinocchio", pinocchio.forward_batch, q, note="a Python loop: it has no batch; "),
        *_limits(q, out.nbytes, _operations(robot.n, False), robot.chain.forward, in_cache),
    ]
    text = f"{len(q):,} poses of {robot.name} in one call. All agree to {worst:.1g}."
    return table(f"{len(q):,} poses", text, "ms", contenders, rounds)


def _poses_and_jacobians(robot: Robot, q: np.ndarray, rounds: int) -> Table:
    pinocchio, numpy = Pinocchio(robot), BlockedNumpy(robot)
    reference = _reference.Chain(robot.frames, robot.prismatic)
    few = q[:3000]
    T, J = robot.chain.forward_jacobian(few)
    ways = (numpy.forward_jacobian(few), reference.forward_jacobian(few), pinocchio.forward_jacobian_batch(few))
    worst = max(max(agree("poses", way[0], T), agree("Jacobians", way[1], J)) for way in ways)
    out = np.ones((len(q), 4, 4)), np.ones((len(q), 6, robot.n))
    in_cache = np.empty((IN_CACHE, 4, 4)), np.empty((IN_CACHE, 6, robot.n))
    size, operations = out[0].nbytes + out[1].nbytes, _operations(robot.n, True)
    both = robot.chain.forward_jacobian
    contenders = [
        Contender("armlab robot.chain.forward_jacobian(q)", once(partial(both, q)), "armlab"),
        Contender("armlab with out=", once(partial(both, q, out)), "armlab"),
        Contender("NumPy, blocked", once(partial(numpy.forward_jacobian, q)), bar=1 / 12, note="written for speed"),
        _tenth("armlab's reference kernel, blocked", partial(_by_blocks, reference.forward_jacobian), q),
        _tenth("Pinocchio", pinocchio.forward_jacobian_batch, q, note="a Python loop; "),
        *_limits(q, size, operations, both, in_cache),
    ]
    text = f"{len(q):,} poses and Jacobians of {robot.name} in one call. All agree to {worst:.1g}."
    return table(f"{len(q):,} poses with Jacobians", text, "ms", contenders, rounds)


def _tenth(name: str, function: Callable[[np.ndarray], Any], q: np.ndarray, note: str = "") -> Contender:
    """Return a contender that goes row by row or block by block: a tenth of the poses tells the time of all."""
    return Contender(name, once(partial(function, q[: len(q) // 10]), scale=10.0), note=f"{note}a tenth, times ten")


def _by_blocks(kernel: Callable[..., Any], q: np.ndarray) -> list[Any]:
    return [kernel(q[start : start + REFERENCE_BLOCK]) for start in range(0, len(q), REFERENCE_BLOCK)]


def _limits(q: np.ndarray, size: int, operations: int, kernel: Callable[..., Any], out: Any) -> list[Contender]:
    """Return the limits: writing the bytes of the result, the kernel without memory, the arithmetic alone."""
    calls = len(q) // IN_CACHE
    block = loop(lambda rows: kernel(rows, out), list(q[: calls * IN_CACHE].reshape(calls, IN_CACHE, -1)))
    operation = arithmetic()
    return [
        Contender("write: new memory", once(writer(size, fresh=True)), "limit", note=f"{size / 1e6:.0f} MB"),
        Contender("write: memory in use", once(writer(size, fresh=False)), "limit", note=f"{size / 1e6:.0f} MB"),
        Contender("compute: the kernel in cache", lambda: block() * calls, "limit", note=f"{IN_CACHE} poses at a time"),
        Contender(
            "compute: the arithmetic alone",
            lambda: np.array([operations * len(q) * operation()]),
            "limit",
            note=f"{operations} operations per pose at the rate of a product of matrices",
        ),
    ]


def _operations(n: int, with_jacobian: bool) -> int:
    """Count additions and multiplications of one pose of an arm with general constant poses.

    Per joint: sine and cosine 40 (a reduction and two polynomials), turning two columns 18, the next constant pose 63;
    the Jacobian takes a difference and a cross product, 12.
    """
    return n * (40 + 18 + 63 + (12 if with_jacobian else 0))
