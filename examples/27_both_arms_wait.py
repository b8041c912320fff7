"""Both arms of a YuMi run one primitive: while a hand holds the left arm, the right arm waits."""

import numpy as np

from armlab import State, bridge, kinematics, log, motion, plots, robots

INERTIA = 1.0  # kg m^2, apparent inertia of each joint
HELD = (0.8, 2.8)  # s
LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
MOVE = np.deg2rad([20, 10, -15, -20, 30, 10, -40])
MIRROR = np.array([-1, 1, -1, 1, -1, 1, -1])  # the arms are mirror images about the plane y = 0


def give_way(state: State) -> np.ndarray:
    """Return the accelerations caused by the force of a hand on each arm."""
    pairs = zip((LEFT, RIGHT), state.arms, strict=True)
    return np.concatenate([kinematics.jacobian(robot, arm.q).T @ arm.wrench_raw for robot, arm in pairs]) / INERTIA


def main() -> None:
    start = np.concatenate([LEFT.q_home, RIGHT.q_home])
    demo = motion.profiles.minimum_jerk(start, start + np.concatenate([MOVE, MIRROR * MOVE]), duration=2.0)
    t = np.linspace(0.0, 2.0, 501)
    two_dof = motion.TwoDofDmp(motion.fit_dmp(t, demo.at(t)[0]).value, e0=0.02)
    controller = two_dof.controller([LEFT, RIGHT], give_way=give_way)
    url = f"sim://yumi_left+yumi_right?lockstep=true&force=true&grip={HELD[0]},{HELD[1]}"
    with bridge.connect(url, [LEFT, RIGHT]) as link:
        table = link.run(controller, seconds=5.5).table
    moved = [table["yumi_left.q"] - LEFT.q_home, MIRROR * (table["yumi_right.q"] - RIGHT.q_home)]
    path = np.stack([(one / MOVE).mean(axis=1) for one in moved], axis=1)
    begin, end = np.searchsorted(table.t, HELD)
    for when, k in (("held", begin), ("released", end), ("end", -1)):
        print(f"{when:8s} left arm at {path[k, 0]:.0%} of its path, right arm at {path[k, 1]:.0%}")
    print("done:", controller.done)
    column = log.Column(unit="1", labels=("left arm", "right arm"))
    plots.table(log.Table(table.t, {"path": path}, {"path": column}), "path").figure.savefig("both_arms.png")


if __name__ == "__main__":
    main()
