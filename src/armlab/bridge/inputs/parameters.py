"""Parameters of a run: typed, bounded values that clients set and the controller reads as attributes."""

from __future__ import annotations

import math
import re
import sys
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from armlab._display import Shown
from armlab.errors import CommandRefused, ConfigError, UnknownName

_TYPES = ("float", "int", "bool", "text")
_VECTOR = re.compile(r"float\[([1-9]\d{0,2})\]")
_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]{0,63}")
_LONGEST = 1000  # characters of a text parameter
_WAITING = 256  # maximum number of settings queued for the next tick
_LARGEST = sys.float_info.max
_INTEGERS = 2**53  # JSON readers may round larger integers


@dataclass(frozen=True, slots=True, repr=False)
class Parameter(Shown):
    """Declaration of one parameter.

    Attributes
    ----------
    name : str
        Identifier, as in ``params.gain``.
    default : object
        Initial value.
    type : str
        "float", "int", "bool", "text" or "float[k]" for k numbers.
    unit : str
        SI unit.
    minimum : float
        Lower bound of each number.
    maximum : float
        Upper bound of each number.
    text : str
        Description in one sentence.
    rights : str
        Clients that may set the parameter: only the "commander" of an arm, or "anyone".
    live : bool
        Whether the parameter may be set during a run.

    Raises
    ------
    ConfigError
        Invalid declaration; the message names the parameter.
    """

    name: str
    default: Any
    type: str = "float"
    unit: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    text: str = ""
    rights: Literal["commander", "anyone"] = "commander"
    live: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name) or hasattr(Parameters, self.name):
            raise ConfigError(
                "Expected an unused parameter name made of letters, "
                f"digits and _, got {self.name!r}. Choose another name."
            )
        if self.type not in _TYPES and not _VECTOR.fullmatch(self.type):
            raise ConfigError(
                f"Expected the type of {self.name} to be float, int, bool, text or float[k], got {self.type!r}."
            )
        if self.rights not in ("commander", "anyone"):
            raise ConfigError(f'Expected rights "commander" or "anyone" for {self.name}, got {self.rights!r}.')
        if not self.minimum <= self.maximum:  # also rejects NaN
            raise ConfigError(f"Expected minimum <= maximum for {self.name}, got {self.minimum} and {self.maximum}.")
        try:
            object.__setattr__(self, "default", self._checked(self.default))
        except CommandRefused as error:
            raise ConfigError(f"Expected a valid default of {self.name}. {error}") from None

    @property
    def _size(self) -> int:
        """Length k of the type "float[k]"; 0 for other types."""
        match = _VECTOR.fullmatch(self.type)
        return int(match[1]) if match else 0

    def _checked(self, value: Any) -> Any:
        """Return the value to store: a float, int, bool, str or read-only array (k,)."""
        if self.type == "bool":
            if not isinstance(value, (bool, np.bool_)):
                raise self._refused("true or false", value)
            return bool(value)
        if self.type == "text":
            if not isinstance(value, str) or len(value) > _LONGEST:
                raise self._refused(f"text of at most {_LONGEST} characters", value)
            return value
        return self._number(value) if not self._size else self._vector(value)

    def _number(self, value: Any) -> float | int:
        is_number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
        if not is_number or not abs(value) < math.inf:
            raise self._refused("a finite number", value)
        if self.type == "int" and (value != int(value) or abs(value) > _INTEGERS):
            raise self._refused("a whole number", value)
        if not self.minimum <= value <= self.maximum:
            raise self._refused(f"a number from {self.minimum:g} to {self.maximum:g}", value)
        if abs(value) > _LARGEST:
            raise self._refused("a number within the range of a float", value)
        return int(value) if self.type == "int" else float(value)

    def _vector(self, value: Any) -> np.ndarray:
        try:
            is_plain = isinstance(value, (list, tuple, np.ndarray)) and np.asarray(value).dtype.kind in "iuf"
            array = np.array(value, dtype=np.float64) if is_plain else np.empty(0)
        except (ValueError, TypeError, OverflowError):
            array = np.empty(0)
        if array.shape != (self._size,) or not np.isfinite(array).all():
            raise self._refused(f"{self._size} finite numbers", value)
        if not (np.all(array >= self.minimum) and np.all(array <= self.maximum)):
            raise self._refused(f"numbers from {self.minimum:g} to {self.maximum:g}", value)
        array.flags.writeable = False
        return array

    def _refused(self, expected: str, value: Any) -> CommandRefused:
        unit = f" [{self.unit}]" if self.unit else ""
        try:
            got = repr(value)[:80]
        except ValueError:  # an integer with too many digits
            got = f"a {type(value).__name__} too long to show"
        return CommandRefused(
            f"Expected {expected} for the parameter {self.name}{unit}, got {got}. The value is unchanged."
        )


