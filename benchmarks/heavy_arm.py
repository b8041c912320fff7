"""Accuracy of contact forces on a heavy arm with unmodelled faults: load-dependent gear friction and wrong gains.

Each seed simulates an arm with the size and masses of a UR10e at 125 Hz. Torques are currents times assumed torque
constants, each of which is wrong by up to 15 %. Gears lose up to 6 % of the torque, offsets vary by 0.5 % of the torque
limit, and unmodelled ripple has 200 periods per revolution. A model is identified from 60 s without load. The same arm
then carries 0, 1 and 3 kg through another motion. The truth is the weight and inertial force of the load at the flange.

python benchmarks/heavy_arm.py                20 seeds, about a minute each
python benchmarks/heavy_arm.py --seeds 3      quick look
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab import contact, identify, log, models, robots, sim
from armlab.estimation import Fit
from armlab.sim.arm.mismatch import load_share, torque_gain
from armlab.sim.arm.truth import cylinder

__all__ = ["GAINS", "LOADS", "LOAD_FRICTION", "METHODS", "Logs", "judge", "record", "ur10e"]

PERIOD = 0.008  # s
GAINS, LOAD_FRICTION, DRIFT = 0.15, 0.06, 0.005
LOADS = (0.0, 1.0, 3.0)  # kg
METHODS = ("map", "observer", "kf")
READY = 1.0  # s in which an estimator forgets its initial state
MASSES = (7.369, 13.051, 3.989, 2.1, 1.98, 0.615)
TAU_MAX = np.array([330.0, 330.0, 150.0, 56.0, 56.0, 56.0])
ROTOR = np.array([3.0, 3.0, 1.5, 0.3, 0.3, 0.3])  # assumed rotor inertias
HOME = np.deg2rad([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])


@dataclass(frozen=True, eq=False)
class Logs:
    """Logs of one seed, and the model identified from the first.

    Attributes
    ----------
    fit : fit to the excitation without load. loaded : log of the other motion for each load mass [kg].
    of_load : (n,) true load friction. gains : (n,) ratio of measured to true torque.
    """

    robot: robots.Robot
    fit: Fit[models.TorqueModel]
    loaded: dict[float, log.Table]
    of_load: np.ndarray
    gains: np.ndarray


def ur10e() -> robots.Robot:
    """Return the arm from the vendor's Denavit-Hartenberg table, which does not include gears."""
    return robots.from_dh(
        "ur10e",
        alpha=np.pi / 2 * np.array([1, 0, 0, 1, -1, 0]),
        a=[0, -0.6127, -0.57155, 0, 0, 0],
        d=[0.1807, 0, 0, 0.17415, 0.11985, 0.11655],
        q_min=np.full(6, -2 * np.pi),
        q_max=np.full(6, 2 * np.pi),
        qd_max=np.deg2rad([120.0, 120, 180, 180, 180, 180]),
        q_home=HOME,
        source="vendor's table of DH parameters",
    )


def truth_of(robot: robots.Robot) -> sim.Truth:
    """Return a synthetic truth: solid cylinders with the vendor's masses, and friction according to the rule of
    `sim`."""
    coulomb, n = 0.05 * TAU_MAX, robot.n
    zero, p = np.zeros(n), robot.links[1:, :3, 3]
    return sim.Truth(
        pi=np.array([cylinder(mass, at, 0.06, 0.1) for mass, at in zip(MASSES, p)]),
        rotor=ROTOR,
        tau_max=TAU_MAX,
        coulomb_pos=1.05 * coulomb,
        coulomb_neg=0.95 * coulomb,
        static_ratio=zero + 1.3,
        stribeck_speed=zero + 0.05,
        viscous=coulomb / robot.qd_max,
        offset=0.01 * TAU_MAX * (-1.0) ** np.arange(n),
        delta=zero + 1e-4,
        ripple=0.01 * TAU_MAX,
        ripple_cycles=zero + 200.0,
        ripple_phase=np.arange(n, dtype=float),
        tau_noise=0.005 * TAU_MAX,
        tau_step=0.001 * TAU_MAX,
        q_step=zero + 1e-5,
        qd_noise=zero + 1e-3,
        feedforward=zero + 0.9,
    )


