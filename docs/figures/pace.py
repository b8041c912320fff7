"""A primitive within limits, as a whole slower and only where it has to be, for the page on it. Writes pace.svg."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from armlab._palette import AXIS_COLORS
from armlab.motion import fit_dmp, retimed, shortest_duration
from armlab.plots.style import MODEL, look

LIMITS = (1.0, 8.0)


def main() -> None:
    """Draw speed and acceleration of two coordinates over time."""
    u = np.linspace(0.0, 1.0, 501)
    s = u**3 * (10 - 15 * u + 6 * u**2)
    y = np.stack([0.4 * np.sin(2.8 * np.pi * s), 0.6 * s + 0.1 * np.cos(4 * np.pi * s)], axis=1)
    dmp = fit_dmp(u, y, v0=[0.0, 0.0]).value
    paced, whole = retimed(dmp, *LIMITS), shortest_duration(dmp, *LIMITS)
    runs = {
        f"as a whole, {whole:.1f} s": (dmp.rollout(0.002, duration=whole), AXIS_COLORS[2]),
        f"where it has to, {paced.duration:.1f} s": (paced.rollout(0.002), MODEL),
    }
    figure, axes = plt.subplots(2, 1, figsize=(8.0, 4.4), layout="constrained", sharex=True)
    for name, (run, colour) in runs.items():
        for ax, values in zip(axes, (run.yd, run.ydd)):
            ax.plot(run.t, values[:, 0], color=colour, label=name)
            ax.plot(run.t, values[:, 1], color=colour, linestyle="--")
    for ax, limit, label in zip(axes, LIMITS, ("velocity [1/s]", "acceleration [1/s²]")):
        for side in (-limit, limit):
            ax.axhline(side, color="black", linestyle=":")
        ax.set_ylabel(label)
    axes[0].legend(loc="lower right")
    axes[1].set_xlabel("time [s]")
    figure.savefig("pace.svg")


if __name__ == "__main__":
    with look():
        main()
