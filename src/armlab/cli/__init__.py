"""The command `armlab`: every job of the package, one verb each.

Commands are named by import string, so that ``armlab --help`` loads none of them.
Results go to standard output, messages to standard error. Exit codes: 0 done, 1 failed, 2 wrong use,
3 done but doubtful: a result that is not good, inputs that were skipped, 130 interrupted.
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
from typing import TYPE_CHECKING, Any

from armlab._interrupts import handling

if TYPE_CHECKING:
    from cyclopts import App
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions

__all__ = ["main"]

FAILED, WRONG_USE, DOUBTFUL, INTERRUPTED = 1, 2, 3, 130

_COMMANDS = {
    "demo": ("demo:demo", "Simulated YuMi, from excitation to the estimated force of a hand. No robot needed."),
    "sim": ("sim:sim", "Simulated arms and a simulated controller that speaks EGM."),
    "doctor": ("doctor:doctor", "Check computer, network and robot before a run. Sends nothing to a robot."),
    "run": ("run:run", "Run your controller from a file against a robot; record a log."),
    "record": ("record:record", "Record the packets of robots, also in lead-through. Sends nothing."),
    "excite": ("excite:excite", "Design an excitation trajectory; run it and record a log."),
    "identify": ("identify:identify", "Identify gravity, inertia and friction from logs; save the model."),
    "estimate": ("estimate:estimate", "Estimate the contact force in a log with a model."),
    "payload": ("identify.payload:payload", "Identify a payload from motor torques: mass, centre, inertia."),
    "calibrate": ("calibrate:calibrate", "Calibrate a camera, a force sensor, an arm or a line scanner from samples."),
    "dmp": ("dmp:dmp", "Movement primitives: fit one to logs of a motion, play it on a robot."),
    "plot": ("plot:plot", "Figures of logs, models, robots and movement primitives."),
    "bridge": ("bridge:bridge", "Run a cell: robots, LabComm and other clients, parameters, one commander."),
    "monitor": ("bridge:monitor", "Monitor a running bridge: rates, round trips, clamps, commander, events."),
    "view": ("view:view", "Arms, forces and curves of logs or of a running bridge, in the browser."),
    "fleet": ("fleet:fleet", "Many robots at once: a router, recordings of all, one list of them."),
    "log": ("log:log", "Show, export, cut, merge, open and repair logs."),
    "config": ("config:config", "Show settings: of files, of the environment, of a cell. Writes nothing."),
    "completion": ("config:completion", "Print the completion script for bash, zsh or fish."),
    "robot": ("robot:robot", "List, show and convert robot descriptions."),
}


_EXAMPLES = {  # of the other commands beside their subcommands
    "demo": "armlab demo --fast -o first",
    "sim": "armlab sim yumi_left --to 127.0.0.1:6510 --seconds 60",
    "monitor": "armlab monitor yumi_left",
    "completion": "armlab completion bash",
    "doctor": "armlab doctor yumi_left yumi_right --port 6511,6512 --seconds 10",
    "run": "armlab run yumi_left sine.py:sine --link egm://0.0.0.0:6510 --speed 0.1 --seconds 10",
    "record": "armlab record yumi_left yumi_right --port 6511,6512 --lead-through -o run.mcap",
    "excite": "armlab excite yumi_left -o motion.csv --run sim://yumi_left --log excite.mcap",
    "identify": "armlab identify yumi_left excite.mcap -o model.toml --report model.html",
    "estimate": "armlab estimate yumi_left press.mcap --model model.toml -o force.mcap --report force.html",
    "view": "armlab view left.mcap right.mcap",
    "payload": "armlab payload yumi_left loaded.mcap --model model.toml",
}


def build_app(verb: str = "") -> App:
    """Return the application with all commands, none of them imported yet.

    Parameters
    ----------
    verb : command of the user: its help is its own, longer than its line in the list of all.
    """
    from cyclopts import App, Parameter

    from armlab import __version__

    app = App(
        name="armlab",
        version=__version__,
        help="A robotics laboratory for robot arms. First steps: armlab demo.",
        help_epilogue="Every command takes --help. --debug shows the traceback of an error.",
        help_format="plaintext",
        help_formatter=WrappedHelp(),
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

    Errors are one sentence on standard error; ``--debug`` adds the traceback.

    Parameters
    ----------
    arguments : words after ``armlab``; those of the process when None.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    nowhere = Path(os.devnull)  # for what the shell has closed: armlab robot list >&-
    sys.stdout, sys.stderr = sys.stdout or nowhere.open("w"), sys.stderr or nowhere.open("w")
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    with _interruptible() as interrupts, _short_warnings():
        try:
            return _run(words)
        except Exception as error:
            if interrupts:  # compiled modules that are interrupted while they load raise something else
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

    try:
        result = build_app(words[0] if words else "")(words, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        _say(f"{' '.join(str(error).split())} (see {' '.join(['armlab', *(error.command_chain or ())])} --help)")
        return WRONG_USE
    sys.stdout.flush()
    return result if isinstance(result, int) else 0


def _report(error: Exception) -> int:
    """Say in one sentence what went wrong and return the exit code."""
    from armlab.errors import ArmlabError, ConfigError, ModelMismatchError, UnknownName

    if isinstance(error, BrokenPipeError):
        # The reader of our output (head, less) has enough; keep the interpreter from complaining about it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    if isinstance(error, ArmlabError):
        _say(str(error))
    elif isinstance(error, OSError):
        _say(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}.")
    else:
        _say(f"internal error, {type(error).__name__}: {error} (--debug shows where; please report it).")
    # A name that does not exist, and a model of another kind or arm, are words to be put right, as a wrong option is.
    return WRONG_USE if isinstance(error, (ConfigError, ModelMismatchError, UnknownName)) else FAILED


def _say(message: str) -> None:
    sys.stderr.write(f"armlab: {message}\n")


@contextmanager
def _short_warnings() -> Iterator[None]:
    """Show warnings as one line, without the line of source."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_args, **_kwargs: _say(f"note: {message}")
        yield


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Treat SIGTERM and a closed terminal like Ctrl-C: logs are closed, simulators stopped. Yields what came."""
    came: list[int] = []

    def interrupt(number: int, _frame: object) -> None:
        again = number == signal.SIGHUP and bool(came)  # a terminal that is closed sends it more than once
        came.append(number)
        if not again:
            raise KeyboardInterrupt

    with handling(interrupt):
        yield came


_BREAK_IN_PARAGRAPH = re.compile(r"(?<=\S)[ \t]*\n(?![\s*-])")


def unwrapped(text: str) -> str:
    """Return a text whose paragraphs are one line each; empty lines, lists and indented lines stay."""
    return _BREAK_IN_PARAGRAPH.sub(" ", text)


class WrappedHelp:
    """The default look of cyclopts for texts that keep the line breaks of their docstring."""

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        _default().render_usage(console, options, usage)

    def render_description(self, console: Console, options: ConsoleOptions, description: Any) -> None:
        _default().render_description(console, options, _wrapped(description))

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print a panel of commands or parameters."""
        from attrs import evolve

        entries = [evolve(entry, description=_wrapped(entry.description)) for entry in panel.entries]
        _default()(console, options, panel.copy(entries=entries))


def _default() -> Any:
    from cyclopts.help import DefaultFormatter

    return DefaultFormatter()


def _wrapped(shown: Any) -> Any:
    """Unwrap the text of something that is shown; it is made anew for each print."""
    from rich.text import Text

    text = getattr(shown, "primary_renderable", None)
    if isinstance(text, Text):
        shown.primary_renderable = Text(unwrapped(text.plain), end=text.end)
    return shown
