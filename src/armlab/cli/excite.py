"""``armlab excite``: design and run an excitation trajectory."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import (
    Force,
    Json,
    OptionalOutput,
    as_given,
    as_typed,
    joints_in,
    links_to,
    load_robot,
    require_positive,
)
from armlab.cli.support.output import FIGURES, aligned, check_output, note, print_json, progress, result, save_figure
from armlab.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

    from armlab.identify import PredictedUncertainty, Trajectory
    from armlab.log import Table
    from armlab.robots import Robot

SPEED = 0.6  # fraction of the speed limits
_FOR = "designed for "  # followed by robot and hash, in the source of a motion
_ROUNDING = 1e-6  # rad or m, tolerance at the limits for a saved motion
ROUNDS = 300  # iterations of the search for the most informative motion


@Parameter(name="*")
@dataclass(frozen=True)
class ExcitationOptions:
    """Shape of the motion.

    Attributes:
        seconds: Length of the motion, at least 10 [s].
        f0: Base frequency [Hz]; the motion repeats after 1 / f0.
        harmonics: Number of harmonics: the motion contains frequencies up to harmonics times f0.
        speed: Peak speed as a fraction of the robot's limits, in (0, 1]; default: 0.6, or the setting if it is lower.
        acceleration: Peak acceleration [rad/s^2].
        seed: Seed of the motion.
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
    output: OptionalOutput = None,
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
    """Design an excitation trajectory of a robot; optionally run it and record a log.

    Prints the predicted uncertainty of each parameter group. The motion respects the position, speed and acceleration
    limits in the robot file, but ignores obstacles: view it before you run it.

    Parameters:
        robot: Name in the library, or a robot file.
        output: Write the motion to this CSV file: t, q, qd, qdd at 250 Hz.
        motion: Shape of the motion.
        joint: Design a friction identification motion instead: move only this joint (name, or number from 1) at ten
            constant speeds in both directions.
        saved: Use the motion in this file (written by -o) instead of a new design.
        noise: Standard deviation of the robot's torque signal [N m]; the predicted standard deviations scale with it.
        figure: Save a plot of the motion to this PNG, SVG or PDF file.
        run: Link on which to run the motion: egm://HOST:PORT for a real robot, sim://yumi_left or sim://FILE for a
            simulated one.
        log: Log file of the run; if it exists, -2, -3, ... is appended. Default: excite.mcap in the log folder.
        approach: Duration of the motion to the start [s].
    """
    from armlab.cli.support.settings import load_settings, log_folder

    if output is None and run is None:
        raise ConfigError(
            "Expected an output file (-o motion.csv) or a link on which to run the motion (--run), got neither."
        )
    require_positive("noise", noise, "N m")
    require_positive("approach", approach, "s")
    require_positive("acceleration", motion.acceleration, "rad/s^2")
    for path, endings in ((output, [".csv"]), (figure, FIGURES)):
        if path is not None:
            check_output(path, force, endings, [] if saved is None else [saved])
    arm, asked = load_robot(robot), motion.speed
    speed = min(SPEED, load_settings().settings.speed) if asked is None else asked
    if run is not None:
        _check_masses(arm, links_to(robot, [arm], run)[0])
    with progress("design") as tell:
        if saved is None:
            with as_given():
                trajectory = _design(arm, motion, speed, joint, tell)
        else:
            tell(0, 2, f"reading {saved.name}")
            trajectory = armlab.identify.Trajectory.from_table(_saved(saved, arm, force))
        tell(9, 10, "predicting parameter precision")
        expected = armlab.identify.predicted_uncertainty(trajectory, arm, noise) if joint is None else None
        tell(1, 1, "done")
    if json:
        told = {} if expected is None else _data(expected)
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
        designed = replace(table, source=(*table.source, f"{_FOR}{arm.name} {arm.hash}"))
        note(f"motion: {armlab.log.write(designed, output)}")
    if figure is not None:
        save_figure(armlab.plots.table(table, "q", "qd", "qdd"), figure)
        note(f"figure: {figure}")
    if run is not None:
        (url,) = links_to(robot, [arm], run)
        return _run(robot, arm, trajectory, url, log or log_folder() / "excite.mcap", approach)
    return 0


