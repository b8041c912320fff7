"""Gallery figures from one simulated YuMi: excitation, identification and presses."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import PillowWriter

from armlab import contact, identify, kinematics, plots, robots, sim
from armlab.log import Table
from armlab.models.friction import FrictionMap, RadialBasis

# -- made
robot = robots.load("yumi_right")
arm = sim.SimulatedArm(robot, sim.synthetic_truth(robot), seed=1)
excited = sim.record(arm, identify.design_excitation(robot, 20.0))  # q, qd, tau
fit = identify.fit_dynamics(excited, robot)
fit.save("model.toml")  # read by the force control examples


def hand(t: np.ndarray) -> np.ndarray:
    """Return presses of 8 N along x, y, z of the base."""
    starts = [(2.0, 0), (5.0, 1), (8.0, 2)]
    return sum(
        np.outer(np.interp(t, s + np.array([0.0, 0.2, 1.8, 2.0]), [0, 8, 8, 0]), np.eye(6)[i]) for s, i in starts
    )


pressed = contact.Estimator(fit.value, robot).run(sim.record(arm, identify.dither(robot.q_home, 12.0), hand))
free = contact.Estimator(fit.value, robot).run(excited)

# -- table
rng = np.random.default_rng(0)
q, qd = pressed["q"], pressed["qd"]
run = Table(pressed.t, {"q": q, "q_ref": q + 0.01, "q_sent": q + 0.005, "qd": qd, "tau": pressed["tau"]})
run = run.with_column("clamped", (np.abs(qd) > 0.98 * np.abs(qd).max(axis=0)).astype(int))
plots.table(run, "q", "q_ref", "q_sent", "qd", "tau").savefig("gallery_table.png", dpi=110)
# -- latency
ticks = 20_000
receive = 4_000_000 * np.arange(ticks) + rng.exponential(30_000, ticks).astype(int)
loop = {"receive_ns": receive, "step_ns": rng.lognormal(9.5, 0.3, ticks).astype(int)}
loop |= {"send_ns": receive + loop["step_ns"] + rng.lognormal(11, 0.5, ticks).astype(int)}
loop |= {"wake_ns": rng.lognormal(10, 0.4, ticks).astype(int)}
loop |= {"missed": rng.binomial(1, 2e-4, ticks), "late": rng.binomial(1, 1e-4, ticks).astype(bool)}
plots.latency(Table(0.004 * np.arange(ticks), loop)).figure.savefig("gallery_latency.png", dpi=110)
# -- torque_fit
plots.torque_fit(fit, excited).savefig("gallery_torque_fit.png", dpi=110)
# -- friction
plots.friction(fit, free).savefig("gallery_friction.png", dpi=110)
# -- friction_map
low, high, peak = (x[:, None] for x in (*np.stack([robot.q_min, robot.q_max]), np.abs(excited["qd"]).max(axis=0)))
basis = RadialBasis(
    low + (high - low) * np.linspace(0, 1, 6),
    np.repeat((high - low) / 5, 6, axis=1),
    peak * [0.2, 0.6, 1.0],
    peak * [0.4, 0.4, 0.4],
)
k = np.zeros((7, 2, 6, 3))
k[2] = 0.4 * np.array([1, 0.2, -0.5, 0.1, 0.8, 1])[:, None]
mapped = replace(fit.value, friction_map=FrictionMap(basis, k))
plots.friction_map(mapped, 2, excited).savefig("gallery_friction_map.png", dpi=110)
# -- spectrum
plots.spectrum(fit, excited, joints=[0, 1, 2]).savefig("gallery_spectrum.png", dpi=110)
# -- velocity_covariance
plots.velocity_covariance(fit).figure.savefig("gallery_velocity_covariance.png", dpi=110)
# -- autocorrelation
plots.autocorrelation(free).figure.savefig("gallery_autocorrelation.png", dpi=110)
# -- excitation
plots.excitation(fit.excitation).figure.savefig("gallery_excitation.png", dpi=110)
# -- wrench
plots.wrench(pressed).savefig("gallery_wrench.png", dpi=110)
# -- hypotheses
plots.hypotheses(contact.hypotheses(pressed, robot)).figure.savefig("gallery_hypotheses.png", dpi=110)
# -- coverage
plots.coverage(pressed).figure.savefig("gallery_coverage.png", dpi=110)
# -- observability
plots.observability(pressed).savefig("gallery_observability.png", dpi=110)
# -- landing page: a moving picture
swaying = sim.record(arm, identify.dither(robot.q_home, 12.0, amplitude=0.12), hand)
shown = contact.Estimator(fit.value, robot).run(swaying)
t, force = shown.t - shown.t[0], shown["wrench_hat"][:, :3]
band = 2 * np.sqrt(shown["wrench_hat_cov"][:, range(3), range(3)])
figure = plt.figure(figsize=(9.0, 3.6), layout="constrained")
space, curves = figure.add_subplot(1, 2, 1, projection="3d"), figure.add_subplot(1, 2, 2)
writer = PillowWriter(fps=8)
with writer.saving(figure, "landing.webp", dpi=100):
    for row in range(125, len(t), 75):  # every 0.3 s
        space.clear()
        plots.robot(robot, shown["q"][row], ax=space, frames=False)
        tool = kinematics.forward(robot, shown["q"][row])[:3, 3]
        space.quiver(*tool, *(0.04 * force[row]), color="tab:red", linewidth=2.5)
        space.set(xlim=(-0.25, 0.35), ylim=(-0.5, 0.1), zlim=(0.0, 0.6))
        space.set_box_aspect((1, 1, 1), zoom=1.5)
        space.set_axis_off()
        curves.clear()
        for axis, name in enumerate("xyz"):
            (line,) = curves.plot(t[:row], force[:row, axis], label=name)
            low, high = force[:row, axis] - band[:row, axis], force[:row, axis] + band[:row, axis]
            curves.fill_between(t[:row], low, high, color=line.get_color(), alpha=0.25, linewidth=0)
            curves.plot(t[:row], shown["wrench_true"][:row, axis], "--", color="black", linewidth=0.8)
        curves.set(xlim=(0.4, 12), ylim=(-3, 12), xlabel="time [s]", ylabel="estimated force on the tool [N]")
        curves.legend(loc="upper left", ncols=3, frameon=False)
        writer.grab_frame()
# --
plt.close("all")
