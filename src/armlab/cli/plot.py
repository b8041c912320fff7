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

_COMMANDS = {  # by group: each command and the words of its example
    "Logs": {
        plot_logs.table: "press.mcap q tau",
        plot_logs.poses: "press.mcap --robot yumi_right",
        plot_logs.scene: "press.mcap --robot yumi_right --frames 0.1",
        plot_logs.latency: "run.mcap -o latency.svg",
    },
    "Models of torque": {
        plot_models.torque_fit: "model.toml excite.mcap",
        plot_models.friction: "model.toml",
        plot_models.friction_map: "model.toml excite.mcap --joint 3",
        plot_models.spectrum: "model.toml excite.mcap",
        plot_models.velocity_covariance: "model.toml",
        plot_models.residual_speed: "model.toml excite.mcap",
        plot_models.autocorrelation: "model.toml excite.mcap",
    },
    "Contact force": {
        plot_logs.wrench: "press.mcap --start 10 --end 40",
        plot_logs.wrenches: "left.mcap right.mcap",
        plot_logs.observability: "press.mcap",
        plot_models.coverage: "press.mcap --model model.toml",
        plot_models.hypotheses: "model.toml press.mcap",
    },
    "Any fit": {plot_models.calibration: "camera.toml", plot_models.excitation: "camera.toml"},
    "Robots": {
        plot_robots.robot: "irb2400",
        plot_robots.workspace: "irb2400",
        plot_robots.manipulability: "irb2400",
    },
    "Movement primitives": {
        plot_motions.dmp: "motion.toml",
        plot_motions.dmp_phase: "motion.toml",
        plot_motions.two_dof: "motion.toml run.mcap",
    },
}

for _number, (_title, _commands) in enumerate(_COMMANDS.items()):
    _group = Group(_title, sort_key=_number)
    for _command, _words in _commands.items():
        _name = _command.__name__
        plot.command(_command, name=_name, group=_group, help_epilogue=f"Example: armlab plot {_name} {_words}")
