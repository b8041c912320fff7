"""`record`: a log of a simulated arm without a controller or a wire between, for tests and experiments.

The drives follow the motion itself; what the sensors report is the log. Time stamps jitter and samples are lost as the
arm's `Mismatch` says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import ConfigError, ShapeError
from armlab.sim.arm import Arm

if TYPE_CHECKING:
    from armlab.identify import Trajectory
    from armlab.log import Table

__all__ = ["record"]


def record(
    arm: Arm, motion: Trajectory, wrench: Callable[[np.ndarray], np.ndarray] | None = None, seed: int = 0
) -> Table:
    """Run a motion and return what the sensors report: t, q, qd, tau, and wrench_true where there is one.

    Parameters
    ----------
    arm : is placed at the start of the motion; its noise goes on from where it was.
    motion : reference of the drives.
    wrench : gives the wrench (N, 6) by the environment on the robot, base axes, at the tool point, at times (N,).
    seed : of jitter and loss of time stamps.

    Raises
    ------
    ConfigError : a jitter of half a period or more, which would turn time back.
    ShapeError : a motion of another number of joints, or a wrench of another shape.
    """
    from armlab.log import Table  # here: a simulator that only sends starts without it

    knobs, period, n = arm.mismatch, arm.period, arm.robot.n
    if not knobs.jitter < period / 2:
        raise ConfigError(f"Expected a jitter below half a period of {period} s, got {knobs.jitter} s.")
    count = int(motion.seconds / period)
    t = period * np.arange(1, count + 1)
    q_ref, qd_ref, _ = motion.sample(t)
    if q_ref.shape != (count, n):
        raise ShapeError(f"Expected a motion of {n} joints of {arm.robot.name!r}, got shape {q_ref.shape[1:]}.")
    pushes = np.zeros((count, 6)) if wrench is None else np.asarray(wrench(t), dtype=float)
    if pushes.shape != (count, 6):
        raise ShapeError(f"Expected a wrench of shape ({count}, 6) for {count} times, got {pushes.shape}.")
    arm.place(motion.q_first)
    seen = np.empty((3, count, n))
    for k in range(count):
        arm.step(q_ref[k], qd_ref[k], None if wrench is None else pushes[k])
        measured = arm.measure()
        seen[:, k] = measured.q, measured.qd, measured.tau
    values = dict(zip(("q", "qd", "tau"), seen)) | ({} if wrench is None else {"wrench_true": pushes})
    rng = np.random.default_rng([knobs.seed, seed])
    stamps = t + knobs.jitter * rng.uniform(-1.0, 1.0, count)
    return Table(stamps, values).rows(rng.uniform(size=count) >= knobs.lost)
