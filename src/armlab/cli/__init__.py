"""The command `armlab`: every job of the package, one verb each.

Commands are named by import string, so that ``armlab --help`` loads none of them.
Results go to standard output, messages to standard error. Exit codes: 0 done, 1 failed, 2 wrong use,
3 done but some inputs were skipped, 130 interrupted.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cyclopts import App

__all__ = ["FAILED", "INTERRUPTED", "SKIPPED", "WRONG_USE", "build_app", "main"]

FAILED, WRONG_USE, SKIPPED, INTERRUPTED = 1, 2, 3, 130

_COMMANDS = {
    "demo": ("demo:demo", "Simulated YuMi, from excitation to the estimated force of a hand. No robot needed."),
    "sim": ("sim:sim", "Simulated arms and a simulated controller that speaks EGM."),
    "identify": ("identify:identify", "Identify gravity, inertia and friction from logs; save the model."),
    "estimate": ("estimate:estimate", "Estimate the contact force in a log with a model."),
    "log": ("log:log", "Show and repair logs."),
    "robot": ("robot:robot", "List and show robot descriptions."),
}


def build_app() -> App:
    """Return the application with all commands, none of them imported yet."""
    from cyclopts import App, Parameter

    from armlab import __version__

    app = App(
        name="armlab",
        version=__version__,
        help="A robotics laboratory for robot arms. First steps: armlab demo.",
        help_epilogue="Every command takes --help. --debug shows the traceback of an error.",
        default_parameter=Parameter(negative=()),
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for name, (target, text) in _COMMANDS.items():
        app.command(f"armlab.cli.{target}", name=name, help=text)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Errors are one sentence on standard error; ``--debug`` adds the traceback.

    Parameters
    ----------
    arguments : words after ``armlab``; those of the process when None.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    with _terminated_as_interrupted(), _short_warnings():
        try:
            return _run(words)
        except Exception as error:
            if isinstance(error.__cause__, KeyboardInterrupt):  # so compiled modules report Ctrl-C while they load
                _say("interrupted.")
                return INTERRUPTED
            if debug:
                traceback.print_exc()
            return _report(error)
        except KeyboardInterrupt:
            _say("interrupted.")
            return INTERRUPTED


def _run(words: list[str]) -> int:
    """Parse and run; return the exit code."""
    from cyclopts import CycloptsError

    try:
        result = build_app()(words, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        _say(f"{' '.join(str(error).split())} (see armlab --help)")
        return WRONG_USE
    sys.stdout.flush()
    return result if isinstance(result, int) else 0


def _report(error: Exception) -> int:
    """Say in one sentence what went wrong and return the exit code."""
    from armlab.errors import ArmlabError

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
    return FAILED


def _say(message: str) -> None:
    sys.stderr.write(f"armlab: {message}\n")


@contextmanager
def _short_warnings() -> Iterator[None]:
    """Show warnings as one line, without the line of source."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_args, **_kwargs: _say(f"note: {message}")
        yield


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C, so that logs are closed and simulators stopped."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # not in the main thread: the process's owner handles signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
