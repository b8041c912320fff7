"""``armlab run``: run your controller from a file. ``armlab play``: run a joint trajectory, or replay a log."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

import armlab
from armlab.cli import FAILED
from armlab.cli.support.options import Columns, Force, Json, as_given, links_to, load_robot
from armlab.cli.support.output import Narrator, check_output, note, progress, result
from armlab.errors import ConfigError, ControllerFailed

if TYPE_CHECKING:
    from armlab.bridge import Link, Run
    from armlab.motion import JointTrajectory
    from armlab.robots import Robot

_NAME = "controller"


def run(
    robot: str,
    controller: str | None = None,
    *,
    link: str | None = None,
    log: str | None = None,
    no_log: bool = False,
    seconds: float | None = None,
    speed: float | None = None,
    wait: Literal["ahead", "block", "spin"] | None = None,
    interactive: Annotated[bool, Parameter(alias="-i")] = False,
) -> int:
    """Run a controller from a file on a robot, record a log, and print a report.

    The file defines a function State -> Command; returning None holds the position. A dictionary `extra` in the file
    declares the columns of Command.record. After --seconds, on Command.stop(), or on Ctrl-C, the arm is brought to rest
    and the run ends.

    Parameters:
        robot: Library name or robot file; yumi_left+yumi_right for two arms.
        controller: FILE.py:NAME; FILE.py alone selects the function `controller`. Default: hold position.
        link: egm://HOST:PORT for a real robot, where HOST is an address of this computer; for two arms, give two links
            separated by a comma. Default: a simulated robot.
        log: Prefix of the log name, to which the time is appended; or a folder, in which case the prefix is the robot's
            name. Default: the log folder of the settings.
        no_log: Record nothing.
        seconds: Stop after this much time under guidance, measured by the robot's clock [s].
        speed: Fraction of the robot's speed and acceleration limits, in (0, 1]; default: from the settings, else 1.
        wait: Method of waiting for packets: ahead (default, or from the settings), block, or spin (busy waiting on one
            core).
        interactive: Open a Python prompt after the run, with `log` (the table), `run` and `robot`.
    """
    from armlab.cli.support.settings import load_settings

    arms = [load_robot(name) for name in robot.split("+")]
    step, extra = (_hold, None) if controller is None else load_controller(controller)
    urls = links_to(robot, arms, link)
    base = _base(log, no_log, robot)
    known = load_settings().settings
    share = known.speed if speed is None else speed
    limits = [armlab.bridge.Limits.of(arm, speed=share) for arm in arms]
    if not all(url.startswith("sim:") for url in urls):
        note(CHECKS)
    with armlab.bridge.connect(urls, arms) as end:
        options: dict[str, Any] = {"wait": wait or known.wait, "limits": limits, "extra": extra, "feeds": [Narrator()]}
        file = None if controller is None else _file_and_name(controller)[0]
        options["attachments"] = {} if file is None else {file.name: file.read_bytes()}
        try:
            done = end.run(step, seconds, record=base, **options)
        except KeyboardInterrupt:
            if end.last is not None:
                result(end.last.report())
            raise
        except ControllerFailed as error:
            note(_raised_at(error))
            raise
        finally:
            for path in _files(end):
                note(f"log: {path}; show it with armlab log show {path}")
    result(done.report())
    if interactive:
        _prompt(done, end)
    return FAILED if done.statistics["problems"] else 0


CHECKS = """A real arm will move now: keep clear, keep a hand on the emergency stop, and start slowly (--speed 0.1).
Follow this order: select automatic mode (or manual mode with the enabling device), switch the motors on, start RAPID
from main, and start this program."""


def load_controller(place: str) -> tuple[Callable[..., Any], Mapping[str, Any] | None]:
    """Return the controller in a file, and the columns that the file declares as `extra`, or None."""
    from importlib.util import module_from_spec, spec_from_file_location

    path, name = _file_and_name(place)
    if path.suffix != ".py":
        raise ConfigError(f"Expected a controller as FILE.py:NAME, got {place!r}. Use a file name that ends in .py.")
    if not path.is_file():
        raise ConfigError(f"Expected a controller as FILE.py:NAME, got {place!r}, but there is no file {path}.")
    spec = spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"Expected a Python file, got {path}. Rename the file so that its name ends in .py.")
    module = module_from_spec(spec)
    sys.path.insert(0, str(path.parent.resolve()))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"Expected {path} to load, but it raised {type(error).__name__}: {error}.") from error
    finally:
        sys.path.pop(0)
    found = getattr(module, name, None)
    if not callable(found):
        got = f"got {found!r}" if hasattr(module, name) else "but the name does not exist"
        named = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise ConfigError(
            f"Expected a function {name!r} in {path}, {got}. The file defines {', '.join(named) or 'no function'}. "
            "Select a function with FILE.py:NAME."
        )
    return found, getattr(module, "extra", None)


def _file_and_name(place: str) -> tuple[Path, str]:
    """Return the file and the name of the function in ``FILE.py:NAME`` or ``FILE.py``."""
    file, _, name = place.partition(".py:")
    return Path(f"{file}.py" if name else place), name or _NAME


def _raised_at(error: Exception) -> str:
    """Return the lines of the user's files in the traceback of a controller's error, innermost last."""
    from traceback import extract_tb

    own = Path(__file__).parents[1]
    frames = extract_tb(error.__cause__.__traceback__ if error.__cause__ else None)
    places = [one for one in frames if not Path(one.filename).is_relative_to(own)]
    return "\n".join(f"{one.filename}, line {one.lineno}: {one.line}" for one in places)


def _hold(state: object) -> None:
    """Hold the position."""


def _base(log: str | None, no_log: bool, robot: str) -> Path | None:
    """Return the path of the log, which includes the time; None with --no-log."""
    from armlab.cli.support.settings import log_folder

    if no_log:
        if log is not None:
            raise ConfigError(f"Expected either --log or --no-log, got both (--log {log}). Omit one.")
        return None
    name = Path(robot).stem
    if log is not None and (log.endswith(os.sep) or Path(log).is_dir()):
        start = str(Path(log) / name)
    else:
        start = str(log_folder() / name if log is None else log).removesuffix(".mcap")
    path = Path(f"{start}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}.mcap")
    check_output(path, force=True, endings=[".mcap"])  # a second run in the same second gets the suffix -2
    return path


def _files(link: Link) -> list[Path]:
    """Return the log paths of the last run."""
    last = link.last
    runs = () if last is None else last.arms or (last,)
    return [one.path for one in runs if one.path is not None and one.path.exists()]


def _prompt(done: Run, link: Link) -> None:
    import code

    import numpy as np

    names = {"run": done, "log": done.table, "robot": link.robot, "np": np}
    code.interact("Available: log (table), run (report), robot, np. Press Ctrl-D to exit.", local=names, exitmsg="")


_REST = 1e-3  # rad/s or m/s, largest speed of the last row
_LONGEST = 3.0  # s, timeout for reaching the goal after the last point


def play(
    file: Path,
    robot: str,
    *,
    link: str | None = None,
    speed: float | None = None,
    columns: Columns = None,
    log: Path | None = None,
    json: Json = False,
    force: Force = False,
) -> int:
    """Run a joint trajectory on a robot, or replay the motion in a log.

    Moves the robot to the start at moderate speed, runs the trajectory, records a log, and prints the distance from the
    goal. The path between points is linear if the file contains only positions, cubic if it also contains velocities,
    and quintic if it also contains accelerations. A trajectory outside the limits is rejected. To replay at another
    speed, fit a primitive: armlab dmp fit.

    Parameters:
        file: A trajectory_msgs/JointTrajectory or a FollowJointTrajectory goal in JSON; or a log or CSV file. Replays
            the column q_sent if present, otherwise q, qd and qdd.
        robot: Library name or robot file.
        link: egm://HOST:PORT for a real robot; default: a simulated robot.
        speed: Allowed fraction of the robot's speed limits, in (0, 1]; default: from the settings, else 1.
        log: Log file of the motion; if it exists, -2, -3, ... is appended. Default: play.mcap in the log folder.
        force: Allow the replay of another robot's log.
    """
    from armlab.cli.dmp.playing import Walk, report_motion
    from armlab.cli.support.settings import load_settings, log_folder

    arm = load_robot(robot)
    limits = armlab.bridge.Limits.of(arm, speed=load_settings().settings.speed if speed is None else speed)
    with as_given():
        trajectory = read_motion(file, arm, columns, force)
        controller = trajectory.controller(arm, limits=limits)
    urls = links_to(robot, [arm], link)
    if not all(url.startswith("sim:") for url in urls):
        note(CHECKS)
    with armlab.bridge.connect(urls, arm) as end, progress("trajectory") as tell:
        end.run(Walk(trajectory.ordered(arm.ros_joint_names).q[0], limits.qd_max), limits=limits)
        whole = trajectory.duration + _LONGEST
        done = end.run(controller, whole, limits=limits, record=log or log_folder() / "play.mcap", progress=tell)
    report_motion(arm, controller, trajectory.duration, done, json)
    return 0 if controller.done and not done.statistics["problems"] else FAILED


def read_motion(file: Path, robot: Robot, columns: str | None, force: bool) -> JointTrajectory:
    """Return the trajectory stored in a file, as a JSON message or a table."""
    import numpy as np

    from armlab.motion import JointTrajectory

    if file.suffix == ".json":
        return _message(file)
    table = armlab.log.read_arm(file, robot, force=force, columns=columns, needed=("q",))
    names = ["q_sent", "qd_sent"] if "q_sent" in table.names else ["q", "qd", "qdd"]
    names = [name for name in names if name in table.names]
    table = table.dropna(*names)
    if len(table) < 2:
        raise ConfigError(f"Expected a motion in {file}, got {len(table)} rows with {', '.join(names)}.")
    if len(names) > 1 and np.abs(table[names[1]][-1]).max() > _REST:
        note(f"{', '.join(names[1:])}: ignored, because the last row is not at rest")
        names = names[:1]
    q, qd, qdd = [*(np.asarray(table[name]) for name in names), None, None][:3]
    return JointTrajectory(table.t - table.t[0], q, qd, qdd)


def _message(file: Path) -> JointTrajectory:
    import msgspec

    from armlab.bridge.servers.ros.actions import read_trajectory
    from armlab.errors import CommandRefused, UnknownName

    try:
        message = msgspec.json.decode(file.read_bytes())
        message = message if isinstance(message, dict) else {}
        unused = [name for name in message if "tolerance" in name and message[name]]
        if unused:
            note(f"{', '.join(unused)}: ignored; the defaults of armlab play apply")
        return read_trajectory(message.get("trajectory", message))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"Expected JSON in {file}, got {str(error).rstrip('.')}.") from None
    except (CommandRefused, UnknownName) as error:
        raise ConfigError(f"Expected a joint trajectory in {file}, but it is invalid: {error}") from None
