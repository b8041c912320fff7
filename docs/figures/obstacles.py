"""A movement primitive around obstacles in the plane. Writes obstacles.svg."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

from armlab._display import AXIS_COLORS, GREY
from armlab.motion import AvoidingDmp, Capsule, fit_dmp
from armlab.plots.style import MODEL, look

SCENE = [Capsule.sphere([0.15, 0.09], 0.025), Capsule([0.31, 0.02], [0.34, 0.09], 0.015)]
CLEARANCE, REACH = 0.02, 0.08


def main() -> None:
    """Plot the path without avoidance and with both forms of avoidance, and the distances against time."""
    u = np.linspace(0.0, 1.0, 501)
    s = u**3 * (10 - 15 * u + 6 * u**2)
    dmp = fit_dmp(u, np.stack([0.5 * s, 0.12 * np.sin(np.pi * s)], axis=1)).value
    t = np.linspace(0.0, 2.4, 1201)
    figure, (plane, time) = plt.subplots(1, 2, figsize=(9.0, 3.2), layout="constrained", width_ratios=[1.5, 1.0])
    for wider, colour in ((CLEARANCE, "0.85"), (0.0, GREY)):
        for one in SCENE:
            for share in np.linspace(0.0, 1.0, 40):
                plane.add_patch(Circle(one.a + share * (one.b - one.a), one.radius + wider, color=colour))
    runs = {"without avoidance": (dmp.rollout(t, duration=2.0), "black", "--")}
    for form, colour in (("steering", MODEL), ("potential", AXIS_COLORS[2])):
        runs[form] = (AvoidingDmp(dmp, SCENE, CLEARANCE, REACH, form).rollout(t, duration=2.0), colour, "-")
    for name, (run, colour, line) in runs.items():
        plane.plot(*run.y.T, color=colour, linestyle=line, label=name)
        distance = AvoidingDmp(dmp, SCENE, CLEARANCE, REACH).distance(run.y)
        time.plot(t, 1e3 * distance, color=colour, linestyle=line)
    time.axhline(1e3 * CLEARANCE, color="black", linestyle=":")
    plane.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", ylim=(-0.03, 0.21))
    figure.legend(loc="outside lower center", ncols=3)
    time.set(xlabel="time [s]", ylabel="distance [mm]", ylim=(-30, 120))
    figure.savefig("obstacles.svg")


if __name__ == "__main__":
    with look():
        main()
