"""`FaultRates`: how often datagrams are lost, late, doubled, swapped or damaged.

They are options of ``armlab sim``, whose help loads this file: it needs no NumPy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from armlab.errors import ConfigError

__all__ = ["FaultRates"]


@dataclass(frozen=True)
class FaultRates:
    """How often things go wrong in one direction.

    Attributes
    ----------
    loss : float
        Probability that a datagram is lost.
    duplicate : float
        Probability that it arrives twice.
    reorder : float
        Probability that it arrives one cycle later, behind its successor.
    corrupt : float
        Probability that it arrives damaged, so that nobody can read it.
    delay : tuple
        MEAN,SIGMA of a normal delay [s], never below 0, to the nearest cycle.
    pause : tuple
        START,LENGTH [s] in robot time: what is sent meanwhile arrives when the pause is over.
    burst : int
        Losses come this many in a row; `loss` stays the share of all datagrams.
    until : float
        Robot time from which on nothing goes wrong any more [s].

    Raises
    ------
    ConfigError : for a probability outside [0, 1], a time that is negative or no number, or a burst below 1.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    pause: tuple[float, float] = (0.0, 0.0)
    burst: int = 1
    until: float = math.inf

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("loss", "duplicate", "reorder", "corrupt"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"Expected {name} between 0 and 1, got {getattr(self, name)}.")
        for name in ("delay", "pause"):
            if not all(0.0 <= value < math.inf for value in getattr(self, name)):
                raise ConfigError(f"Expected two times of at least 0 s for {name}, got {getattr(self, name)}.")
        if not self.until >= 0.0:
            raise ConfigError(f"Expected until of at least 0 s, got {self.until}.")
        if self.burst < 1:
            raise ConfigError(f"Expected a burst of at least 1 datagram, got {self.burst}.")

    @property
    def any(self) -> bool:
        """Whether anything can go wrong at all."""
        rates = self.loss, self.duplicate, self.reorder, self.corrupt, *self.delay, self.pause[1]
        return any(rates)
