"""A two-degree-of-freedom movement primitive during a hold. Writes two_dof.svg."""

from __future__ import annotations

import numpy as np

from armlab import plots
from armlab.motion import Hold, TwoDofDmp, fit_dmp, profiles


def main() -> None:
    """Plot two oscillating joints; the first is held for two seconds, and both wait."""
    there = profiles.spline([0, 1.5, 3, 4.5, 6], [[0, 0], [0.8, 0.3], [0.2, 0.5], [1.0, 0.2], [0.6, 0.6]])
    t = np.linspace(0.0, there.duration, 601)
    run = TwoDofDmp(fit_dmp(t, there.at(t)[0]).value).simulate(np.linspace(0.0, 9.0, 901), [Hold(1.0, 3.0, [0])])
    plots.two_dof(run).savefig("two_dof.svg")


if __name__ == "__main__":
    main()
