"""``armlab run``: run your controller from a file."""

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
from armlab.cli.support.options import links_to
from armlab.cli.support.output import Narrator, check_output, note, result
from armlab.errors import ConfigError, ControllerFailed

if TYPE_CHECKING:
    from armlab.bridge import Link, Run

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
    """Run a controller from a file against a robot, record a log, and report how it went.

    The file needs nothing of armlab's but a function State -> Command; None holds. A dictionary `extra` in the file
    declares the columns of Command.record. The run ends after --seconds, by Command.stop(), or on Ctrl-C; the arm is
    brought to rest first.

    Parameters:
        robot: Name in the library, or a robot file; yumi_left+yumi_right for two arms.
        controller: FILE.py:NAME; FILE.py alone means the function `controller` in it. Without a file the arm holds
            where it is.
        link: egm://HOST:PORT for a robot, where HOST is an address of this computer, separated by commas for two arms;
            the simulated robot when not given.
        log: Beginning of the name of the log, to which the time is added; or a folder, where it is the robot's name. In
            the folder of the settings when not given.
        no_log: Record nothing.
        seconds: Robot time under guidance after which to end [s].
        speed: Share of the robot's speed and acceleration limits that is allowed, in (0, 1]; that of the settings, 1
            without.
        wait: How to wait for packets; as the settings say, ahead without. spin: a core does nothing else.
        interactive: Afterwards, a Python prompt with `log` (the table), `run` and `robot`.
    """
    from armlab.cli.support.settings import load_settings

    arms = [armlab.robots.load(name) for name in robot.split("+")]
    step, extra = (_hold, None) if controller is None else load_controller(controller)
    urls = links_to(robot, arms, link)
    base = _base(log, no_log, robot)
    known = load_settings().settings
    share = known.speed if speed is None else speed
    limits = [armlab.bridge.Limits.of(arm, speed=share) for arm in arms]
    if not all(url.startswith("sim:") for url in urls):
        note(_CHECKS)
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
                note(f"log: {path}; look at it: armlab log show {path}")
    result(done.report())
    if interactive:
        _prompt(done, end)
    return FAILED if done.statistics["problems"] else 0  # as the report says


_CHECKS = """A real arm moves now: nobody in its reach, a hand on the emergency stop, slow at first (--speed 0.1).
In this order: automatic mode or manual with the enabling device; motors on; RAPID from main; then this program."""


def load_controller(place: str) -> tuple[Callable[..., Any], Mapping[str, Any] | None]:
    """Return the controller in a file, and the columns that the file declares as `extra`, None without them."""
    from importlib.util import module_from_spec, spec_from_file_location

    path, name = _file_and_name(place)
    if path.suffix != ".py":
        raise ConfigError(f"Expected a controller as FILE.py:NAME, got {place!r}. Name a file that ends in .py.")
    if not path.is_file():
        raise ConfigError(f"Expected a controller as FILE.py:NAME, got {place!r}, and there is no file {path}.")
    spec = spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"Expected a Python file, got {path}. Give it a name that ends in .py.")
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
        got = f"got {found!r}" if hasattr(module, name) else "but there is no such name in it"
        named = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise ConfigError(
            f"Expected a function {name!r} in {path}, {got}. It has {', '.join(named) or 'no function'}. "
            "Say which: FILE.py:NAME."
        )
    return found, getattr(module, "extra", None)


def _file_and_name(place: str) -> tuple[Path, str]:
    """Return what ``FILE.py:NAME`` or ``FILE.py`` names."""
    file, _, name = place.partition(".py:")
    return Path(f"{file}.py" if name else place), name or _NAME


def _raised_at(error: Exception) -> str:
    """Return the lines of the user's own files that led to what a controller raised, the last one last."""
    from traceback import extract_tb

    own = Path(__file__).parents[1]
    frames = extract_tb(error.__cause__.__traceback__ if error.__cause__ else None)
    places = [one for one in frames if not Path(one.filename).is_relative_to(own)]
    return "\n".join(f"{one.filename}, line {one.lineno}: {one.line}" for one in places)


def _hold(state: object) -> None:
    """Hold where the arm is."""


def _base(log: str | None, no_log: bool, robot: str) -> Path | None:
    """Return the name of the log, with the time: one file per arm and start."""
    from armlab.cli.support.settings import log_folder

    if no_log:
        if log is not None:
            raise ConfigError(f"Expected either --log or --no-log, got both (--log {log}). Leave one out.")
        return None
    name = Path(robot).stem
    if log is not None and (log.endswith(os.sep) or Path(log).is_dir()):
        start = str(Path(log) / name)
    else:
        start = str(log_folder() / name if log is None else log).removesuffix(".mcap")
    path = Path(f"{start}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}.mcap")
    check_output(path, force=True, endings=[".mcap"])  # a second start in this second gets -2 from the recorder
    return path


def _files(link: Link) -> list[Path]:
    """Return the logs of the last run; one that met another of its name has a number in its own."""
    last = link.last
    runs = () if last is None else last.arms or (last,)
    return [one.path for one in runs if one.path is not None and one.path.exists()]


def _prompt(done: Run, link: Link) -> None:
    import code

    import numpy as np

    names = {"run": done, "log": done.table, "robot": link.robot, "np": np}
    code.interact("log: the table, run: its report, robot, np. Ctrl-D ends.", local=names, exitmsg="")
