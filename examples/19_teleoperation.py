"""Teleoperation: the left arm of a YuMi yields to a hand, and the right arm mirrors its motion.

A simulated hand pushes the left arm in lockstep. To run the program on a robot, use two egm:// addresses.
"""

from pathlib import Path

import numpy as np

from armlab import Command, State, bridge, kinematics, robots

PUSH = "t,fx,fy,fz,mx,my,mz\n1,0,0,0,0,0,0\n1.2,0,25,0,0,0,0\n2.5,0,25,0,0,0,0\n2.7,0,0,0,0,0,0\n"
MIRROR = np.array([-1, 1, -1, 1, -1, 1, -1])  # the arms are mirror images about the plane y = 0
START: dict[str, np.ndarray] = {}  # torque at the start of guidance: gravity and static friction


def follow(state: State) -> tuple[Command, Command]:
    """Make the left arm yield to the torque change since the start, and the right arm mirror its motion."""
    left, right = state.arms
    pushed = START.setdefault("tau", left.tau) - left.tau  # the position-controlled drives resist the hand
    yielding = 0.1 * np.sign(pushed) * np.maximum(np.abs(pushed) - 2.5, 0.0)
    target = right.q_start + MIRROR * (left.q - left.q_start)
    return Command(qd=yielding), Command(target, MIRROR * left.qd)


def main() -> None:
    left, right = robots.load("yumi_left"), robots.load("yumi_right")
    Path("push.csv").write_text(PUSH)
    url = "sim://yumi_left+yumi_right?lockstep=true&seed=1&operator=push.csv"
    with bridge.connect(url, [left, right]) as link:
        run = link.run(follow, seconds=4.0)
    for robot in (left, right):
        tool = kinematics.forward(robot, run.table[f"{robot.name}.q"][[0, -1]])[:, :3, 3]
        print(f"{robot.name} moved by {(1e3 * (tool[1] - tool[0])).round()} mm")


if __name__ == "__main__":
    main()
