"""External events of a simulated controller: wrenches, grips, lead-through, state changes (`Surroundings`)."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.lie import so3
from armlab.robots import Robot

MOTORS = {"undefined": 0, "on": 1, "off": 2}
"""Motor states by name."""

RAPID = {"undefined": 0, "stopped": 1, "running": 2}
"""RAPID states by name. Real controllers may report "undefined" after a restart, although RAPID is running."""


class StateScript:
    """Piecewise constant state over robot time [s], given as one name or as "0:on,2.5:off,4:on"."""

    def __init__(self, text: str, states: Mapping[str, int]) -> None:
        self._times: list[float] = []
        self._states: list[int] = []
        for part in text.split(","):
            time, _, name = part.strip().rpartition(":")
            if name not in states:
                raise UnknownName.among("state", name, states)
            try:
                at = float(time or "0")
            except ValueError:
                at = math.nan
            if not math.isfinite(at) or (self._times and at <= self._times[-1]):
                raise ConfigError(f"Expected states as 0:on,2.5:off with increasing times, got {text!r}.")
            self._times.append(at)
            self._states.append(states[name])

    def at(self, t: float) -> int:
        """Return the state at robot time `t`; the first state also applies before its start time."""
        return self._states[max(0, bisect.bisect_right(self._times, t + 1e-9) - 1)]


class AppliedWrench:
    """Wrench exerted by the environment at the tool point: linear between its rows and zero outside them.

    `t`: (N,) increasing times since guidance began [s]. `wrench`: (N, 6) rows ``[f; m]`` [N, N m] in base axes; for
    example, ``[0, 0, -9.80665, 0, 0, 0]`` is the weight of 1 kg.
    """

    def __init__(self, t: np.ndarray, wrench: np.ndarray) -> None:
        self._t = np.array(t, dtype=np.float64)
        self._wrench = np.array(wrench, dtype=np.float64)
        if self._t.ndim != 1 or self._wrench.shape != (len(self._t), 6):
            raise ShapeError(
                f"Expected times (N,) and wrenches (N, 6), got {self._t.shape} and {self._wrench.shape}. "
                "Pass one wrench per time."
            )
        bad = np.flatnonzero(~(np.isfinite(self._t) & np.isfinite(self._wrench).all(axis=1)))
        if bad.size:
            raise ShapeError(f"Expected finite times and wrenches, got a non-finite value in row {bad[0] + 1}.")
        late = np.flatnonzero(np.diff(self._t) <= 0)
        if late.size:
            raise ShapeError(
                f"Expected increasing times, got {self._t[late[0] + 1]:g} s after {self._t[late[0]]:g} s "
                f"in row {late[0] + 2}."
            )

    def at(self, t: float) -> np.ndarray | None:
        """Return the wrench (6,) at guidance time `t`, or None if there is no contact."""
        times = self._t
        if not len(times) or t < times[0] or t > times[-1]:
            return None
        i = int(np.searchsorted(times, t, side="right"))
        if i == len(times):
            return self._wrench[-1]
        share = (t - times[i - 1]) / (times[i] - times[i - 1])
        return self._wrench[i - 1] + share * (self._wrench[i] - self._wrench[i - 1])


STIFFNESS = np.array([800.0, 800.0, 800.0, 15.0, 15.0, 15.0])  # N/m, N m/rad
DAMPING = np.array([60.0, 60.0, 60.0, 1.0, 1.0, 1.0])  # N s/m, N m s/rad
STRENGTH = np.repeat([80.0, 8.0], 3)  # N, N m


class Grip:
    """Hand that grips the tool from `start` to `end` in guidance time [s]: a spring-damper with limited force."""

    def __init__(self, start: float, end: float) -> None:
        if not -np.inf < start < end < np.inf:
            raise ConfigError(f"Expected a grip that ends after it starts, got {start} to {end} s.")
        self._start, self._end = float(start), float(end)
        self._T_base_tool: np.ndarray | None = None
        self._before: tuple[float, np.ndarray] | None = None

    def at(self, t: float, T_base_tool: np.ndarray) -> np.ndarray | None:
        """Return the wrench (6,) of the hand on the robot in base axes at the tool point, or None while inactive."""
        if not self._start <= t < self._end:
            self._T_base_tool = self._before = None
            return None
        if self._T_base_tool is None:
            self._T_base_tool = T_base_tool
        held, tool = self._T_base_tool, T_base_tool
        away = np.concatenate([tool[:3, 3] - held[:3, 3], so3.log(tool[:3, :3] @ held[:3, :3].T)])
        speed = np.zeros(6)
        if self._before is not None and t > self._before[0]:
            speed = (away - self._before[1]) / (t - self._before[0])
        self._before = (t, away)
        return np.clip(-STIFFNESS * away - DAMPING * speed, -STRENGTH, STRENGTH)


_WAVES = 3
_SHARE_OF_RANGE, _SHARE_OF_SPEED = 0.25, 0.1


class HandPath:
    """Joint path along which a hand guides the arm: cubic between the rows and constant before the first and after the
    last row.

    `t`: (N,) increasing times since the stream began [s], at least two. `q`: (N, n) joint positions [rad or m].
    """

    def __init__(self, t: np.ndarray, q: np.ndarray) -> None:
        self._t, self._q = np.array(t, dtype=np.float64), np.array(q, dtype=np.float64)
        if self._t.ndim != 1 or self._q.ndim != 2 or len(self._t) != len(self._q) or len(self._t) < 2:
            raise ShapeError(
                f"Expected times (N,) and postures (N, n) with at least two rows, got {self._t.shape} and "
                f"{self._q.shape}. Pass one posture per time stamp."
            )
        if not (np.isfinite(self._t).all() and np.isfinite(self._q).all() and (np.diff(self._t) > 0).all()):
            raise ShapeError(
                "Expected finite postures at finite, increasing times, got "
                "non-finite or non-increasing values. Correct the rows."
            )
        slopes = np.gradient(self._q, self._t, axis=0)
        slopes[[0, -1]] = 0.0
        self._slopes = slopes

    @classmethod
    def random(cls, robot: Robot, seed: int | Sequence[int] = 0, seconds: float = 600.0) -> HandPath:
        """Return a smooth random path that starts and ends at home, within the joint limits and below 10 % of the speed
        limits."""
        draw = np.random.default_rng(seed)
        t = np.arange(0.0, seconds + 1e-9, 0.05)
        room = _SHARE_OF_RANGE * np.minimum(robot.q_max - robot.q_home, robot.q_home - robot.q_min) / _WAVES
        q = np.tile(robot.q_home, (len(t), 1))
        for _ in range(_WAVES):
            w = 2.0 * np.pi * np.round(seconds * draw.uniform(0.05, 0.3, robot.n)).clip(1) / seconds
            reach = np.minimum(room, _SHARE_OF_SPEED * robot.qd_max / (_WAVES * w)) * draw.uniform(-1.0, 1.0, robot.n)
            q += reach * (1.0 - np.cos(w * t[:, None]))
        return cls(t, q)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self._q.shape[1]

    def at(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the joint positions and velocities, each (n,), at a time since the stream began [s]."""
        times = self._t
        if not times[0] <= t < times[-1]:
            return self._q[0 if t < times[0] else -1], np.zeros(self.n)
        i = int(np.searchsorted(times, t, side="right")) - 1
        h = times[i + 1] - times[i]
        s = (t - times[i]) / h
        start, end, v0, v1 = self._q[i], self._q[i + 1], h * self._slopes[i], h * self._slopes[i + 1]
        c2, c3 = 3 * (end - start) - 2 * v0 - v1, 2 * (start - end) + v0 + v1
        return start + s * (v0 + s * (c2 + s * c3)), (v0 + s * (2 * c2 + 3 * s * c3)) / h