class Change(NamedTuple):
    """Parameter change that has taken effect."""

    sequence: int
    name: str
    value: Any
    who: str

    @property
    def sentence(self) -> str:
        """Text of the event that reports the change."""
        value = self.value.tolist() if isinstance(self.value, np.ndarray) else self.value
        return f"Parameter {self.name} = {value!r}, set by {self.who} (setting {self.sequence})."


class Parameters:
    """Parameters of a run; ``params.gain`` is the current value.

    A new value is checked immediately and takes effect between two ticks. Values that are set together either all take
    effect in the same tick or are all refused.

    Parameters
    ----------
    declared : iterable of Parameter
        Declarations of the parameters.

    Attributes
    ----------
    declared : mapping
        Declarations by name.
    running : bool
        If True, only `live` parameters may be set.

    Raises
    ------
    ConfigError
        A name is declared more than once.

    Examples
    --------
    >>> from armlab.bridge import Parameter, Parameters
    >>> params = Parameters([Parameter("gain", 2.0, unit="1/s", minimum=0.0, maximum=10.0)])
    >>> params.set("gain", 3.0)
    >>> params.gain, [change.value for change in params.apply()], params.gain
    (2.0, [3.0], 3.0)
    """

    def __init__(self, declared: Iterable[Parameter] = ()) -> None:
        found = list(declared)
        names = [parameter.name for parameter in found]
        if len(set(names)) < len(names):
            raise ConfigError(f"Expected each parameter once, got {', '.join(names)}. Remove the duplicates.")
        self.declared: Mapping[str, Parameter] = {parameter.name: parameter for parameter in found}
        self.running = False
        self._values = {parameter.name: parameter.default for parameter in found}
        self._waiting: deque[tuple[dict[str, Any], str]] = deque()
        self._last: dict[str, Change] = {}
        self._sequence = 0

    def __getattr__(self, name: str) -> Any:
        values = self.__dict__.get("_values", {})
        if name not in values:
            raise AttributeError(str(UnknownName.among("parameter", name, values)))
        return values[name]

    def values(self) -> dict[str, Any]:
        """Return the current values by name."""
        return dict(self._values)

    def last(self, name: str) -> Change | None:
        """Return the last change of a parameter; None before the first change.

        Parameters
        ----------
        name : str
            Name of the parameter.

        Raises
        ------
        UnknownName
            The parameter is not declared.
        """
        if name not in self.declared:
            raise UnknownName.among("parameter", name, self.declared)
        return self._last.get(name)

    def set(self, name: str, value: Any, who: str = "controller") -> None:
        """Set one parameter; the value takes effect at the next `apply`.

        Parameters
        ----------
        name : str
            Name of the parameter.
        value : object
            New value.
        who : str
            Client that sets the parameter, for the log.

        Raises
        ------
        UnknownName, CommandRefused
            See `set_together`.
        """
        self.set_together({name: value}, who)

    def set_together(self, values: Mapping[str, Any], who: str = "controller", *, commander: bool = True) -> None:
        """Set several parameters in the same tick; if one value is invalid, all are refused.

        Parameters
        ----------
        values : mapping
            Values by name.
        who : str
            Client that sets the parameters, for the log.
        commander : bool
            Whether the client has the rights of a commander.

        Raises
        ------
        UnknownName
            A parameter is not declared.
        CommandRefused
            Wrong type or shape, non-finite value, value out of bounds, missing rights, too many settings in one tick,
            or, during a run, a parameter that is not live.
        """
        checked = {}
        for name, value in values.items():
            parameter = self.declared.get(name)
            if parameter is None:
                raise UnknownName.among("parameter", name, self.declared)
            if parameter.rights == "commander" and not commander:
                raise CommandRefused(
                    f"Expected the commander of an arm to set {name}, got {who}. The value is unchanged."
                )
            if self.running and not parameter.live:
                raise CommandRefused(f"Expected {name} to be set before a run, but {who} tried to set it during a run.")
            checked[name] = parameter._checked(value)
        if len(self._waiting) >= _WAITING:
            raise CommandRefused(
                f"Expected at most {_WAITING} settings per tick, got more from {who}. Send fewer settings."
            )
        self._waiting.append((checked, who))

    def apply(self) -> tuple[Change, ...]:
        """Apply the new values in order of arrival and return the changes; called between ticks."""
        changes = []
        for _ in range(len(self._waiting)):
            values, who = self._waiting.popleft()
            for name, value in values.items():
                self._sequence += 1
                self._values[name] = value
                self._last[name] = Change(self._sequence, name, value, who)
                changes.append(self._last[name])
        return tuple(changes)
