"""``armlab plot``: draw figures from files."""

from __future__ import annotations

from cyclopts import App, Group

from armlab.cli.plot import figures

__all__ = []

plot: App = App(
    name="plot",
    help="Plot logs, models, robots and movement primitives. Commands are named after the functions in armlab.plots.",
    help_epilogue="Example: armlab plot torque_fit model.toml excite.mcap -o fit.svg. Prints the path of the figure.",
)

_COMMANDS = {  # commands by group, each with the arguments of its example
    "Logs": {
        figures.table: "press.mcap q tau",
        figures.poses: "press.mcap --robot yumi_right",
        figures.scene: "press.mcap --robot yumi_right --frames 0.1",
        figures.latency: "run.mcap -o latency.svg",
    },
    "Torque models": {
        figures.torque_fit: "model.toml excite.mcap",
        figures.friction: "model.toml",
        figures.friction_map: "model.toml excite.mcap --joint 3",
        figures.spectrum: "model.toml excite.mcap",
        figures.velocity_covariance: "model.toml",
        figures.residual_speed: "model.toml excite.mcap",
        figures.autocorrelation: "model.toml excite.mcap",
    },
    "Contact force": {
        figures.wrench: "press.mcap --start 10 --end 40",
        figures.wrenches: "left.mcap right.mcap",
        figures.observability: "press.mcap",
        figures.coverage: "press.mcap --model model.toml",
        figures.hypotheses: "model.toml press.mcap",
    },
    "Fits": {figures.calibration: "camera.toml", figures.excitation: "camera.toml"},
    "Robots": {figures.robot: "irb2400", figures.workspace: "irb2400", figures.manipulability: "irb2400"},
    "Movement primitives": {
        figures.dmp: "motion.toml",
        figures.dmp_phase: "motion.toml",
        figures.two_dof: "motion.toml run.mcap",
    },
}

for _number, (_title, _commands) in enumerate(_COMMANDS.items()):
    _group = Group(_title, sort_key=_number)
    for _command, _words in _commands.items():
        _name = _command.__name__
        plot.command(_command, name=_name, group=_group, help_epilogue=f"Example: armlab plot {_name} {_words}")
