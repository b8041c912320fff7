"""Home configurations of the library robots, for the reference. Writes library.svg."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from armlab import plots, robots
from armlab.plots import space
from armlab.plots.style import look
from armlab.robots.robot import arm_length

COLUMNS = 4


def main() -> None:
    """Draw one panel per arm."""
    names = robots.names()
    rows = -(-len(names) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(9.0, 2.5 * rows), subplot_kw=space.PROJECTION)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, name in zip(axes.flat, names):
        arm = robots.load(name)
        plots.robot(arm, frames=False, ax=ax)
        space.frame(ax, np.eye(4), 0.1 * arm_length(arm), letters=False)
        space.equal_scale(ax, 1.05)
        ax.set_title(name, fontsize=9.5, pad=0.0)
    figure.savefig("library.svg")


if __name__ == "__main__":
    with look():
        main()
