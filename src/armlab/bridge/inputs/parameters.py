"""Parameters of a run: named, typed and bounded values that any client may set and a controller reads as attributes."""

from __future__ import annotations

import math
import re
import sys
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from armlab.errors import CommandRefused, ConfigError, UnknownName

_TYPES = ("float", "int", "bool", "text")
_VECTOR = re.compile(r"float\[([1-9]\d{0,2})\]")
_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]{0,63}")
_LONGEST = 1000  # characters of a text
_WAITING = 256  # settings that wait for the next tick
_LARGEST = sys.float_info.max
_INTEGERS = 2**53  # beyond it a JSON reader may round


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter as declared.

    Attributes
    ----------
    name : a word, as in ``params.gain``.
    default : its first value.
    type : "float", "int", "bool", "text" or "float[k]" for k numbers.
    unit : SI.
    minimum, maximum : bounds of each number.
    text : one sentence.
    rights : who may set it: the "commander" of an arm, or "anyone".
    live : may be set during a run.

    Raises
    ------
    ConfigError : a declaration that is wrong in itself; names the parameter.
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
                f"Expected the name of a parameter to be a word of letters, digits and _ that is free, "
                f"got {self.name!r}. Choose another."
            )
        if self.type not in _TYPES and not _VECTOR.fullmatch(self.type):
            raise ConfigError(f"Expected type float, int, bool, text or float[k] of {self.name}, got {self.type!r}.")
        if self.rights not in ("commander", "anyone"):
            raise ConfigError(f'Expected rights "commander" or "anyone" of {self.name}, got {self.rights!r}.')
        if not self.minimum <= self.maximum:  # also NaN
            raise ConfigError(f"Expected bounds in order of {self.name}, got {self.minimum} and {self.maximum}.")
        try:
            object.__setattr__(self, "default", self._checked(self.default))
        except CommandRefused as error:
            raise ConfigError(f"Expected a default that may be set. {error}") from None

    @property
    def _size(self) -> int:
        """Numbers of a "float[k]", else 0."""
        match = _VECTOR.fullmatch(self.type)
        return int(match[1]) if match else 0

    def _checked(self, value: Any) -> Any:
        """Return a value as it is kept: float, int, bool, str or a read-only array (k,)."""
        if self.type == "bool":
            if not isinstance(value, (bool, np.bool_)):
                raise self._refused("true or false", value)
            return bool(value)
        if self.type == "text":
            if not isinstance(value, str) or len(value) > _LONGEST:
                raise self._refused(f"a text of at most {_LONGEST} characters", value)
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
            raise self._refused("a number that a float can hold", value)
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
        except ValueError:  # an integer of too many digits
            got = f"a {type(value).__name__} too long to show"
        return CommandRefused(f"Expected {expected} for the parameter {self.name}{unit}, got {got}. Its value stays.")


class Change(NamedTuple):
    """One value that came into force."""

    sequence: int
    name: str
    value: Any
    who: str

    @property
    def sentence(self) -> str:
        """What happened, for the events of a log."""
        value = self.value.tolist() if isinstance(self.value, np.ndarray) else self.value
        return f"Parameter {self.name} = {value!r}, set by {self.who} (setting {self.sequence})."


class Parameters:
    """The parameters of a run; ``params.gain`` is the value in force.

    A value that is set is checked at once and comes into force between two ticks; several that are set together do so
    together, or none of them.

    Parameters
    ----------
    declared : what there is.

    Attributes
    ----------
    declared : by name.
    running : while True, parameters that are not `live` cannot be set.

    Raises
    ------
    ConfigError : a name declared twice.

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
            raise ConfigError(f"Expected each parameter once, got {', '.join(names)}. Remove one of the same name.")
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
        """Return the values in force by name."""
        return dict(self._values)

    def last(self, name: str) -> Change | None:
        """Return the last change of a parameter, None while it has its default.

        Parameters
        ----------
        name : of the parameter.

        Raises
        ------
        UnknownName : no such parameter.
        """
        if name not in self.declared:
            raise UnknownName.among("parameter", name, self.declared)
        return self._last.get(name)

    def set(self, name: str, value: Any, who: str = "controller") -> None:
        """Set one parameter; it comes into force at the next `apply`.

        Parameters
        ----------
        name, value : what.
        who : sets it, for the log.

        Raises
        ------
        UnknownName, CommandRefused : see `set_together`.
        """
        self.set_together({name: value}, who)

    def set_together(self, values: Mapping[str, Any], who: str = "controller", *, commander: bool = True) -> None:
        """Set several parameters in the same tick, or none of them when one is refused.

        Parameters
        ----------
        values : by name.
        who : sets them, for the log.
        commander : whether he has the rights of a commander.

        Raises
        ------
        UnknownName : no such parameter.
        CommandRefused : wrong type or shape, not finite, outside the bounds, without the right, not during a run, or
            too many settings for one tick.
        """
        checked = {}
        for name, value in values.items():
            parameter = self.declared.get(name)
            if parameter is None:
                raise UnknownName.among("parameter", name, self.declared)
            if parameter.rights == "commander" and not commander:
                raise CommandRefused(f"Expected the commander of an arm to set {name}, got {who}. Its value stays.")
            if self.running and not parameter.live:
                raise CommandRefused(f"Expected {name} to be set before a run, got it from {who} during one.")
            checked[name] = parameter._checked(value)
        if len(self._waiting) >= _WAITING:
            raise CommandRefused(f"Expected at most {_WAITING} settings in one tick, got more from {who}. Send fewer.")
        self._waiting.append((checked, who))

    def apply(self) -> tuple[Change, ...]:
        """Bring what was set into force, in the order of arrival. Call it between two ticks; returns the changes."""
        if not self._waiting:
            return ()
        changes = []
        for _ in range(len(self._waiting)):
            values, who = self._waiting.popleft()
            for name, value in values.items():
                self._sequence += 1
                self._values[name] = value
                self._last[name] = Change(self._sequence, name, value, who)
                changes.append(self._last[name])
        return tuple(changes)
