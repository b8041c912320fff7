"""All errors of armlab.

Every message is a sentence that says what was expected, what came, where, and what to do.
Each class is an `ArmlabError` and, where one fits, also the builtin that callers would catch.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from reprlib import repr as shortened
from typing import Any

__all__ = [
    "ArmlabError", "CommandRefused", "ConcurrentUse", "ConfigError", "ControllerFailed", "ControllerLate", "FrameError",
    "LabCommError", "LinkError", "LogError", "MissingExtra", "ModelMismatchError", "NoRobot", "NotConverged",
    "NotExcited", "RobotError", "SessionEnded", "ShapeError", "SingularPoseError", "UnknownName",
]  # fmt: skip


class ArmlabError(Exception):
    """Root of all errors that armlab raises on purpose."""

    def __str__(self) -> str:
        """Return the sentence itself (a KeyError would show its quoted form)."""
        return str(self.args[0]) if self.args else ""


class ShapeError(ArmlabError, ValueError):
    """An array has the wrong shape or content: shape, NaN rows, not a rotation, time order."""

    @classmethod
    def no_table(cls, value: object) -> ShapeError:
        """Build the error for `value` where a log was expected.

        Parameters
        ----------
        value : what came: often the path of a log that was not read.
        """
        return cls(f"Expected a Table, got {shortened(value)}. Read files by log.read.")


class UnknownName(ArmlabError, KeyError):
    """A robot, column, link or convention does not exist. The message lists those that do."""

    @classmethod
    def among(cls, kind: str, name: object, known: Iterable[str]) -> UnknownName:
        """Build the error for `name`, listing what exists and the closest match.

        Parameters
        ----------
        kind : what was looked up, for example "robot".
        name : what came.
        known : the names that exist.
        """
        from difflib import get_close_matches  # 1 ms that a program without mistakes need not pay

        names = sorted(known)
        close = get_close_matches(name, names, n=1) if isinstance(name, str) else []
        hint = f" Did you mean {close[0]!r}?" if close else ""
        article = "an" if kind[:1] in "aeiou" else "a"
        came = repr(name) if isinstance(name, str) else shortened(name)
        return cls(f"Expected the name of {article} {kind}, got {came}. Known: {', '.join(names) or 'none'}.{hint}")


class RobotError(ArmlabError, ValueError):
    """A robot description is inconsistent, or something else came in place of a robot."""

    @classmethod
    def no_robot(cls, value: object) -> RobotError:
        """Build the error for `value` where a `Robot` was expected.

        Parameters
        ----------
        value : what came: often the name of a robot that was not loaded.
        """
        advice = f"Load it first: robots.load({value!r})" if isinstance(value, str) else "robots.load gives one"
        if hasattr(value, "robot"):
            advice = "Give its attribute robot"
            if hasattr(value, "joints"):  # of a kinematic calibration
                advice += (
                    "; positions that an arm tells go through its joints(), those to ask for through its command()"
                )
        return cls(f"Expected a Robot, got {shortened(value)}. {advice}.")


class ConfigError(ArmlabError, ValueError):
    """A configuration file or option has a wrong value."""


class MissingExtra(ArmlabError, ImportError):
    """An optional dependency is not installed. The message holds the command that installs it."""


class LogError(ArmlabError, ValueError):
    """A log file cannot be read or written."""


class LabCommError(ArmlabError, ValueError):
    """A LabComm stream, definition, value or `.lc` text is malformed.

    Attributes
    ----------
    offset : position in the stream of the first byte of the field at fault, or None.
    events : what the same piece of the stream held before the fault.
    path : the part of a value at fault, for example "robot_row.pos".
    line, column : place in an `.lc` text, from 1, or None.
    """

    def __init__(
        self,
        message: str,
        offset: int | None = None,
        *,
        path: str = "",
        line: int | None = None,
        column: int | None = None,
    ) -> None:
        super().__init__(message)
        self.offset, self.path, self.line, self.column = offset, path, line, column
        self.events: list[Any] = []


class FrameError(ArmlabError, ValueError):
    """Two frames do not fit together. The message names both."""


class ModelMismatchError(ArmlabError, ValueError):
    """A model file belongs to another robot, sign convention or unit, or something else came in place of a model."""

    @classmethod
    def no_model(cls, value: object) -> ModelMismatchError:
        """Build the error for `value` where a `TorqueModel` was expected.

        Parameters
        ----------
        value : what came: often the path of a model that was not loaded, or a fit in place of its value.
        """
        return cls(f"Expected a TorqueModel, got {shortened(value)}. models.load gives one, or the value of a fit.")


class NotExcited(ArmlabError, ValueError):
    """The data do not determine what was asked for.

    Attributes
    ----------
    directions : names of the parameters, joints or directions that were not excited.
    spread : what the data showed for each of them, in words.
    """

    def __init__(self, message: str, directions: Sequence[str] = (), spread: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.directions = tuple(directions)
        self.spread = tuple(spread)


class NotConverged(ArmlabError, RuntimeError):
    """An iteration stopped before its tolerance.

    Attributes
    ----------
    best : the best result found.
    history : the cost after each iteration.
    reason : one word where the cause is known, for example "left_handed".
    """

    def __init__(self, message: str, best: Any = None, history: Sequence[float] = (), reason: str = "") -> None:
        super().__init__(message)
        self.best = best
        self.history = tuple(history)
        self.reason = reason


class ConcurrentUse(ArmlabError, RuntimeError):
    """An object with a state of its own was used by two threads at once."""


class SingularPoseError(ArmlabError, ValueError):
    """At this pose a requested quantity is not determined."""


class LinkError(ArmlabError, RuntimeError):
    """A link to a robot failed.

    Attributes
    ----------
    table : the last seconds before the failure as a Table, or None.
    """

    def __init__(self, message: str, table: Any = None) -> None:
        super().__init__(message)
        self.table = table


class NoRobot(LinkError):
    """No packet from a robot came within the time allowed."""


class SessionEnded(LinkError):
    """The controller ended the EGM session. The message says why."""


class CommandRefused(LinkError):
    """A command was refused: shape, not finite, a jump, or a capability the link does not have."""


class ControllerLate(LinkError):
    """The user's controller was late too often."""


class ControllerFailed(LinkError):
    """The user's controller raised, and the exception is `__cause__`; or it closed descriptors of the bridge."""
