"""`ExternalAxes`: rotary external axes beyond the robot's own joints, which follow their references without masses."""

from __future__ import annotations

import numpy as np

from armlab.errors import ConfigError
from armlab.sim.settings import Settings

__all__ = ["ExternalAxes"]

_MOST = 6
_FASTEST = 1.0  # rad/s


class ExternalAxes:
    """External axes at 0 rad that follow at the controller's position gain, at most 1 rad/s: ``q += T k (q_ref - q)``.

    Parameters
    ----------
    count : how many, at most six in all with a seventh robot axis. settings : gain and period.

    Attributes
    ----------
    q : (count,) [rad].

    Raises
    ------
    ConfigError : a count below 0 or above 6.
    """

    def __init__(self, count: int, settings: Settings) -> None:
        if not 0 <= count <= _MOST:
            raise ConfigError(f"Expected 0 to {_MOST} external axes, got {count}.")
        self.q, self._gain, self._period = np.zeros(count), settings.gain, settings.period

    def follow(self, q_ref: np.ndarray | None) -> None:
        """Advance by one period.

        Parameters
        ----------
        q_ref : references, the first `count` of them are used; None or too few for "stay".
        """
        if q_ref is None or len(q_ref) < len(self.q):
            return
        qd = np.clip(self._gain * (q_ref[: len(self.q)] - self.q), -_FASTEST, _FASTEST)
        self.q = self.q + self._period * qd
