"""How the simulated controller turns references into motion: `Settings` and `Guidance` (joint mode).

Per cycle, per joint, T = period (ABB 3HAC073318-001, section 2.3; the filter is our model, ABB gives no number)::

    v* = w (k g (q_ref - p) + qd_ref),   w = min(1, time / ramp_in)
    v* is scaled for all joints by min(1, max_speed / max |v*|)
    v += (1 - exp(-2 pi f T)) (v* - v), once for level 0, twice in series for levels 1 and 2
    p += v T

At constant speed without qd_ref the reference p lags by v / (k g): 2 degrees at 10 deg/s with k = 5. With qd_ref it
does not lag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armlab.errors import ConfigError, UnknownName
from armlab.robots import Robot
from armlab.wire.egm.linkage import Linkage

__all__ = ["Guidance", "Settings"]

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
    "mode": ("joint", "pose", "path"),
    "activated": (None, "joint", "pose", "path"),
}

_OVERSHOOT = 0.02  # rad: the filters may carry a reference that stops at a limit this far beyond it


@dataclass(frozen=True)
class Settings:
    """What RAPID and the system parameters set on a real controller; the defaults follow our RAPID templates.

    Attributes
    ----------
    period : float
        Time between two packets [s]; 4.032 ms on a real controller.
    gain : float
        k, the proportional position gain [1/s].
    filter : float
        LpFilter, bandwidth of the speed filter [Hz].
    level : int
        0 filters once, 1 and 2 twice.
    position_gain : float
        g, PosCorrGain; 0 is pure velocity control.
    ramp_in : float
        RampInTime [s].
    max_deviation : float
        MaxPosDeviation from where guidance began [rad].
    max_speed : float
        MaxSpeedDeviation [rad/s]; never more than the fastest joint of the robot allows.
    window : float
        Half width of the convergence window [rad]; 0 is never converged.
    condition_time : float
        CondTime, how long the window must be met to end the session [s].
    comm_timeout : float
        CommTimeout, silence that ends the session [s].
    stream : float
        Time of packets before guidance begins, MCI stopped [s].
    restart : float
        Time from the end of a session to the next [s].
    program : str
        "loop" begins another session when one ends, "once" does not. "stream" only streams, without guidance;
        "lead-through" too, while a hand leads the arm.
    stream_queue : str
        What becomes of messages that arrive while the controller only streams: "drop", or "keep" for the guidance
        after it. Which of them a real controller does is not known.
    mode : str
        What is guided, and so what messages must hold: "joint" references, a "pose", or corrections of a "path".
    activated : str
        The mode that RAPID prepared; another than `mode` plays event 41826. None for the same.

    Raises
    ------
    ConfigError : for a value outside its range.
    """

    period: float = 0.004032
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
    mode: Literal["joint", "pose", "path"] = "joint"
    activated: Literal["joint", "pose", "path"] | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"Expected {name} of the simulated controller in [{low:g}, {high:g}], got {value}.")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise UnknownName.among(
                    f"{name} of the simulated controller", getattr(self, name), filter(None, choices)
                )

    @property
    def only_streams(self) -> bool:
        """Whether guidance never begins."""
        return self.program in ("stream", "lead-through")

    @classmethod
    def abb_defaults(cls) -> Settings:
        """Return what ABB's own defaults give: hardly any speed, and sessions that end when the robot stands still."""
        return cls(max_speed=math.radians(1.0), window=math.radians(0.5))


