"""``armlab excite``: design an excitation trajectory and run it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Force, Json, as_given, joints_in, links_to, require_positive
from armlab.cli.support.output import FIGURES, aligned, check_output, note, print_json, progress, result, save_figure
from armlab.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

    from armlab.identify import PredictedUncertainty, Trajectory
    from armlab.log import Table
    from armlab.robots import Robot

SPEED = 0.6  # of the limits
_ROUNDING = 1e-6  # rad or m that a saved motion may be beyond the limits
ROUNDS = 300  # of the search for the motion that tells most


@Parameter(name="*")
@dataclass(frozen=True)
class ExcitationOptions:
    """Shape of the motion.

    Attributes:
        seconds: Length of the motion, at least 10 [s].
        f0: Base frequency [Hz]; the motion repeats after 1 / f0.
        harmonics: Number of them: the motion holds frequencies up to harmonics times f0.
        speed: Peak speed as a share of the robot's limits, in (0, 1]; 0.6, or the setting where that is less, when not
            given.
        acceleration: Peak acceleration [rad/s^2].
        seed: Another motion for each.
    """

    seconds: float = 60.0
    f0: float = 0.1
    harmonics: int = 8
    speed: float | None = None
    acceleration: float = 15.0
    seed: int = 0


def excite(
    robot: str,
    *,
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
    motion: ExcitationOptions = ExcitationOptions(),
    joint: str | None = None,
    saved: Path | None = None,
    noise: float = 0.1,
    figure: Path | None = None,
    run: str | None = None,
    log: Path | None = None,
    approach: float = 4.0,
    json: Json = False,
    force: Force = False,
) -> int:
    """Design an excitation trajectory of a robot; run it and record a log if asked.

    Prints the predicted uncertainty of each group of parameters. The motion stays within the limits of position,
    speed and acceleration of the robot file; it knows nothing of obstacles: look at it before you run it.

    Parameters:
        robot: Name in the library, or a robot file.
        output: Write the motion to this CSV file: t, q, qd, qdd at 250 Hz.
        motion: What it shall be like.
        joint: Instead, move this joint alone, by name or number from 1: ten constant speeds, both ways, to see its
            friction.
        saved: Take the motion of this file, as -o writes it, instead of designing one.
        noise: Standard deviation of the robot's torque signal [N m]; the printed deviations are in proportion to it.
        figure: Draw the motion into this PNG, SVG or PDF.
        run: Link to run it on: egm://HOST:PORT for a robot, sim://yumi_left, or sim://FILE, for a simulated one.
        log: Recording of the run; -2, -3 is added to a name that exists. excite.mcap in the folder of the settings when
            not given.
        approach: Seconds of the walk from where the arm stands to the start.
    """
    from armlab.cli.support.settings import load_settings, log_folder

    if output is None and run is None:
        raise ConfigError("Expected a file for the motion (-o motion.csv) or a link to run it on (--run), got neither.")
    require_positive("noise", noise, "N m")
    require_positive("approach", approach, "s")
    require_positive("acceleration", motion.acceleration, "rad/s^2")
    for path, endings in ((output, [".csv"]), (figure, FIGURES)):
        if path is not None:
            check_output(path, force, endings, [] if saved is None else [saved])
    arm, asked = armlab.robots.load(robot), motion.speed
    speed = min(SPEED, load_settings().settings.speed) if asked is None else asked
    if run is not None:
        links_to(robot, [arm], run)
    with progress("design") as tell:
        if saved is None:
            with as_given():
                trajectory = _design(arm, motion, speed, joint, tell)
        else:
            tell(0, 2, f"reading {saved.name}")
            trajectory = armlab.identify.Trajectory.from_table(armlab.log.read(saved))
        tell(9, 10, "predicting parameter precision")
        expected = armlab.identify.predicted_uncertainty(trajectory, arm, noise) if joint is None else None
        tell(1, 1, "done")
    if json:
        told = {} if expected is None else _plain(expected)
        print_json({"robot": arm.name, **vars(motion), "speed": speed, "seconds": trajectory.seconds, **told})
    elif expected is None:
        result(f"{trajectory.seconds:.1f} s of motion")
    else:
        result(f"{aligned(expected.rows(), right=(2, 3, 4))}\n{expected.excitation.text()}")
    table = trajectory.table()
    if run is not None:
        _check_positions(arm, table)
        _check_speed(arm, table["qd"], asked)
    if output is not None:
        note(f"motion: {armlab.log.write(table, output)}")
    if figure is not None:
        save_figure(armlab.plots.table(table, "q", "qd", "qdd"), figure)
        note(f"figure: {figure}")
    if run is not None:
        return _run(arm, trajectory, run, log or log_folder() / "excite.mcap", approach)
    return 0


def _design(
    robot: Robot, motion: ExcitationOptions, speed: float, joint: str | None, tell: Callable[[float, float, str], None]
) -> Trajectory:
    if joint is not None:
        return armlab.identify.friction_run(robot, joints_in(joint, robot.n)[0] if joint.isdecimal() else joint)
    shape = motion.seconds, motion.f0, motion.harmonics, speed, motion.acceleration
    return armlab.identify.design_excitation(
        robot,
        *shape,
        seed=motion.seed,
        rounds=ROUNDS,
        progress=lambda done, total, what: tell(0.9 * done, total, what) if done < total else None,
    )


def _plain(expected: PredictedUncertainty) -> dict[str, Any]:
    parameters = zip(expected.names, expected.units, expected.groups, expected.sd, strict=True)
    keys = ("name", "unit", "group", "sd")
    found = {"condition": expected.excitation.condition, "weakest": expected.excitation.weakest}
    return {**found, "parameters": [dict(zip(keys, values, strict=True)) for values in parameters]}


def _check_positions(robot: Robot, table: Table) -> None:
    """Refuse a motion that the limits of position would bend: it comes from a file that may be of another arm."""
    import numpy as np

    q = table["q"]
    if q.shape[1:] != (robot.n,):
        raise ConfigError(f"Expected a motion of the {robot.n} joints of {robot.name}, got q of shape {q.shape}.")
    beyond = np.maximum(robot.q_min - q, q - robot.q_max)
    row, i = np.unravel_index(np.argmax(beyond), beyond.shape)
    if beyond[row, i] > _ROUNDING:
        unit = "m" if robot.prismatic[i] else "rad"
        raise ConfigError(
            f"Expected a motion within the limits of {robot.name}, got {q[row, i]:.4g} {unit} at {table.t[row]:.3f} s "
            f"for joint {i + 1} ({robot.joint_names[i]}), which has {robot.q_min[i]:.4g} to {robot.q_max[i]:.4g} "
            f"{unit}. Take a motion of this arm, in SI units."
        )


def _check_speed(robot: Robot, qd: np.ndarray, asked: float | None) -> None:
    """Refuse a motion that is faster than the settings allow and was not asked for: a limit would bend it."""
    import numpy as np

    from armlab.cli.support.settings import load_settings

    allowed, share = load_settings().settings.speed, float(np.max(np.abs(qd) / robot.qd_max))
    if asked is None and allowed < 1.0 and share > 1.01 * allowed:
        raise ConfigError(
            f"Expected a motion within {allowed:g} of the limits of speed, as the setting speed has it, got one that "
            f"reaches {share:.2f}. Take a slower one, or say with --speed 1 that this one is meant."
        )


def _run(robot: Robot, trajectory: Trajectory, url: str, log: Path, approach: float) -> int:
    """Run the motion over a link and record it; return the exit code."""
    with progress("excite") as tell, armlab.bridge.connect(url, robot) as link:
        done = link.run(trajectory.controller(approach), approach + trajectory.seconds, record=log, progress=tell)
    note(done.report())
    if done.statistics["problems"]:
        note(f"log: {done.path}")
        return FAILED
    note(f"log: {done.path}; next: armlab identify {robot.name} {done.path} -o model.toml --report model.html")
    return 0
