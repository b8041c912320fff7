"""Accuracy of contact forces: identify on one simulated log, estimate on another, and compare with the applied force.

One seed of the protocol has three parts. The excitation lasts 60 s, with 8 harmonics of 0.1 Hz, up to 60 % speed and 15
rad/s^2; a model is identified from it. The test motion lasts 60 s, with 6 harmonics of 0.07 Hz from another seed, up to
40 % speed. Every 3 s, a 5 N push in a random direction lasts 1 s, with ramps of 0.1 s. Finally, presses of 500 g act in
+x and -z at the home posture, first while the arm sways by 2 degrees at 0.5 Hz, and then while it rests. The estimator
receives only logs. With `gains`, every torque sensor has an unknown gain error, which is the same in all logs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from armlab import contact, identify, log, models, robots, sim

__all__ = ["Logs", "Score", "judge", "record"]

PUSH, EVERY, RAMP = 5.0, 3.0, 0.1  # force [N], interval [s], ramp [s]
WEIGHT = 4.905  # N, weight of 500 g
Wrench = Callable[[np.ndarray], np.ndarray]  # times (N,) -> wrenches (N, 6)
SEEN = 0.9  # observability above which an axis counts
SPEEDS = (0.0, 0.05, 0.1, 0.2, 1.0)  # edges of speed bins, as shares of the speed limits
EDGE = 0.2  # s after the start of a ramp that count as its edge


@dataclass(frozen=True, eq=False)
class Logs:
    """Logs of one seed, and the model identified from the first.

    Attributes
    ----------
    model : identified from the excitation. moving : test motion with pushes. edges : start times of its ramps [s].
    swaying, resting : per press of 500 g, its axis and sign, and its log.
    """

    robot: robots.Robot
    model: models.TorqueModel
    moving: log.Table
    edges: np.ndarray
    swaying: dict[str, log.Table]
    resting: dict[str, log.Table]


@dataclass(frozen=True, eq=False)
class Score:
    """Errors of the estimate relative to the truth, per axis x, y, z.

    Attributes
    ----------
    rms : RMS error during pushes where the axis is observable [N].
    free : false force in motion below half speed without pushes [N].
    inside : share of forces within 2 sigma, without edges. with_edges : the same for all rows.
    by_speed : (4, 3) share of forces within 2 sigma, without edges, by speed of the fastest joint, see `SPEEDS`.
    press : relative error of the mean over 2 s of each press of 500 g while swaying.
    rest_inside : share of rows at rest whose interval (or 2 sigma) contains the truth. stuck : share flagged STUCK.
    """

    rms: np.ndarray
    free: np.ndarray
    inside: np.ndarray
    with_edges: np.ndarray
    by_speed: np.ndarray
    press: dict[str, float]
    rest_inside: float
    stuck: float


def record(name: str, seed: int, gains: float = 0.0) -> Logs:
    """Record the logs of one seed and identify the model.

    Parameters
    ----------
    name : yumi_left or yumi_right. seed : seed of motions, pushes and noise.
    gains : largest relative error of the unknown torque constants, which are uniformly distributed.
    """
    robot = robots.load(name)
    mismatch = sim.Mismatch(torque_constant=gains, seed=seed)
    truth = sim.synthetic_truth(robot)
    centre = robot.q_home.copy()
    centre[1] = np.deg2rad(-60.0)

    def run(motion: identify.Trajectory, number: int, wrench: Wrench | None = None) -> log.Table:
        arm = sim.SimulatedArm(robot, truth, seed=[seed, number], mismatch=mismatch)
        return sim.record(arm, motion, wrench)

    excitation = identify.design_excitation(robot, centre=centre, seed=seed)  # the defaults match the protocol
    model = identify.fit_dynamics(run(excitation, 1), robot).value
    test = identify.design_excitation(robot, f0=0.07, harmonics=6, speed=0.4, centre=centre, seed=1000 + seed)
    pushes, edges = _pushes(test.seconds, np.random.default_rng([seed, 11]))
    sway, rest = identify.dither(robot.q_home, 6.0), identify.dither(robot.q_home, 4.0, amplitude=0.0)
    presses = {"+x": (0, WEIGHT), "-z": (2, -WEIGHT)}
    return Logs(
        robot,
        model,
        run(test, 2, pushes),
        edges,
        {k: run(sway, 3 + i, _press(*presses[k], 2.0, 4.5)) for i, k in enumerate(presses)},
        {k: run(rest, 5 + i, _press(*presses[k], 1.0, 3.0)) for i, k in enumerate(presses)},
    )


def judge(logs: Logs, method: str) -> Score:
    """Estimate all logs with one method, and compare with the true force.

    Parameters
    ----------
    logs : logs of one seed. method : method of `contact.Estimator`.
    """
    estimator = contact.Estimator(logs.model, logs.robot, method=method)
    table = estimator.run(logs.moving)
    error, sigma, seen = _errors(table)
    t, pushed = table.t, np.abs(table["wrench_true"]).sum(axis=1) > 0
    inside = np.abs(error) < 2 * sigma
    speed = (np.abs(table["qd"]) / logs.robot.qd_max).max(axis=1)
    slow = (speed < 0.5) & ~_near(t, logs.edges, 0.5)
    calm, ready = ~_near(t, logs.edges, EDGE), t > 1.0
    press = {}
    for label, one in logs.swaying.items():
        found = estimator.run(one).between(2.5, 4.5)
        axis, force = "xyz".index(label[1]), float(found["wrench_true"][-1, "xyz".index(label[1])])
        press[label] = float(found["wrench_hat"][:, axis].mean() / force - 1.0)
    rest = [estimator.run(one) for one in logs.resting.values()]
    return Score(
        rms=_rms(error, seen & (pushed & ready)[:, None]),
        free=_rms(error, seen & (slow & ~pushed & ready)[:, None]),
        inside=_share(inside[calm & ready]),
        with_edges=_share(inside[ready]),
        by_speed=np.array([_share(inside[calm & ready & (speed >= a) & (speed < b)]) for a, b in pairwise(SPEEDS)]),
        press=press,
        rest_inside=float(np.mean([_rest_inside(one) for one in rest])),
        stuck=float(np.mean([((one["wrench_flags"] & contact.STUCK) > 0)[250:].mean() for one in rest])),
    )


def _pushes(seconds: float, rng: np.random.Generator) -> tuple[Wrench, np.ndarray]:
    """Return pushes in random directions, and the start times of all ramps."""
    starts = np.arange(1.5, seconds - 2.0, EVERY)
    directions = rng.standard_normal((len(starts), 3))
    force = PUSH * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    wrench = np.zeros((len(starts), 4, 6))
    wrench[:, 1:3, :3] = force[:, None]
    corners = starts[:, None] + np.array([0.0, RAMP, 1.0 - RAMP, 1.0])
    return _over_time(corners.ravel(), wrench.reshape(-1, 6)), np.concatenate([starts, starts + 1.0 - RAMP])


def _press(axis: int, force: float, start: float, end: float) -> Wrench:
    wrench = np.zeros((4, 6))
    wrench[1:3, axis] = force
    return _over_time(np.array([start - RAMP, start, end, end + RAMP]), wrench)


def _over_time(times: np.ndarray, wrenches: np.ndarray) -> Wrench:
    return lambda t: np.stack([np.interp(t, times, w, left=0.0, right=0.0) for w in wrenches.T], axis=1)


def _errors(table: log.Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the error, sigma (N, 3) and the mask of observable axes."""
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"])[:, :3])
    return table["wrench_hat"][:, :3] - table["wrench_true"][:, :3], sigma, table["observability"][:, :3] >= SEEN


def _near(t: np.ndarray, edges: np.ndarray, after: float) -> np.ndarray:
    """Return the mask of times within `after` seconds of the start of a ramp (including its length)."""
    lag = t[:, None] - edges
    return ((lag >= 0) & (lag < RAMP + after)).any(axis=1)


def _rms(error: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.array([np.sqrt(np.mean(error[rows[:, i], i] ** 2)) if rows[:, i].any() else np.nan for i in range(3)])


def _share(rows: np.ndarray) -> np.ndarray:
    return rows.mean(axis=0) if len(rows) else np.full(3, np.nan)


def _rest_inside(table: log.Table) -> float:
    """Return the share of rows at rest whose interval contains the true force in all axes, after the first second."""
    table = table.between(1.0, table.t[-1])
    truth = table["wrench_true"][:, :3]
    if "wrench_interval" in table:
        interval = table["wrench_interval"][:, :3]
        return float(((truth >= interval[..., 0]) & (truth <= interval[..., 1])).all(axis=1).mean())
    error, sigma, _ = _errors(table)
    return float((np.abs(error) < 2 * sigma).all(axis=1).mean())