@dataclass(frozen=True)
class Surroundings:
    """External events of one controller, which sends packets only while `is_open` returns True (a RAPID program is
    running EGM)."""

    operator: AppliedWrench | None = None
    hand: HandPath | None = None
    motors: StateScript = field(default_factory=lambda: StateScript("on", MOTORS))
    rapid: StateScript = field(default_factory=lambda: StateScript("running", RAPID))
    external: int = 0
    grip: Grip | None = None
    is_open: Callable[[], bool] = lambda: True

    def wrench(self, t: float, T_base_tool: np.ndarray) -> np.ndarray | None:
        """Return the total wrench (6,) of all hands in base axes at the tool point at a guidance time [s], or None."""
        both = self.operator and self.operator.at(t), self.grip and self.grip.at(t, T_base_tool)
        acting = [wrench for wrench in both if wrench is not None]
        return np.sum(acting, axis=0) if acting else None

    def leads(self, program: str, n: int) -> HandPath | None:
        """Return the path of the hand that guides the arm in a lead-through program, or None for other programs."""
        hand = self.hand if program == "lead-through" else None
        if hand is not None and hand.n != n:
            raise ShapeError(f"Expected a hand path of {n} joints, got a path of {hand.n}.")
        return hand

    def is_ready(self, t: float) -> bool:
        """Return whether motors and RAPID allow guidance at a robot time [s]; an undefined RAPID state is accepted."""
        return self.motors.at(t) == MOTORS["on"] and self.rapid.at(t) != RAPID["stopped"]
