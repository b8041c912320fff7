"""Movement primitives for the how-to. Writes dmp.svg, dmp_phase.svg, pose_dmp.svg and periodic_dmp.svg."""

from __future__ import annotations

import numpy as np

from armlab import kinematics, plots, robots
from armlab.motion import fit_dmp, fit_periodic_dmp, fit_pose_dmp

ROBOT = robots.load("yumi_right")
T = np.linspace(0.0, 2.0, 501)
S = 10 * (T / 2) ** 3 - 15 * (T / 2) ** 4 + 6 * (T / 2) ** 5


def main() -> None:
    """Plot two joints with a moving goal, their phase plane, a tool motion, and a periodic motion."""
    q = np.stack([0.8 * S, 0.3 * S + 0.2 * np.sin(np.pi * S) ** 2], axis=1)
    dmp = fit_dmp(T, q, n_basis=30).value
    plots.dmp(dmp, (T, q), [(0.8, [1.2, 0.1])]).savefig("dmp.svg")
    plots.dmp_phase(dmp).figure.savefig("dmp_phase.svg")
    way = np.outer(S, np.deg2rad([20, 10, -15, -20, 30, 10, -40]))
    shown = kinematics.forward(ROBOT, ROBOT.q_home + way)
    plots.pose_dmp(fit_pose_dmp(T, shown).value, (T, shown)).savefig("pose_dmp.svg")
    t = np.arange(0.0, 6.4, 0.004)
    turn = 2 * np.pi * t / 1.6
    p = np.stack([0.02 * np.sin(2 * turn), 0.05 * np.cos(turn)], axis=1)
    p += np.random.default_rng(0).normal(size=p.shape) * 5e-4
    plots.periodic_dmp(fit_periodic_dmp(t, p, period=1.6).value, (t, p)).savefig("periodic_dmp.svg")


if __name__ == "__main__":
    main()
