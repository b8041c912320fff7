"""Learn a distribution of motions from several demonstrations, and condition it on a point above all demonstrations."""

import numpy as np

from armlab import motion, plots


def demonstrations() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return eight paths (x, y) [m] over an obstacle, with varying heights and durations and 0.5 mm of noise."""
    rng, found = np.random.default_rng(1), []
    for _ in range(8):
        t = np.linspace(0.0, rng.normal(2.0, 0.1), 400)
        s = motion.profiles.minimum_jerk([0.0], [1.0], t[-1]).at(t)[0][:, 0]
        height, lean = rng.normal(0.2, 0.05), rng.normal(0.0, 0.04)
        way = np.stack([0.5 * s + lean * np.sin(np.pi * s), height * np.sin(np.pi * s) ** 2], axis=1)
        found.append((t, way + rng.normal(size=way.shape) * 5e-4))
    return found


def main() -> None:
    shown = demonstrations()
    promp = motion.fit_promp([t for t, _ in shown], [y for _, y in shown]).value
    middle = promp.duration / 2
    sd = promp.marginal([middle]).sd[0]
    print(f"{len(shown)} demonstrations: sd at mid-motion {1e3 * sd[0]:.0f} and {1e3 * sd[1]:.0f} mm")

    passing = promp.condition(middle, [0.29], cov=1e-6, coordinates=[1])  # this height, with an sd of 1 mm
    there = passing.marginal([middle])
    print(
        f"conditioned: height {there.y[0, 1]:.3f} m at x = {there.y[0, 0]:.3f} m, sd of x {1e3 * there.sd[0, 0]:.0f} mm"
    )

    mean = passing.marginal(0.004)
    dmp = motion.fit_dmp(mean.t, mean.y).value  # for a controller
    print(f"primitive error: at most {1e3 * np.abs(dmp.rollout(mean.t).y - mean.y).max():.2f} mm")
    plots.promp(passing, prior=promp, points=[(middle, [np.nan, 0.29])], samples=5).savefig("several.png")


if __name__ == "__main__":
    main()
