"""Large batches: a million poses per call, with and without Jacobians, into new and reused memory, and the machine's
limits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from blocks import Contender, Table, agree, loop, once, table
from machine import arithmetic, writer
from peers import FastNumpy, Pinocchio, PlainNumpy, elementary_transforms
from plain import oracles

from armlab import kinematics, robots
from armlab.robots import Robot

ROBOT = "yumi_right"
IN_CACHE = 500  # poses whose results, including Jacobians, fit into the second-level cache
REFERENCE_BLOCK = 1000  # block size at which the reference kernel is fastest

USED = """\
Results are written to reused memory. The target uses the faster of two NumPy implementations: a structure of arrays in
blocks that fit into the cache, rather than the more obvious stacks of 4×4 matrices.
"""
NEW = """\
Results are new arrays. The operating system clears every new page, which takes as long as the computation, in armlab
and in NumPy. To compute this many poses repeatedly, pass `out=`. The target refers to a straightforward NumPy
implementation.
"""
WALL = "wall-clock time; includes waiting for cores used by other processes"


@dataclass(frozen=True)
class Job:
    """Results computed from `q` by each contender; `out` is reused memory."""

    robot: Robot
    q: np.ndarray
    armlab: Callable[..., Any]
    kernel: Callable[..., Any]
    call: str
    plain: Callable[..., Any]
    fast: Callable[..., Any]
    reference: Callable[..., Any]
    out: Any
    peers: tuple[Contender, ...]
    bar: float
    operations: int

    @property
    def bytes(self) -> int:
        """Size of the results."""
        return sum(array.nbytes for array in (self.out if isinstance(self.out, tuple) else (self.out,)))


def run(quick: bool) -> list[Table]:
    """Measure batches of `kinematics.forward` and `kinematics.forward_jacobian`."""
    robot = robots.load(ROBOT)
    count, rounds = (100_000, 5) if quick else (1_000_000, 6)
    q = np.random.default_rng(2).uniform(robot.q_min, robot.q_max, (count, robot.n))
    poses, both = _poses(robot, q), _poses_and_jacobians(robot, q)
    few = replace(both, q=q[:10_000], out=(both.out[0][:10_000], both.out[1][:10_000]), peers=())
    return [
        *_tables(poses, f"{count:,} poses", rounds),
        *_tables(both, f"{count:,} poses with Jacobians", rounds),
        _few(few, rounds),
    ]


def _poses(robot: Robot, q: np.ndarray) -> Job:
    pinocchio, ets, plain, fast = Pinocchio(robot), elementary_transforms(robot), PlainNumpy(robot), FastNumpy(robot)
    reference = oracles.Chain(robot.frames, robot.prismatic).forward
    few = q[:3000]
    for way in (plain.forward, fast.forward, reference, pinocchio.forward_batch, ets.eval):
        agree("poses", way(few), kinematics.forward(robot, few))
    peers = (
        Contender("robotics-toolbox", once(partial(ets.eval, q)), note="compiled ETS: eval of all rows"),
        _tenth("Pinocchio", pinocchio.forward_batch, q, note="a Python loop, because there is no batch function; "),
    )
    out, call = np.ones((len(q), 4, 4)), "kinematics.forward(robot, q"
    ways = kinematics.forward, robot.chain.forward, call, plain.forward, fast.forward, reference
    return Job(robot, q, *ways, out, peers, 1 / 15, _operations(robot.n, False))


def _poses_and_jacobians(robot: Robot, q: np.ndarray) -> Job:
    pinocchio, plain, fast = Pinocchio(robot), PlainNumpy(robot), FastNumpy(robot)
    reference = oracles.Chain(robot.frames, robot.prismatic).forward_jacobian
    few = q[:3000]
    T, J = kinematics.forward_jacobian(robot, few)
    for way in (plain.forward_jacobian, fast.forward_jacobian, reference, pinocchio.forward_jacobian_batch):
        poses, jacobians = way(few)
        agree("poses", poses, T)
        agree("Jacobians", jacobians, J)
    peers = (_tenth("Pinocchio", pinocchio.forward_jacobian_batch, q, note="a Python loop; "),)
    out, call = (np.ones((len(q), 4, 4)), np.ones((len(q), 6, robot.n))), "kinematics.forward_jacobian(robot, q"
    kernel = partial(_into, robot.chain.forward_jacobian)
    ways = kinematics.forward_jacobian, kernel, call, plain.forward_jacobian, fast.forward_jacobian, reference
    return Job(robot, q, *ways, out, peers, 1 / 12, _operations(robot.n, True))


def _tables(job: Job, title: str, rounds: int) -> list[Table]:
    """Return the table for results in reused memory, to which the target applies, and the table for newly allocated
    results."""
    text = f"{job.robot.name}, {job.robot.n} joints, one call; all results agree to 1e-9. "
    return [
        table(title, text + _line(USED), "ms", _used(job), rounds),
        table(f"{title}, new arrays", text + _line(NEW), "ms", _new(job), rounds),
    ]


def _used(job: Job) -> list[Contender]:
    used = partial(job.armlab, job.robot, job.q, out=job.out)
    return [
        Contender(f"armlab {job.call}, out=out)", once(used), "armlab"),
        Contender("armlab with two threads", once(partial(used, threads=2), clock=perf_counter), "armlab", note=WALL),
        Contender("NumPy, side by side", once(partial(job.fast, job.q, job.out)), bar=job.bar, note="the faster"),
        Contender("NumPy, stacked matrices", once(partial(job.plain, job.q, job.out)), note="straightforward code"),
        Contender("write: memory in use", once(writer(job.bytes, fresh=False)), "limit", note=_size(job)),
        *_compute(job),
    ]


def _new(job: Job) -> list[Contender]:
    new = partial(job.armlab, job.robot, job.q)
    return [
        Contender(f"armlab {job.call})", once(new), "armlab"),
        Contender("armlab with two threads", once(partial(new, threads=2), clock=perf_counter), "armlab", note=WALL),
        Contender("NumPy, side by side", once(partial(job.fast, job.q)), note="the faster"),
        Contender("NumPy, stacked matrices", once(partial(job.plain, job.q)), bar=job.bar, note="straightforward code"),
        _tenth("armlab's reference kernel, blocked", partial(_by_blocks, job.reference), job.q),
        *job.peers,
        Contender("write: new memory", once(writer(job.bytes, fresh=True)), "limit", note=_size(job)),
        *_compute(job),
    ]


def _few(job: Job, rounds: int) -> Table:
    """Return the table for ten thousand poses, a typical planner batch."""
    new = once(partial(job.armlab, job.robot, job.q))
    contenders = [
        Contender(f"armlab {job.call})", new, "armlab"),
        Contender("NumPy, side by side", once(partial(job.fast, job.q))),
        Contender("NumPy, stacked matrices", once(partial(job.plain, job.q)), bar=1 / 12, note="straightforward code"),
    ]
    return table("10,000 poses with Jacobians", f"{job.robot.name}, new arrays.", "ms", contenders, 4 * rounds)


def _tenth(name: str, function: Callable[[np.ndarray], Any], q: np.ndarray, note: str = "") -> Contender:
    """Return a contender that works by row or by block; its time is extrapolated from 10 % of the poses."""
    return Contender(name, once(partial(function, q[: len(q) // 10]), scale=10.0), note=f"{note}a tenth, times 10")


def _by_blocks(kernel: Callable[..., Any], q: np.ndarray) -> list[Any]:
    return [kernel(q[start : start + REFERENCE_BLOCK]) for start in range(0, len(q), REFERENCE_BLOCK)]


def _into(kernel: Callable[..., Any], q: np.ndarray, out: Any) -> Any:
    return kernel(q, out=out)


def _line(text: str) -> str:
    return " ".join(text.split())


def _size(job: Job) -> str:
    return f"{job.bytes / 1e6:.0f} MB"


def _compute(job: Job) -> list[Contender]:
    """Return the limits of computation: the kernel without memory traffic, and the arithmetic alone."""
    calls = len(job.q) // IN_CACHE
    rows = list(job.q[: calls * IN_CACHE].reshape(calls, IN_CACHE, -1))
    out = tuple(array[:IN_CACHE] for array in job.out) if isinstance(job.out, tuple) else job.out[:IN_CACHE]
    block = loop(lambda block: job.kernel(block, out), rows)
    operation = arithmetic()
    return [
        Contender("compute: the kernel in cache", lambda: block() * calls, "limit", note=f"{IN_CACHE} poses at a time"),
        Contender(
            "compute: the arithmetic alone",
            lambda: np.array([job.operations * len(job.q) * operation()]),
            "limit",
            note=f"{job.operations} operations per pose at matrix-product speed",
        ),
    ]


def _operations(n: int, with_jacobian: bool) -> int:
    """Count the additions and multiplications for one pose of an arm with perpendicular axes.

    Per joint: 37 for sine and cosine (angle, reduction, two polynomials), 18 for rotating two columns, 12 for two
    lengths, and 12 for the Jacobian (a difference and a cross product).
    """
    return n * (37 + 18 + 12 + (12 if with_jacobian else 0))
