"""``armlab plot``: every figure that can be drawn from files."""

from __future__ import annotations

from cyclopts import App, Group

from armlab.cli.plot import logs, models, robots

__all__ = []


plot = App(
    name="plot",
    help="Figures of logs, models, robots and movement primitives; the names are those of armlab.plots.",
    help_epilogue="Example: armlab plot torque_fit model.toml excite.mcap -o fit.svg. Prints the path of the figure.",
)

_COMMANDS = {  # by group: each command and the words of its example
    "Logs": {
        logs.table: "press.mcap q tau",
        logs.poses: "press.mcap --robot yumi_right",
        logs.scene: "press.mcap --robot yumi_right --frames 0.1",
        logs.latency: "run.mcap -o latency.svg",
    },
    "Models of torque": {
        models.torque_fit: "model.toml excite.mcap",
        models.friction: "model.toml",
        models.friction_map: "model.toml excite.mcap --joint 3",
        models.spectrum: "model.toml excite.mcap",
        models.velocity_covariance: "model.toml",
        models.residual_speed: "model.toml excite.mcap",
        models.autocorrelation: "model.toml excite.mcap",
    },
    "Contact force": {
        logs.wrench: "press.mcap --start 10 --end 40",
        logs.wrenches: "left.mcap right.mcap",
        logs.observability: "press.mcap",
        models.coverage: "press.mcap --model model.toml",
        models.hypotheses: "model.toml press.mcap",
    },
    "Any fit": {models.calibration: "camera.toml", models.excitation: "camera.toml"},
    "Robots": {
        robots.robot: "irb2400",
        robots.workspace: "irb2400",
        robots.manipulability: "irb2400",
    },
    "Movement primitives": {
        robots.dmp: "motion.toml",
        robots.dmp_phase: "motion.toml",
        robots.two_dof: "motion.toml run.mcap",
    },
}

for _number, (_title, _commands) in enumerate(_COMMANDS.items()):
    _group = Group(_title, sort_key=_number)
    for _command, _words in _commands.items():
        _name = _command.__name__
        plot.command(_command, name=_name, group=_group, help_epilogue=f"Example: armlab plot {_name} {_words}")
