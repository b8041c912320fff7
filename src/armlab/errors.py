"""Exceptions of armlab.

Each message states the expected value, the received value, the location and the remedy. Each class derives from
`ArmlabError` and, if applicable, from the corresponding built-in exception.
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
    """Base class of all exceptions that armlab raises deliberately."""

    def __str__(self) -> str:
        """Return the message without the quotes that KeyError adds."""
        return str(self.args[0]) if self.args else ""


class ShapeError(ArmlabError, ValueError):
    """An array with the wrong shape or content, such as NaN rows, an invalid rotation or unsorted times."""

    @classmethod
    def no_table(cls, value: object) -> ShapeError:
        """Return the error for a `value` that is not a Table.

        Parameters
        ----------
        value : object
            Received value, often the path of a log that has not been read.
        """
        return cls(f"Expected a Table, got {shortened(value)}. Read files with log.read.")


class UnknownName(ArmlabError, KeyError):
    """An unknown robot, column, link or convention name. The message lists the known names."""

    @classmethod
    def among(cls, kind: str, name: object, known: Iterable[str]) -> UnknownName:
        """Return the error for an unknown `name`, with the known names and the closest match.

        Parameters
        ----------
        kind : str
            Kind of the name, for example "robot".
        name : object
            Received name.
        known : iterable of str
            Known names.
        """
        from difflib import get_close_matches  # takes 1 ms to import, only needed here

        names = sorted(known)
        close = get_close_matches(name, names, n=1) if isinstance(name, str) else []
        hint = f" Did you mean {close[0]!r}?" if close else ""
        article = "an" if kind[:1] in "aeiou" else "a"
        got = repr(name) if isinstance(name, str) else shortened(name)
        return cls(f"Expected the name of {article} {kind}, got {got}. Known: {', '.join(names) or 'none'}.{hint}")


class RobotError(ArmlabError, ValueError):
    """An inconsistent robot description, or a value that is not a robot."""

    @classmethod
    def no_robot(cls, value: object) -> RobotError:
        """Return the error for a `value` that is not a `Robot`.

        Parameters
        ----------
        value : object
            Received value, often the name of a robot.
        """
        advice = (
            f"Load the robot first: robots.load({value!r})"
            if isinstance(value, str)
            else "Load a robot with robots.load"
        )
        if hasattr(value, "robot"):
            advice = "Pass its attribute `robot`"
            if hasattr(value, "joints"):  # a kinematic calibration
                advice += "; convert measured positions with joints() and references with command()"
        return cls(f"Expected a Robot, got {shortened(value)}. {advice}.")


class ConfigError(ArmlabError, ValueError):
    """An invalid value in a configuration file or option."""


class MissingExtra(ArmlabError, ImportError):
    """A missing optional dependency. The message contains the installation command."""


class LogError(ArmlabError, ValueError):
    """A log file that cannot be read or written."""


class LabCommError(ArmlabError, ValueError):
    """A malformed LabComm stream, definition, value or `.lc` text.

    Attributes
    ----------
    offset : int
        Offset of the faulty field in the stream, or None.
    events : list
        Events decoded before the fault in the same chunk of the stream.
    path : str
        Faulty part of a value, for example "robot_row.pos".
    line : int
        Line number in an `.lc` text, counted from 1; or None.
    column : int
        Column number in an `.lc` text, counted from 1; or None.
    """

    offset: int | None
    path: str
    line: int | None
    column: int | None

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
    """Two mismatched frames. The message names both frames."""


class ModelMismatchError(ArmlabError, ValueError):
    """A model file for another robot, sign convention or unit, or a value that is not a model."""

    @classmethod
    def no_model(cls, value: object) -> ModelMismatchError:
        """Return the error for a `value` that is not a `TorqueModel`.

        Parameters
        ----------
        value : object
            Received value, often the path of a model, or a fit instead of its value.
        """
        return cls(f"Expected a TorqueModel, got {shortened(value)}. Use models.load, or the `value` of a fit.")


class NotExcited(ArmlabError, ValueError):
    """Data that do not excite the requested quantities.

    Attributes
    ----------
    directions : tuple of str
        Parameters, joints or directions without excitation.
    spread : tuple of str
        Excitation of each entry of `directions`, as text.
    """

    def __init__(self, message: str, directions: Sequence[str] = (), spread: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.directions: tuple[str, ...] = tuple(directions)
        self.spread: tuple[str, ...] = tuple(spread)


class NotConverged(ArmlabError, RuntimeError):
    """An iteration that stopped before reaching its tolerance.

    Attributes
    ----------
    best : object
        Best result so far.
    history : tuple of float
        Cost after each iteration.
    reason : str
        Cause in one word if known, for example "left_handed".
    """

    def __init__(self, message: str, best: Any = None, history: Sequence[float] = (), reason: str = "") -> None:
        super().__init__(message)
        self.best = best
        self.history: tuple[float, ...] = tuple(history)
        self.reason = reason


class ConcurrentUse(ArmlabError, RuntimeError):
    """Concurrent use of a stateful object by two threads."""


class SingularPoseError(ArmlabError, ValueError):
    """A pose at which a requested quantity is undefined."""


class LinkError(ArmlabError, RuntimeError):
    """A failed link to a robot.

    Attributes
    ----------
    table : Table
        Log of the last seconds before the failure, or None.
    """

    def __init__(self, message: str, table: Any = None) -> None:
        super().__init__(message)
        self.table = table


class NoRobot(LinkError):
    """No packet from a robot within the time limit."""


class SessionEnded(LinkError):
    """An EGM session ended by the robot controller. The message states the reason."""


class CommandRefused(LinkError):
    """A command rejected because of a wrong shape, non-finite values, a jump, or a capability that the link lacks."""


class ControllerLate(LinkError):
    """Too many deadlines missed by the user's controller."""


class ControllerFailed(LinkError):
    """An exception in the user's controller (`__cause__`), or bridge descriptors closed by the controller."""
