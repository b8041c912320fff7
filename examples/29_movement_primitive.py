"""Learn a motion from a noisy demonstration, run it more slowly to a new goal, and change the goal mid-run."""

import numpy as np

from armlab.motion import Dmp, fit_dmp


def demonstration() -> tuple[np.ndarray, np.ndarray]:
    """Return two seconds of hand-guided motion of two joints, with encoder noise."""
    t = np.linspace(0.0, 2.0, 501)
    u = t / t[-1]
    s = 10 * u**3 - 15 * u**4 + 6 * u**5
    q = np.stack([0.8 * s, 0.3 * s + 0.2 * np.sin(np.pi * s) ** 2], axis=1)
    return t, q + np.random.default_rng(0).normal(size=q.shape) * 1e-4


def main() -> None:
    t, q = demonstration()
    fit = fit_dmp(t, q)
    dmp = fit.value
    print(f"{dmp.n} joints, {dmp.n_basis} kernels, estimated noise {fit.sigma * 1e3} mrad")

    slower = dmp.rollout(0.004, duration=4.0, g=[1.2, 0.1])  # twice the duration, new goal
    print(f"{len(slower.t)} samples, end {slower.y[-1].round(3)} rad, peak speed {abs(slower.yd).max():.2f} rad/s")

    stepper = dmp.stepper(brake=True)  # sample by sample, as in a control loop
    for k in range(750):
        y, _, _ = stepper.step(0.004)  # position, velocity, acceleration
        if k == 200:
            stepper.change_goal([1.0, 0.3])
    print(f"end after the goal change: {y.round(3)} rad")

    path = dmp.save("wave.toml")
    print("loaded primitive equals the saved one:", Dmp.load(path) == dmp)


if __name__ == "__main__":
    main()
