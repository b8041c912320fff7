"""`Script`: a state of the controller that changes at given times, for tests of what a peer makes of it."""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping

from armlab.errors import ConfigError, UnknownName

__all__ = ["MOTORS", "RAPID", "Script"]

MOTORS = {"undefined": 0, "on": 1, "off": 2}
"""States of the motors by name."""

RAPID = {"undefined": 0, "stopped": 1, "running": 2}
"""States of RAPID by name. Real controllers are stuck at "undefined" after a restart although RAPID runs."""


class Script:
    """A piecewise constant state over robot time.

    Parameters
    ----------
    text : one name for ever, or ``time:name`` parts with commas between, as "0:on,2.5:off,4:on"; times in seconds.
    states : numbers by name.
    """

    def __init__(self, text: str, states: Mapping[str, int]) -> None:
        self._times: list[float] = []
        self._states: list[int] = []
        for part in text.split(","):
            time, _, name = part.strip().rpartition(":")
            if name not in states:
                raise UnknownName.among("state", name, states)
            at = _number(time or "0")
            if not math.isfinite(at) or (self._times and at <= self._times[-1]):
                raise ConfigError(f"Expected states as 0:on,2.5:off with times that increase, got {text!r}.")
            self._times.append(at)
            self._states.append(states[name])

    def at(self, t: float) -> int:
        """Return the state at robot time `t`; before the first time it is the first state.

        Parameters
        ----------
        t : seconds since the start.
        """
        return self._states[max(0, bisect.bisect_right(self._times, t + 1e-9) - 1)]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