def record(seed: int) -> Logs:
    """Record the logs of one seed and identify the model.

    Parameters
    ----------
    seed : seed of motions, noise and faults.
    """
    robot = ur10e()
    faults = sim.Mismatch(torque_constant=GAINS, load_friction=LOAD_FRICTION, offset_drift=DRIFT, seed=seed)
    arm = sim.SimulatedArm(robot, truth_of(robot), period=PERIOD, seed=seed, mismatch=faults)  # drift continues
    free = sim.record(arm, identify.design_excitation(robot, acceleration=4.0, seed=seed))
    test = identify.design_excitation(robot, f0=0.07, harmonics=6, speed=0.4, acceleration=4.0, seed=1000 + seed)
    loaded = {mass: sim.record(arm, test, lambda t, m=mass: carried(robot, test, m, t)) for mass in LOADS}
    n = robot.n
    return Logs(robot, identify.fit_dynamics(free, robot), loaded, load_share(faults, n), torque_gain(faults, n))


def carried(robot: robots.Robot, motion: identify.Trajectory, mass: float, t: np.ndarray) -> np.ndarray:
    """Return the weight and inertial force (N, 6) at the flange of a moving point mass, at times (N,)."""
    step = 0.5 * PERIOD
    before, here, after = (robot.chain.forward(motion.sample(at)[0])[:, :3, 3] for at in (t - step, t, t + step))
    force = mass * (robot.gravity - (before - 2.0 * here + after) / step**2)
    return np.hstack([force, np.zeros_like(force)])


def judge(logs: Logs, method: str, mass: float, model: models.TorqueModel | None = None) -> tuple[np.ndarray, ...]:
    """Return the RMS error [N] and the share within 2 sigma per axis for one method.

    Parameters
    ----------
    logs : logs of one seed. method : method of `contact.Estimator`. mass : mass of the load [kg].
    model : default: identified.
    """
    estimator = contact.Estimator(logs.fit.value if model is None else model, logs.robot, method=method)
    table = estimator.run(logs.loaded[mass])
    table = table.between(READY, table.t[-1])
    error = (table["wrench_hat"] - table["wrench_true"])[:, :3]
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"])[:, :3])
    return np.sqrt(np.mean(error**2, axis=0)), np.mean(np.abs(error) < 2.0 * sigma, axis=0)


def without_load_friction(logs: Logs) -> models.TorqueModel:
    """Return the model without load friction."""
    model = logs.fit.value
    return replace(model, friction=replace(model.friction, load=np.zeros(model.n)))


def without_doubt(logs: Logs) -> models.TorqueModel:
    """Return the model with exact gains and load friction."""
    model = logs.fit.value
    return replace(model, gain_cov=0.0 * model.gain_cov, load_sd=np.zeros(model.n))


def main() -> int:
    """Run all seeds and print the table."""
    parser = argparse.ArgumentParser(description="Accuracy of contact forces on a heavy arm.")
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    scores: dict[tuple[str, float], list[tuple[np.ndarray, ...]]] = {}
    for seed in range(options.seeds):
        print(f"seed {seed} ...", file=sys.stderr, flush=True)
        logs = record(seed)
        for method in METHODS:
            for mass in LOADS:
                scores.setdefault((method, mass), []).append(judge(logs, method, mass))
    print("\n".join(table(scores)))
    return 0


def table(scores: dict[tuple[str, float], list[tuple[np.ndarray, ...]]]) -> list[str]:
    """Return lines with the RMS error of the worst axis and the share of all axes within 2 sigma, over the seeds."""
    lines = ["| method | load [kg] | force RMS, worst axis [N] | within 2 sigma [%] |", "|---|---|---|---|"]
    for (method, mass), found in scores.items():
        rms = [values.max() for values, _ in found]
        inside = [100.0 * share for _, share in found]
        lines.append(f"| {method} | {mass:g} | {_spread(rms)} | {_spread(inside)} |")
    return lines


def _spread(values: Sequence[np.ndarray]) -> str:
    numbers = np.ravel(values)
    return f"{np.median(numbers):.3g} ({numbers.min():.3g} to {numbers.max():.3g})"


if __name__ == "__main__":
    sys.exit(main())
