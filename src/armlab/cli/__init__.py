"""The command `armlab`: one verb per task.

Commands are registered by import string, so ``armlab --help`` imports none of them. Results go to standard output,
messages to standard error. Exit codes: 0 success, 1 failure, 2 usage error, 3 poor result or skipped inputs, 130
interrupted.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill
from typing import TYPE_CHECKING, Any

from armlab._interrupts import handling

if TYPE_CHECKING:
    from cyclopts import App
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions

__all__ = ["main"]

FAILED, WRONG_USE, DOUBTFUL, INTERRUPTED = 1, 2, 3, 130

_COMMANDS = {
    "demo": ("demo:demo", "Demo on a simulated YuMi, from excitation to contact-force estimation. No robot needed."),
    "sim": ("sim:sim", "Simulate arms and their EGM controllers."),
    "doctor": (
        "doctor:doctor",
        "Check the computer, the network and the robot before a run. Sends nothing to a robot.",
    ),
    "abb": ("abb:abb", "Set up, start and stop an ABB controller via Robot Web Services."),
    "run": ("run:run", "Run your controller from a file on a robot; record a log."),
    "play": ("run:play", "Run a joint trajectory from a file on a robot, or replay a log."),
    "record": ("record:record", "Record packets from robots, including during lead-through. Sends nothing."),
    "excite": ("excite:excite", "Design an excitation trajectory; run it and record a log."),
    "identify": ("identify:identify", "Identify gravity, inertia and friction from logs; save the model."),
    "estimate": ("estimate:estimate", "Estimate contact forces from a log and a torque model."),
    "payload": ("identify.payload:payload", "Identify a payload (mass, centre of mass, inertia) from motor torques."),
    "calibrate": ("calibrate:calibrate", "Calibrate a camera, a force sensor, an arm or a line scanner from samples."),
    "dmp": ("dmp:dmp", "Fit movement primitives to logs, and play them on a robot."),
    "plot": ("plot:plot", "Plot logs, models, robots and movement primitives."),
    "bridge": ("bridge:bridge", "Run a cell: robots, parameters, and servers for LabComm and other protocols."),
    "monitor": ("bridge:monitor", "Monitor a running bridge: rates, round trips, clamps, commander, events."),
    "view": ("view:view", "Show arms, forces and curves from logs or a running bridge in the browser."),
    "fleet": ("fleet:fleet", "Manage many robots: router, recorder, status list, batch jobs."),
    "log": ("log:log", "Show, export, cut, resample, merge, open and repair logs."),
    "config": ("config:config", "Show the settings from files, the environment and the cell. Writes nothing."),
    "completion": ("config:completion", "Print the completion script for bash, zsh or fish."),
    "robot": ("robot:robot", "List, show, convert and export robot descriptions."),
    "model": (
        "model:model",
        "Show the poses and parameters of a result, optionally in the format of ROS, URDF or easy_handeye.",
    ),
}

_EXAMPLES = {  # examples of commands without subcommands
    "demo": "armlab demo --fast -o first",
    "sim": "armlab sim yumi_left --to 127.0.0.1:6510 --seconds 60",
    "monitor": "armlab monitor yumi_left",
    "completion": "armlab completion bash",
    "doctor": "armlab doctor yumi_left yumi_right --port 6511,6512 --seconds 10",
    "run": "armlab run yumi_left sine.py:sine --link egm://0.0.0.0:6510 --speed 0.1 --seconds 10",
    "play": "armlab play trajectory.json yumi_left --link egm://0.0.0.0:6510 --speed 0.3",
    "record": "armlab record yumi_left yumi_right --port 6511,6512 --lead-through -o run.mcap",
    "excite": "armlab excite yumi_left -o motion.csv --run sim://yumi_left --log excite.mcap",
    "identify": "armlab identify yumi_left excite.mcap -o model.toml --report model.html",
    "estimate": "armlab estimate yumi_left press.mcap --model model.toml -o force.mcap --report force.html",
    "view": "armlab view left.mcap right.mcap",
    "payload": "armlab payload yumi_left loaded.mcap --model model.toml",
}


def build_app(verb: str = "", shown: WrappedHelp | None = None) -> App:
    """Return the application. Only the requested command, `verb`, is imported, to provide its help text."""
    from cyclopts import App, Parameter

    from armlab import __version__

    app = App(
        name="armlab",
        version=__version__,
        help="A robotics laboratory for robot arms. To get started, run armlab demo.",
        help_epilogue="Every command takes --help. --debug shows the traceback of an error. A robot is a library "
        "name, a description file (.toml or .urdf), or a name from robot_descriptions or example-robot-data (extra "
        "`robots`). Every command that takes a URDF also takes --tip LINK, --base LINK and --lock JOINT=VALUE.",
        help_format="plaintext",
        help_formatter=WrappedHelp() if shown is None else shown,
        default_parameter=Parameter(negative=()),
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for name, (target, text) in _COMMANDS.items():
        example = {"help_epilogue": f"Example: {_EXAMPLES[name]}"} if name in _EXAMPLES else {}
        app.command(f"armlab.cli.{target}", name=name, help=None if name == verb else text, **example)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Each error is printed as one sentence on standard error; ``--debug`` adds the traceback.

    Parameters
    ----------
    arguments : command-line arguments after ``armlab``; default: the arguments of this process.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    nowhere = Path(os.devnull)  # replaces streams closed by the shell: armlab robot list >&-
    sys.stdout, sys.stderr = sys.stdout or nowhere.open("w"), sys.stderr or nowhere.open("w")
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    with _interruptible() as interrupts, _short_warnings():
        try:
            return _run(words)
        except Exception as error:
            if interrupts:  # compiled modules raise other errors if interrupted during import
                _say("interrupted.")
                return INTERRUPTED
            if debug:
                traceback.print_exc()
            return _report(error)
        except KeyboardInterrupt:
            _say("interrupted.")
            return INTERRUPTED


def _run(words: list[str]) -> int:
    from cyclopts import CycloptsError

    from armlab.cli.support.options import take_robot_options

    shown = WrappedHelp()
    try:
        words = take_robot_options(words)
        result = build_app(words[0] if words else "", shown)(words, exit_on_error=False, print_error=False)
        if shown.takes_robot:
            sys.stdout.write(f"{fill(_OF_A_URDF, get_terminal_size().columns)}\n")
    except CycloptsError as error:
        _say(f"{' '.join(str(error).split())} (see {' '.join(['armlab', *(error.command_chain or ())])} --help)")
        return WRONG_USE
    finally:
        take_robot_options([])  # options apply to one command only
    sys.stdout.flush()
    return result if isinstance(result, int) else 0


def _report(error: Exception) -> int:
    """Print an error as one sentence and return the exit code."""
    from armlab.errors import ArmlabError, ConfigError, ModelMismatchError, UnknownName

    if isinstance(error, BrokenPipeError):
        # The program that reads our output (head, less) has closed the pipe: suppress the interpreter's error at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    if isinstance(error, ArmlabError):
        _say(str(error))
    elif isinstance(error, OSError):
        _say(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}.")
    else:
        _say(f"internal error, {type(error).__name__}: {error} (--debug shows the traceback; please report it).")
    # Unknown names and models of the wrong type or arm are usage errors, like invalid options.
    return WRONG_USE if isinstance(error, (ConfigError, ModelMismatchError, UnknownName)) else FAILED


def _say(message: str) -> None:
    sys.stderr.write(f"armlab: {message}\n")


@contextmanager
def _short_warnings() -> Iterator[None]:
    """Print each warning on one line, without its source line."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_args, **_kwargs: _say(f"note: {message}")
        yield


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Treat SIGTERM and a closed terminal like Ctrl-C; yield the list of received signals.

    An interrupted command therefore closes its logs and stops its simulators.
    """
    came: list[int] = []

    def interrupt(number: int, _frame: object) -> None:
        again = number == signal.SIGHUP and bool(came)  # a closed terminal sends SIGHUP more than once
        came.append(number)
        if not again:
            raise KeyboardInterrupt

    with handling(interrupt):
        yield came


_BREAK_IN_PARAGRAPH = re.compile(r"(?<=\S)[ \t]*\n(?![\s*-])")

_A_ROBOT = re.compile(r"\blibrary\b|\brobot file|file of the arm", re.IGNORECASE)  # in the help of a robot parameter
_OF_A_URDF = "For a URDF, --tip LINK, --base LINK and --lock JOINT=VALUE select the arm."


class WrappedHelp:
    """Default cyclopts formatter that removes the line breaks of docstrings."""

    takes_robot = False  # True if the displayed help has a robot parameter

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        _default().render_usage(console, options, usage)

    def render_description(self, console: Console, options: ConsoleOptions, description: Any) -> None:
        _default().render_description(console, options, _wrapped(description))

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        from attrs import evolve

        if panel.format == "parameter":
            texts = (getattr(entry.description, "primary_renderable", entry.description) for entry in panel.entries)
            self.takes_robot |= any(_A_ROBOT.search(str(text)) for text in texts)
        entries = [evolve(entry, description=_wrapped(entry.description)) for entry in panel.entries]
        _default()(console, options, panel.copy(entries=entries))


def _default() -> Any:
    from cyclopts.help import DefaultFormatter

    return DefaultFormatter()


def _wrapped(shown: Any) -> Any:
    """Join the lines of each paragraph of help text; keep blank lines, lists and indented lines."""
    from rich.text import Text

    text = getattr(shown, "primary_renderable", None)
    if isinstance(text, Text):
        shown.primary_renderable = Text(_BREAK_IN_PARAGRAPH.sub(" ", text.plain), end=text.end)
    return shown
