"""``armlab dmp``: fit movement primitives to logs, and play them on a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Columns, Force, Json, OptionalOutput, Output, links_to, load_robot
from armlab.cli.support.output import check_output, note, print_json, progress, result
from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.bridge import Limits
    from armlab.cli.dmp.playing import PlannedMotion
    from armlab.robots import Robot

__all__ = []

dmp: App = App(name="dmp", help="Fit movement primitives to logs, and play them on a robot.")


@dmp.command(help_epilogue="Example: armlab dmp fit taught.mcap -o motion.toml")
def fit(
    *logs: Path,
    output: Output,
    kind: str = "joints",
    column: list[str] | None = None,
    columns: Columns = None,
    robot: str | None = None,
    start: float | None = None,
    end: float | None = None,
    whole: bool = False,
    period: float | None = None,
    frame: str | None = None,
    basis: int | None = None,
    schedule: str | None = None,
    scaling: str | None = None,
    convention: str | None = None,
    json: Json = False,
    force: Force = False,
) -> int:
    """Fit a movement primitive to one or more demonstrations in logs, and save it.

    Stationary samples before and after the motion are skipped. Prints the RMS error between the primitive and the
    demonstrations.

    Parameters:
        logs: One log per demonstration: MCAP, CSV, MAT or Parquet. The kinds pose and periodic need one log, and promp
            needs at least two logs.
        output: Output file, .toml.
        kind: joints; pose (of the tool); periodic (rhythmic motion); promp (distribution over several demonstrations).
        column: Columns that form the motion; default: q, or T_base_tool with pose.
        robot: Library name or robot file, to compute the poses from q (with pose), and to order the joints of a bag
            not recorded by armlab.
        start: Start of the motion in the log [s].
        end: End of the motion in the log [s].
        whole: Keep the stationary samples before and after the motion.
        period: With periodic: duration of one period [s].
        frame: With pose: axes of the forcing term, base or goal; default: base.
        basis: Number of kernels; default: 50, 25 for periodic, 15 for promp.
        schedule: Phase: canonical, time, or position (for monotonic joint motion); default: canonical.
        scaling: Scaling of the motion with its goal: goal, none, amplitude or rotate; default: goal.
        convention: lund or ijspeert; default: lund.
    """
    from armlab.cli.dmp.teaching import MotionWindow, check_options, numbers_of, read_demonstration, taught, text_of

    given = {"basis": basis, "schedule": schedule, "scaling": scaling, "convention": convention}
    options = check_options(kind, given | {"frame": frame, "robot": robot, "period": period})
    if not logs:
        raise ConfigError("Expected the log of a motion, got no file. Pass at least one log.")
    check_output(output, force, [".toml"])
    window = MotionWindow(start, end, whole)
    demos = [read_demonstration(path, kind, column or (), robot, window, columns, force) for path in logs]
    found = taught(kind, demos, options)
    if json:
        print_json(numbers_of(kind, found, len(demos)))
    else:
        result(text_of(kind, found, len(demos)))
    note(f"primitive: {found.save(output, list(dict.fromkeys(source for demo in demos for source in demo.sources)))}")
    return 0


@dmp.command(help_epilogue="Example: armlab dmp play motion.toml --robot yumi_left --speed 0.3")
def play(
    primitive: Path,
    *,
    robot: str | None = None,
    link: str | None = None,
    output: OptionalOutput = None,
    duration: float | None = None,
    start: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    goal: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    via: list[str] | None = None,
    amplitude: float | None = None,
    turns: float | None = None,
    speed: float | None = None,
    firm: bool = False,
    log: Path | None = None,
    json: Json = False,
    force: bool = False,
) -> int:
    """Play a movement primitive on a robot (--robot), or write it to a file (--output).

    On a robot, the command moves to the start, runs the motion, records a log, and prints the distance from the goal. A
    joint motion waits while the arm is held, and continues after release. A motion that exceeds the robot's speed
    limits is slowed down.

    Parameters:
        primitive: File written by `armlab dmp fit`, or another saved primitive.
        robot: Library name or robot file.
        link: egm://HOST:PORT for a real robot; default: a simulated robot.
        output: Write the motion to this file instead of moving the robot: .csv, or .mcap with --robot (which applies
            the robot's limits).
        duration: Duration of the motion, or of one period [s]; default: duration of the demonstration.
        start: Start of the motion, comma-separated: joint positions [rad or m], or position [m] and quaternion
            w,x,y,z of the tool.
        goal: Goal, in the same form as the start; for a periodic motion, its baseline.
        via: Via-point TIME:Y,Y,... of a joint motion, where TIME is a time in the demonstration [s].
        amplitude: Amplitude factor of a periodic motion.
        turns: Number of periods of a periodic motion; default: 4.
        speed: Fraction of the robot's speed limits, in (0, 1]; default: from the settings, else 1.
        firm: Do not wait for a held arm; send the path open-loop.
        log: Log file of the motion; if it exists, -2, -3, ... is appended. Default: dmp.mcap in the log folder.
        force: Replace an existing --output file, and allow a joint-space primitive taught on another robot.
    """
    from armlab.cli.dmp.playing import numbers_in, rehearsed, resolved, rolled_out
    from armlab.cli.support.settings import log_folder

    given = {"duration": duration, "amplitude": amplitude, "turns": turns, "via": via or None}
    given |= {"start": numbers_in(start, "start"), "goal": numbers_in(goal, "goal")}
    if output is None:
        if robot is None:
            raise ConfigError(
                "Expected --robot NAME to move a robot, or --output FILE to write the motion, got neither."
            )
        plan = _plan(primitive, given, robot, speed, firm, force)
        return _move(*plan, links_to(robot, plan[:1], link), log or log_folder() / "dmp.mcap", json)
    check_output(output, force, [".csv", ".mcap"])
    if robot is None:
        arm, table = None, rolled_out(*resolved(armlab.models.load(primitive), given))
    else:
        arm, motion, _ = _plan(primitive, given, robot, speed, firm, force)
        table = rehearsed(motion)
    note(f"motion: {armlab.log.write(table, output, arm)}")
    if json:
        print_json({"seconds": float(table.t[-1]), "samples": len(table), "columns": list(table.names)})
    return 0


def _plan(
    primitive: Path, given: dict[str, Any], robot: str, speed: float | None, firm: bool, force: bool
) -> tuple[Robot, PlannedMotion, Limits]:
    """Return the robot, its motion within the limits, and the limits."""
    from armlab.cli.dmp.playing import motion_of, resolved
    from armlab.cli.support.log_input import check_taught
    from armlab.cli.support.settings import load_settings

    arm = load_robot(robot)
    check_taught(primitive, arm, force)
    limits = armlab.bridge.Limits.of(arm, speed=load_settings().settings.speed if speed is None else speed)
    return arm, motion_of(*resolved(armlab.models.load(primitive), given), arm, limits, firm), limits


def _move(robot: Robot, motion: PlannedMotion, limits: Limits, links: list[str], log: Path, json: bool) -> int:
    """Move to the start, run the motion, and print the distance from the goal."""
    from armlab.cli.dmp.playing import SETTLES, Walk, report_motion

    controller, seconds = motion.controller, motion.seconds
    with armlab.bridge.connect(links, robot) as end, progress("motion") as tell:
        end.run(Walk(motion.q_start, limits.qd_max), limits=limits)
        whole = seconds + SETTLES
        done = end.run(controller, whole, limits=limits, record=log, extra=controller.columns(), progress=tell)
    report_motion(robot, controller, seconds, done, json)
    return FAILED if controller.reason or done.statistics["problems"] else 0
