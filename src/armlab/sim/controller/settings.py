"""Options of ``armlab sim``: `ControllerSettings` and `FaultRates`; this file loads without NumPy, so the command help
is fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from armlab.errors import ConfigError, UnknownName

_RANGES: dict[str, tuple[float, float]] = {
    "period": (1e-4, 0.1),
    "gain": (0.0, 20.0),
    "filter": (0.1, 100.0),
    "level": (0, 2),
    "position_gain": (0.0, 1.0),
    "ramp_in": (0.005, 10.0),
    "max_deviation": (0.0, math.inf),
    "max_speed": (0.0, math.inf),
    "window": (0.0, math.inf),
    "condition_time": (0.0, math.inf),
    "comm_timeout": (1e-3, math.inf),
    "stream": (0.0, 1e6),
    "restart": (0.0, math.inf),
}

_CHOICES = {
    "program": ("loop", "once", "stream", "lead-through"),
    "stream_queue": ("drop", "keep"),
    "queue": ("fifo", "newest"),
    "mode": ("joint", "pose", "path"),
    "activated": (None, "joint", "pose", "path"),
}


_PERIODS = {"joint": 0.004032, "pose": 0.004032, "path": 0.024}  # s


@dataclass(frozen=True)
class ControllerSettings:
    """RAPID and system parameters of the controller, with defaults from armlab's RAPID templates.

    Attributes
    ----------
    period : float
        Time between two packets, and between two messages taken from the queue [s]. 0 selects 4.032 ms as on a real
        controller, or 24 ms for path corrections, the default of RAPID's \\SampleRate.
    gain : float
        Proportional position gain k [1/s].
    filter : float
        LpFilter: bandwidth of the speed filter [Hz].
    level : int
        Filter level: 0 filters once, 1 and 2 filter twice.
    position_gain : float
        PosCorrGain g; 0 selects pure velocity control.
    ramp_in : float
        RampInTime [s].
    max_deviation : float
        MaxPosDeviation from the start of guidance [rad].
    max_speed : float
        MaxSpeedDeviation [rad/s], limited to the speed of the robot's fastest joint.
    window : float
        Half-width of the convergence window [rad]; 0 disables convergence.
    condition_time : float
        CondTime: time within the window that ends the session [s].
    comm_timeout : float
        CommTimeout: duration of silence that ends the session [s].
    stream : float
        Duration of streaming (MCI stopped) before guidance begins [s].
    restart : float
        Time from the end of a session to the start of the next [s].
    program : str
        "loop" starts another session when a session ends, "once" does not. "stream" sends packets without guidance.
        "lead-through" streams while a hand guides the arm.
    stream_queue : str
        Treatment of messages that arrive while the controller only streams: "drop", or "keep" for the following
        guidance. The behaviour of a real controller is unknown.
    queue : str
        Message taken by a cycle: "fifo" takes the oldest message, as in ABB's manual. "newest" takes the newest message
        and drops all others.
    mode : str
        Kind of guidance and required content of messages: "joint" references, a "pose", or corrections of a "path".
    activated : str
        Mode activated by RAPID; if it differs from `mode`, event 41826 occurs. None: same as the configured mode.

    Raises
    ------
    ConfigError : if a value is outside its range.
    """

    period: float = 0.0
    gain: float = 5.0
    filter: float = 20.0
    level: int = 1
    position_gain: float = 1.0
    ramp_in: float = 0.5
    max_deviation: float = math.radians(1000.0)
    max_speed: float = math.inf
    window: float = 0.0
    condition_time: float = 1.0
    comm_timeout: float = 1.0
    stream: float = 0.0
    restart: float = 0.2
    program: Literal["loop", "once", "stream", "lead-through"] = "loop"
    stream_queue: Literal["drop", "keep"] = "drop"
    queue: Literal["fifo", "newest"] = "fifo"
    mode: Literal["joint", "pose", "path"] = "joint"
    activated: Literal["joint", "pose", "path"] | None = None

    def __post_init__(self) -> None:
        """Validate the ranges and set the default period of the mode."""
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise UnknownName.among(
                    f"{name} of the simulated controller", getattr(self, name), filter(None, choices)
                )
        object.__setattr__(self, "period", self.period or _PERIODS[self.mode])
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"Expected {name} of the simulated controller in [{low:g}, {high:g}], got {value}.")

    @property
    def only_streams(self) -> bool:
        """Whether guidance never begins."""
        return self.program in ("stream", "lead-through")

    @classmethod
    def abb_defaults(cls) -> ControllerSettings:
        """Return ABB's default settings, with a very low speed and sessions that end when the robot is at rest."""
        return cls(max_speed=math.radians(1.0), window=math.radians(0.5))


@dataclass(frozen=True)
class FaultRates:
    """Rates of network faults in one direction.

    Attributes
    ----------
    loss : float
        Probability that a datagram is lost.
    duplicate : float
        Probability that a datagram arrives twice.
    reorder : float
        Probability that a datagram arrives one cycle later, behind its successor.
    corrupt : float
        Probability that a datagram arrives corrupted.
    delay : tuple
        MEAN,SIGMA of a normally distributed delay [s]; delays are at least 0 and rounded to cycles.
    pause : tuple
        START,LENGTH in robot time [s]: datagrams sent in this interval arrive at its end.
    burst : int
        Length of loss bursts in datagrams; `loss` remains the overall fraction of lost datagrams.
    until : float
        Robot time at which faults end [s].

    Raises
    ------
    ConfigError : if a probability is outside [0, 1], a time is negative or not a number, or a burst is below 1.
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
        """Validate the ranges."""
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
        """Whether any fault is configured."""
        rates = self.loss, self.duplicate, self.reorder, self.corrupt, *self.delay, self.pause[1]
        return any(rates)
