"""Plan point-to-point motions; compare their durations, peak speeds and peak accelerations."""

import numpy as np

from armlab import Command, State, bridge, robots
from armlab.motion import profiles

ROBOT = robots.load("yumi_left")
SLOW, SOFT = 0.3 * ROBOT.qd_max, 2.0  # rad/s, rad/s^2


def report(name: str, profile: profiles.Profile) -> None:
    speed, acceleration = (profile.qd_peak / SLOW).max(), profile.qdd_peak.max()
    print(f"{name:13s} {profile.duration:.3f} s, {speed:.0%} of the speed limit, at most {acceleration:.2f} rad/s^2")


def main() -> None:
    start, end = ROBOT.q_home, ROBOT.q_home + np.deg2rad([30, -10, 20, -25, 40, 15, -60])
    smooth = profiles.minimum_jerk(start, end, duration=0.5).slowed(SLOW, SOFT)  # shortest duration within the limits
    report("minimum jerk", smooth)
    report("trapezoidal", profiles.trapezoidal(start, end, SLOW, SOFT))
    report("spline", profiles.spline([0, 1, 2], [start, (start + end) / 2, end]).slowed(SLOW, SOFT))
    report("there and back", profiles.connect([start, end, start], duration=2.0))

    def follow(state: State) -> Command:  # the same displacement, from the current position
        q, qd, _ = smooth.at(state.t)
        return Command(state.q_start + q - start, qd)

    with bridge.connect("sim://yumi_left?lockstep=true", ROBOT) as link:
        q = link.run(follow, seconds=smooth.duration + 0.5).table["q"]
    print("the arm moved", np.rad2deg(q[-1] - q[0]).round(1), "deg")


if __name__ == "__main__":
    main()
