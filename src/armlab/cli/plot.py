"""``armlab plot``: every figure that can be drawn from files."""

from __future__ import annotations

from cyclopts import App, Group

from armlab.cli import plot_logs, plot_models, plot_motions, plot_robots

__all__ = ["plot"]

plot = App(
    name="plot",
    help="Figures of logs, models, robots and movement primitives; the names are those of armlab.plots.",
    help_epilogue="Example: armlab plot torque_fit model.toml excite.mcap -o fit.svg. Prints the path of the figure.",
)

_COMMANDS = {
    "Logs": (plot_logs.table, plot_logs.poses, plot_logs.scene, plot_logs.latency),
    "Models of torque": (
        plot_models.torque_fit, plot_models.friction, plot_models.friction_map, plot_models.spectrum,
        plot_models.velocity_covariance, plot_models.residual_speed, plot_models.autocorrelation,
    ),
    "Contact force": (
        plot_logs.wrench, plot_logs.wrenches, plot_logs.observability, plot_models.coverage, plot_models.hypotheses,
    ),
    "Any fit": (plot_models.calibration, plot_models.excitation),
    "Robots": (plot_robots.robot, plot_robots.workspace, plot_robots.manipulability),
    "Movement primitives": (plot_motions.dmp, plot_motions.dmp_phase, plot_motions.two_dof),
}  # fmt: skip

for _number, (_title, _commands) in enumerate(_COMMANDS.items()):
    _group = Group(_title, sort_key=_number)
    for _command in _commands:
        plot.command(_command, name=_command.__name__, group=_group)
