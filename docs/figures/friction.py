"""Friction, ripple and warm-up of the drives, for the page on friction. Writes friction.svg."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from armlab._display import GREY
from armlab.kernels import presliding
from armlab.models.friction import Friction, RippleLines, WarmUp, speed_basis
from armlab.plots.style import MODEL, look


def curve() -> tuple[np.ndarray, np.ndarray, Friction]:
    """Return speeds, sliding friction torques and the friction model."""
    one = {"viscous": 0.8, "coulomb_pos": 1.05, "coulomb_neg": 0.95, "offset": 0.1, "stribeck": 0.3, "delta": 1e-3}
    friction = Friction(
        **{k: np.array([v]) for k, v in one.items()}, stribeck_speed=np.array([0.05]), resolution=np.zeros(1)
    )
    qd = np.concatenate([-np.geomspace(1.0, 1e-3, 200), np.geomspace(1e-3, 1.0, 200)])[:, None]
    return qd, friction.torque(qd, np.sign(qd)), friction


def main() -> None:
    """Plot friction against speed and at reversals, ripple against position, and viscous friction during warm-up."""
    figure, axes = plt.subplots(2, 2, figsize=(8.0, 5.4), layout="constrained")
    qd, torque, friction = curve()
    ax = axes[0, 0]
    ax.plot(qd, torque, color=MODEL)
    ax.axhline(0.0, color=GREY, linewidth=0.6)
    ax.set(title="sliding friction", xlabel="velocity [rad/s]", ylabel="friction [N m]")

    q = 4e-3 * (1.0 - np.cos(np.linspace(0, 4 * np.pi, 2000)))[:, None]
    z = presliding(q, friction.delta, friction.resolution)
    ax = axes[0, 1]
    ax.plot(1e3 * q, friction.torque(0.01 * np.sign(z), z), color=MODEL)
    ax.set(title="reversals: presliding friction", xlabel="position [mrad]", ylabel="friction [N m]")

    speeds, widths = speed_basis(0.0, 1.0)
    k = np.zeros((1, 2, 8, 2))
    k[0, 0, :, 0], k[0, 1, :, 1] = np.linspace(0.3, 0.1, 8), np.linspace(0.2, 0.05, 8)
    lines = RippleLines(np.array([0]), np.array([200.0]), speeds[None], widths[None], k)
    q = np.linspace(0.0, 0.1, 500)[:, None]
    ax = axes[1, 0]
    for speed, style in ((0.1, "-"), (0.8, "--"), (-0.1, ":")):
        v = np.full(q.shape, speed)
        ax.plot(q, lines.torque(q, v, np.sign(v)), style, color=MODEL, label=f"{speed:g} rad/s")
    ax.legend(loc="upper right")
    ax.set(title="ripple: one line at 200 cycles/rev", xlabel="position [rad]", ylabel="torque [N m]")

    part = WarmUp(*(np.array([x]) for x in (0.0, -0.4, 720.0, 1.0, 0.0)))
    t = np.arange(0.0, 3600.0, 10.0)
    power = np.where(t < 2400.0, 1.0, 0.0)[:, None]
    ax = axes[1, 1]
    ax.plot(t / 60.0, 1.0 - 0.4 * part.thermal_state(power, np.full(len(t), 10.0))[:, 0], color=MODEL)
    ax.axvline(40.0, color=GREY, linewidth=0.6)
    ax.set(title="40 min of motion, then rest", xlabel="time [min]", ylabel="viscous friction, relative")
    figure.savefig("friction.svg")


if __name__ == "__main__":
    with look():
        main()