def _saved(path: Path, robot: Robot, force: bool) -> Table:
    """Return the saved motion; reject a motion designed for or recorded with another robot."""
    from armlab.cli.support.log_input import by_force, check_log
    from armlab.robots.comparison import check_same

    table = armlab.log.read(path)
    check_log(path, robot, force)
    with by_force(force):
        for entry in table.source:
            if entry.startswith(_FOR):
                name, _, digest = entry.removeprefix(_FOR).rpartition(" ")
                advice = "Design a motion for this robot, or add --force to use this motion."
                check_same(robot, f"the motion {path}", name, digest, None, advice)
    return table


def _check_masses(robot: Robot, url: str) -> None:
    """Reject a simulated arm without masses, because it reports no torques."""
    from armlab.sim.arm.truth import no_masses

    if url.startswith("sim:") and (why := no_masses(robot)):
        raise ConfigError(f"Expected a robot with link masses, because the excitation is simulated, but {why}.")


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


def _data(expected: PredictedUncertainty) -> dict[str, Any]:
    rows = zip(expected.names, expected.units, expected.groups, expected.sd, strict=True)
    parameters = [dict(zip(("name", "unit", "group", "sd"), row, strict=True)) for row in rows]
    excitation = expected.excitation
    return {"condition": excitation.condition, "weakest": excitation.weakest, "parameters": parameters}


def _check_positions(robot: Robot, table: Table) -> None:
    """Reject a motion that exceeds the position limits of this arm."""
    import numpy as np

    q = table["q"]
    if q.shape[1:] != (robot.n,):
        raise ConfigError(f"Expected a motion for the {robot.n} joints of {robot.name}, got q of shape {q.shape}.")
    beyond = np.maximum(robot.q_min - q, q - robot.q_max)
    row, i = np.unravel_index(np.argmax(beyond), beyond.shape)
    if beyond[row, i] > _ROUNDING:
        unit = "m" if robot.prismatic[i] else "rad"
        raise ConfigError(
            f"Expected a motion within the limits of {robot.name}, got {q[row, i]:.4g} {unit} at {table.t[row]:.3f} s "
            f"for joint {i + 1} ({robot.joint_names[i]}), limits {robot.q_min[i]:.4g} to {robot.q_max[i]:.4g} "
            f"{unit}. Use a motion for this arm, in SI units."
        )


def _check_speed(robot: Robot, qd: np.ndarray, asked: float | None) -> None:
    """Reject a motion that exceeds the `speed` setting, unless --speed is given."""
    import numpy as np

    from armlab.cli.support.settings import load_settings

    allowed, share = load_settings().settings.speed, float(np.max(np.abs(qd) / robot.qd_max))
    if asked is None and allowed < 1.0 and share > 1.01 * allowed:
        raise ConfigError(
            f"Expected a motion within {allowed:g} of the speed limits (the speed setting), got a motion that reaches "
            f"{share:.2f}. Use a slower motion, or confirm this one with --speed 1."
        )


def _run(typed: str, robot: Robot, trajectory: Trajectory, url: str, log: Path, approach: float) -> int:
    """Run the motion over a link and record it; return the exit code."""
    with progress("excite") as tell, armlab.bridge.connect(url, robot) as link:
        done = link.run(trajectory.controller(approach), approach + trajectory.seconds, record=log, progress=tell)
    note(done.report())
    if done.statistics["problems"]:
        note(f"log: {done.path}")
        return FAILED
    words = ["armlab", "identify", *as_typed(typed), str(done.path), "-o", "model.toml", "--report", "model.html"]
    note(f"log: {done.path}; next: {shlex.join(words)}")
    return 0
