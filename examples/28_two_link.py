"""Two-link arm: inverse kinematics, a movement primitive, inverse dynamics, and recovery from a push.

Port of src/demo_two_link.jl from DynamicMovementPrimitives.jl; the original raises an error.
"""

import numpy as np

from armlab import motion
from armlab.sim import two_link

POINTS = np.array([(0.5, -0.5), (0.5, 0.0), (1.5, 0.0), (1.5, -0.5)])  # m
PUSH = (1.2, 1.7, np.array([1.5, -1.0]))  # start, end [s], N m


def plant(t: float, q: np.ndarray, qd: np.ndarray, qdd_ref: np.ndarray) -> np.ndarray:
    """Return the acceleration of the arm under the commanded torque and the push."""
    tau = two_link.inverse_dynamics(q, qd, qdd_ref)
    return two_link.forward_dynamics(q, qd, tau + (PUSH[2] if PUSH[0] <= t < PUSH[1] else 0.0))


def main() -> None:
    profile = motion.profiles.connect(two_link.inverse(POINTS), 2.0)
    t = np.arange(0.0, profile.duration + 0.005, 0.01)
    taught = profile.at(t)[0]
    dmp = motion.fit_dmp(t, taught).value
    run = motion.TwoDofDmp(dmp).simulate(dmp.times(0.01, 12.0), [plant], dt=0.01)
    shown, tip, path, free = (two_link.forward(q) for q in (taught, run.ya, run.yc, run.free.y))
    for name, off in (("repetition", free[: len(t)] - shown), ("path with a push", tip - path)):
        print(f"{name}: tip error at most {1e3 * np.linalg.norm(off, axis=1).max():.1f} mm")
    print(f"end: tip {1e3 * np.linalg.norm(tip[-1] - POINTS[-1]):.2f} mm from the last point")


if __name__ == "__main__":
    main()
