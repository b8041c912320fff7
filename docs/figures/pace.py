"""A movement primitive within limits: uniformly slowed and retimed. Writes pace.svg."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from armlab._display import AXIS_COLORS
from armlab.motion import fit_dmp, retimed, shortest_duration
from armlab.plots.style import MODEL, look

LIMITS = (1.0, 8.0)


def main() -> None:
    """Plot velocity and acceleration of two coordinates against time."""
    u = np.linspace(0.0, 1.0, 501)
    s = u**3 * (10 - 15 * u + 6 * u**2)
    y = np.stack([0.4 * np.sin(2.8 * np.pi * s), 0.6 * s + 0.1 * np.cos(4 * np.pi * s)], axis=1)
    dmp = fit_dmp(u, y, v0=[0.0, 0.0]).value
    paced, whole = retimed(dmp, *LIMITS), shortest_duration(dmp, *LIMITS)
    runs = {
        f"uniformly slowed, {whole:.1f} s": (dmp.rollout(0.002, duration=whole), AXIS_COLORS[2]),
        f"retimed, {paced.duration:.1f} s": (paced.rollout(0.002), MODEL),
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