class Guidance:
    """The reference generator between received references and the drives.

    Parameters
    ----------
    robot : for limits. settings : see `Settings`. q : (n,) where it starts.

    Attributes
    ----------
    q, qd : (n,) the reference that the drives follow; never written in place.
    utilization : percent of the speed limits that the last reference needed.
    """

    def __init__(self, robot: Robot, settings: Settings, q: np.ndarray) -> None:
        self._robot, self._settings, self._linkage = robot, settings, Linkage.of(robot)
        self._pole = 1.0 - math.exp(-2.0 * math.pi * settings.filter * settings.period)
        self._stages = 1 if settings.level == 0 else 2
        self._brake = robot.qdd_max * settings.period
        self._fastest = min(settings.max_speed, float(robot.qd_max.max()))
        self.q, self.qd = np.array(q), np.zeros(robot.n)
        self.utilization = 0.0
        self.begin()

    def begin(self) -> None:
        """Start guidance from here: the ramp, the filters and the deviation count from now."""
        self._start, self._time = self.q, 0.0
        self._filters = [self.qd] * self._stages

    def follow(self, q_ref: np.ndarray | None, qd_ref: np.ndarray | None) -> None:
        """Advance by one period towards a reference.

        Parameters
        ----------
        q_ref : (n,) or None for "stay" (nothing was received yet). qd_ref : (n,) or None for zero.
        """
        settings = self._settings
        self._time += settings.period
        wanted = (
            settings.gain * settings.position_gain * (q_ref - self.q) if q_ref is not None else np.zeros_like(self.q)
        )
        if qd_ref is not None:
            wanted = wanted + qd_ref
        if self._time < settings.ramp_in:
            wanted = wanted * (self._time / settings.ramp_in)
        self.utilization = 100.0 * float((np.abs(wanted) / self._robot.qd_max).max())
        fastest = float(np.abs(wanted).max())
        if fastest > self._fastest:
            wanted = wanted * (self._fastest / fastest)
        for i, state in enumerate(self._filters):
            wanted = self._filters[i] = state + self._pole * (wanted - state)
        self.qd = wanted
        self.q = self.q + wanted * settings.period

    def lead(self, q: np.ndarray, qd: np.ndarray) -> None:
        """Be where a hand leads the arm.

        Parameters
        ----------
        q, qd : (n,) position and velocity of the hand.
        """
        self.q, self.qd, self.utilization = q, qd, 0.0

    def let_go(self, q: np.ndarray, free: np.ndarray) -> None:
        """Follow the arm in joints whose position nobody controls, so that control can come back without a jump.

        Parameters
        ----------
        q : (n,) where the arm is. free : (n,) which joints.
        """
        self.q = np.where(free, q, self.q)

    def brake(self) -> None:
        """Advance by one period while the speed goes to zero at the robot's acceleration limits."""
        self.qd = np.sign(self.qd) * np.maximum(np.abs(self.qd) - self._brake, 0.0)
        self.q = self.q + self.qd * self._settings.period
        self.utilization = 0.0

    def violation(self) -> str:
        """Return in words which limit the reference has left, or nothing."""
        outside = self._outside(self.q, _OVERSHOOT)
        far = np.abs(self.q - self._start) > self._settings.max_deviation
        if outside.any():
            return f"reference of {self._joint(outside)} left the range of the joint"
        if far.any():
            return f"reference of {self._joint(far)} went further than the position deviation allowed"
        return ""

    def refusal(self, q_ref: np.ndarray) -> str:
        """Return in words which joint of a received reference is out of bounds, or nothing.

        Parameters
        ----------
        q_ref : (n,).
        """
        outside = self._outside(q_ref, 0.0)
        return f"reference of {self._joint(outside)} out of bounds" if outside.any() else ""

    def _outside(self, q: np.ndarray, margin: float) -> np.ndarray:
        """Return which of ABB's axes are out of their range; they are the joints, but for a robot with a rod."""
        axes = q if self._linkage is None else self._linkage.axes(q)
        return (axes < self._robot.q_min - margin) | (axes > self._robot.q_max + margin)

    def _joint(self, which: np.ndarray) -> str:
        i = int(np.argmax(which))
        return f"joint {i + 1} ({self._robot.joint_names[i]})"

    def near(self, q_ref: np.ndarray | None) -> bool:
        """Return whether the reference has arrived within the convergence window of `q_ref` (n,).

        Parameters
        ----------
        q_ref : (n,) or None.
        """
        window = self._settings.window
        return window > 0 and q_ref is not None and bool((np.abs(q_ref - self.q) <= window).all())
