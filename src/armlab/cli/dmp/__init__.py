"""``armlab dmp``: movement primitives from logs, and played on a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Force, Json, links_to
from armlab.cli.support.output import check_output, note, print_json, progress, result
from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.bridge import Limits
    from armlab.cli.dmp.playing import PlannedMotion
    from armlab.robots import Robot

__all__ = []


dmp = App(name="dmp", help="Movement primitives: fit one to logs of a motion, play it on a robot.")


@dmp.command(help_epilogue="Example: armlab dmp fit taught.mcap -o motion.toml")
def fit(
    *logs: Path,
    output: Annotated[Path, Parameter(alias="-o")],
    kind: str = "joints",
    column: list[str] | None = None,
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
    """Fit a movement primitive to the motion in a log, or to several demonstrations of it, and save it.

    Rest before and after the motion is left out. Prints how far the motion of the primitive is from what was shown.

    Parameters:
        logs: One log per demonstration: MCAP, CSV, MAT or Parquet; one for pose and periodic, two or more for promp.
        output: File of the primitive, .toml.
        kind: joints; pose: of the tool; periodic: a motion that repeats itself; promp: a distribution over several
            demonstrations.
        column: What moves: q when not given, for pose T_base_tool; several are put side by side.
        robot: Name in the library or robot file: with pose, whose kinematics make poses of q; with a bag of another
            program, whose joints are read.
        start: Only from this time of the log on [s].
        end: Only up to this time [s].
        whole: Keep rest before and after the motion.
        period: With periodic: duration of one turn [s].
        frame: With pose: axes that the motion belongs to, base or goal, with which it turns; base when not given.
        basis: Number of kernels: 50 when not given, 25 for periodic, 15 for promp.
        schedule: Phase: canonical, time, or position for joints that never turn; canonical when not given.
        scaling: Of the motion with its goal: goal, none, amplitude or rotate; goal when not given.
        convention: lund or ijspeert; lund when not given.
    """
    from armlab.cli.dmp.teaching import MotionWindow, check_options, numbers_of, read_demonstration, taught, text_of

    given = {"basis": basis, "schedule": schedule, "scaling": scaling, "convention": convention}
    options = check_options(kind, given | {"frame": frame, "robot": robot, "period": period})
    if not logs:
        raise ConfigError("Expected the log of a motion, got none. Name one or several files.")
    check_output(output, force, [".toml"])
    window = MotionWindow(start, end, whole)
    demos = [read_demonstration(path, kind, column or (), robot, window) for path in logs]
    found = taught(kind, demos, options)
    if json:
        print_json(numbers_of(kind, found, len(demos)))
    else:
        result(text_of(kind, found, len(demos)))
    note(f"primitive: {found.save(output, [source for demo in demos for source in demo.sources])}")
    return 0


@dmp.command(help_epilogue="Example: armlab dmp play motion.toml --robot yumi_left --speed 0.3")
def play(
    primitive: Path,
    *,
    robot: str | None = None,
    link: str | None = None,
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
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
    """Play a movement primitive: on a robot, with --robot, or into a file, with --output.

    On a robot: walks to the start, runs it, records a log, and says how near the goal it came. A motion of joints waits
    for an arm that is held up, and goes on when it is released. One too fast for the limits of the robot is stretched.

    Parameters:
        primitive: File of `armlab dmp fit`, or of any primitive that was saved.
        robot: Name in the library, or a robot file.
        link: egm://HOST:PORT for a robot; the simulated robot when not given.
        output: Write the motion to this file instead, .csv, or .mcap with --robot; nothing moves. With --robot it holds
            joints within the limits of the robot.
        duration: Of the motion, or of a turn of a periodic one [s]; that of the demonstration when not given.
        start: Where it begins, numbers with commas between: joint positions [rad or m], or position and quaternion
            w,x,y,z of the tool.
        goal: Where it ends, likewise; of a periodic motion the middle.
        via: TIME:Y,Y,... that a motion of joints passes, in the time of the demonstration [s].
        amplitude: Of a periodic motion, over that of the demonstration.
        turns: Of a periodic motion; 4 when not given.
        speed: Share of the robot's speed limits that is allowed, in (0, 1]; that of the settings, 1 without.
        firm: Tell the arm the path whatever it does, instead of waiting for an arm that is held up.
        log: Recording of the motion; -2, -3 is added to a name that exists. dmp.mcap in the folder of the settings when
            not given.
        force: Replace an existing file of --output.
    """
    from armlab.cli.dmp.playing import numbers_in, rehearsed, resolved, rolled_out
    from armlab.cli.support.settings import log_folder

    given = {"duration": duration, "amplitude": amplitude, "turns": turns, "via": via or None}
    given |= {"start": numbers_in(start, "start"), "goal": numbers_in(goal, "goal")}
    if output is None:
        if robot is None:
            raise ConfigError("Expected --robot NAME to move, or --output FILE to write the motion to, got neither.")
        plan = _plan(primitive, given, robot, speed, firm)
        return _move(*plan, links_to(robot, plan[:1], link), log or log_folder() / "dmp.mcap", json)
    check_output(output, force, [".csv", ".mcap"])
    if robot is None:
        arm, table = None, rolled_out(*resolved(armlab.models.load(primitive), given))
    else:
        arm, motion, _ = _plan(primitive, given, robot, speed, firm)
        table = rehearsed(motion)
    note(f"motion: {armlab.log.write(table, output, arm)}")
    if json:
        print_json({"seconds": float(table.t[-1]), "samples": len(table), "columns": list(table.names)})
    return 0


def _plan(
    primitive: Path, given: dict[str, Any], robot: str, speed: float | None, firm: bool
) -> tuple[Robot, PlannedMotion, Limits]:
    """Return the robot, its motion within the limits, and these."""
    from armlab.cli.dmp.playing import motion_of, resolved
    from armlab.cli.support.settings import load_settings

    arm = armlab.robots.load(robot)
    limits = armlab.bridge.Limits.of(arm, speed=load_settings().settings.speed if speed is None else speed)
    return arm, motion_of(*resolved(armlab.models.load(primitive), given), arm, limits, firm), limits


def _move(robot: Robot, motion: PlannedMotion, limits: Limits, links: list[str], log: Path, json: bool) -> int:
    """Walk to the start, run the motion, and say how near the goal it came."""
    from armlab.cli.dmp.playing import SETTLES, Walk, distance

    controller, seconds = motion.controller, motion.seconds
    with armlab.bridge.connect(links, robot) as end, progress("motion") as tell:
        end.run(Walk(motion.q_start, limits.qd_max), limits=limits)
        whole = seconds + SETTLES
        done = end.run(controller, whole, limits=limits, record=log, extra=controller.columns(), progress=tell)
    off = distance(robot, done.table["q"][-1], controller.goal)
    reason = "arrived" if controller.done else controller.reason or done.reason
    if json:
        print_json({"seconds": seconds, "goal_error": max(off.values()), "reason": reason, "log": str(done.path)})
    else:
        apart = " and ".join(f"{value:.2g} {unit}" for unit, value in off.items())
        result(f"{seconds:.2f} s of motion, ended {apart} from the goal: {reason}")
    problems = done.statistics["problems"]
    for problem in problems:
        note(problem)
    note(f"log: {done.path}")
    return FAILED if controller.reason or problems else 0
