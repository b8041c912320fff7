"""Motions as bridge controllers: continuous references within limits, synchronised with the robot."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import ceil, copysign
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import members
from armlab.errors import ArmlabError, RobotError, ShapeError
from armlab.motion.arguments import at_least_zero, vector
from armlab.robots import Robot
from armlab.state import Command, State

if TYPE_CHECKING:
    from armlab.log import Column

MAX_STEP = 0.004
"""Longest integration step [s]."""
MAX_GAP = 0.05  # longest time between two packets [s]
_SLACK = 0.02  # fraction by which a step may exceed MAX_STEP
NEAR, SLOW = 0.01, 0.02  # rad or m, and rad/s or m/s: arrival tolerances
SETTLING_TIME = 0.1  # s: required time within both tolerances
LIMITS = ("q_min", "q_max", "qd_max", "qdd_max")
RAMP = 4.0  # 1/s, rate of change of the speed: from full speed to rest in 0.25 s
Arms = Robot | Sequence[Robot]
"""One arm, or several arms that move together."""
Pace = tuple[float, float, float]
"""Speed at the last packet and current speed, as fractions of the nominal speed; rate of change from now on [1/s]."""


class JointLimits(Protocol):
    """Limits of a reference, per joint (n,); `Robot` and `bridge.Limits` implement this protocol."""

    @property
    def q_min(self) -> np.ndarray: ...
    @property
    def q_max(self) -> np.ndarray: ...
    @property
    def qd_max(self) -> np.ndarray: ...
    @property
    def qdd_max(self) -> np.ndarray: ...


class Controller(ABC):
    """Motion controller: a callable ``State -> Command``, created by the `controller` method of a primitive.

    The controller starts at rest from the measured position whenever a robot session begins. Time advances by the
    interval between packets. Position, velocity and acceleration limits are applied last; motion lost to clipping is
    not recovered later. After arrival, the controller keeps running, because the goal may change. The run ends after a
    gap of more than 50 ms between packets, or if the start position contains NaN; `reason` states the cause.

    Parameters
    ----------
    robot : the arm, or several arms with their joints stacked as in the State of several arms.
    limits : limits of the reference for each arm; default: from the robots.
    goal : (n,) initial goal.

    Raises
    ------
    ShapeError : limits or goal with the wrong number of joints, or a goal outside the limits.

    Attributes
    ----------
    done : whether the motion has ended and the arm has been slow and near the goal for 0.1 s, ignoring NaN.
    frozen : whether the path is paused because the arm is too far from it.
    clamped : (n,) limits that clipped this reference: bits 1 position, 2 velocity, 4 acceleration, 8 braking.
    reason : why the run ended; "" during the run.
    """

    frozen: bool
    clamped: np.ndarray
    reason: str

    def __init__(self, robot: Arms, limits: JointLimits | Sequence[JointLimits] | None, goal: np.ndarray) -> None:
        arms = robots_of(robot)
        self._n, self._name = sum(arm.n for arm in arms), "+".join(arm.name for arm in arms)
        within = arms if limits is None else limits if isinstance(limits, Sequence) else (limits,)
        for name in LIMITS:
            if not all(hasattr(one, name) for one in within):
                raise ShapeError(f"Expected limits with {', '.join(LIMITS)}, got {within!r}. Pass bridge.Limits.")
        if [np.shape(one.q_min) for one in within] != [(arm.n,) for arm in arms]:
            shapes = [np.shape(one.q_min) for one in within]
            raise ShapeError(f"Expected limits for the {self._n} joints of {self._name}, got shapes {shapes}.")
        bounds = [np.concatenate([getattr(one, name) for one in within]) for name in LIMITS]
        self._bounds = np.array([*bounds, np.full(self._n, np.inf)])
        self._none = np.zeros(self._n, dtype=np.uint8)
        self._session: int | None = None
        self._rested = 0.0
        self._wanted = self._speed = 1.0
        self.done = self.frozen = False
        self.clamped, self.reason = self._none, ""
        self._goal = self._checked(goal)

    @property
    def goal(self) -> np.ndarray:
        """Goal (n,); may be set while the controller runs."""
        return self._goal

    @goal.setter
    def goal(self, g: ArrayLike) -> None:
        """Change the goal (n,)."""
        goal = self._checked(g)
        if self._session is not None:
            self._change_goal(goal)  # may raise
        self._goal = goal
        self._rested, self.done = 0.0, False

    @property
    def speed(self) -> float:
        """Speed as a fraction of the nominal speed, >= 0; may be set during the run, and is ramped at 4 per second.

        The path stays the same at every speed.
        """
        return self._wanted

    @speed.setter
    def speed(self, share: float) -> None:
        """Change the speed."""
        self._wanted = at_least_zero(share, "speed")

    def stop(self) -> None:
        """Stop on the path, within 0.25 s from full speed; set `speed` to resume."""
        self._wanted = 0.0

    def columns(self) -> dict[str, Column]:
        """Return the recorded columns, for ``link.run(extra=...)``."""
        from armlab.log import Column  # imported lazily, because armlab.log doubles the import time of armlab.motion

        own = {"qdd_ref": Column((self._n,), unit="rad/s^2"), "path": Column((self._n,), unit="rad")}
        own["limited"] = Column((self._n,), unit="1", kind="count")
        return own | {name: Column((), unit="1", kind="flag") for name in ("done", "frozen")}

    def __call__(self, state: State) -> Command:
        begins = state.session != self._session
        dt = 0.0 if begins else state.dt
        if not self._is_usable(state, dt):
            return Command.stop()
        try:
            if begins:
                self._start(state)
            q, qd, qdd, path = self._next(state, dt, self._ramp(dt))
        except ArmlabError as error:  # for example, a start without a path to the goal
            self.reason = str(error)
            return Command.stop()
        if dt > 0.0:
            q, qd = self._clipped(q, qd, dt)
        if self.reason:
            return Command.stop()
        self._check_arrival(state, dt)
        record = {"qdd_ref": qdd, "path": path, "limited": self.clamped, "done": self.done, "frozen": self.frozen}
        return Command(q, qd, record=record | self._record())

    def _record(self) -> dict[str, Any]:
        """Return the additional values recorded by a subclass."""
        return {}

    @abstractmethod
    def _begin(self, state: State) -> None:
        """Start the motion at the measured position."""

    @abstractmethod
    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return q, qd and qdd of the reference without limits, and the path (n,); dt is 0 in the first call."""

    @abstractmethod
    def _change_goal(self, g: np.ndarray) -> None:
        """Change the goal."""

    @property
    @abstractmethod
    def _is_over(self) -> bool:
        """Return whether the motion has ended."""

    def _start(self, state: State) -> None:
        self._session, self._rested, self._speed = state.session, 0.0, self._wanted
        self.done, self.frozen, self.clamped = False, False, self._none
        self._sent = np.stack((state.q, np.zeros_like(state.q), np.zeros_like(state.q)))
        self._begin(state)

    def _is_usable(self, state: State, dt: float) -> bool:
        if not 0.0 <= dt <= MAX_GAP:
            self.reason = f"Expected packets at most {1e3 * MAX_GAP:.0f} ms apart, got {1e3 * dt:.1f} ms."
        elif state.session != self._session and not np.isfinite(state.q).all():
            self.reason = "Expected a finite position to start from, got NaN."
        return not self.reason

    def _ramp(self, dt: float) -> Pace:
        before, room = self._speed, self._wanted - self._speed
        if room == 0.0:
            return before, before, 0.0
        self._speed = before + min(max(room, -RAMP * dt), RAMP * dt)
        left = self._wanted - self._speed
        return before, self._speed, copysign(RAMP, left) if abs(left) > 1e-9 else 0.0

    def _clipped(self, q: np.ndarray, qd: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        sent, self.clamped, _, refused = kernels.limit_reference(self._sent, self._bounds, dt, q, self._sent[0], qd)
        if refused:
            self.reason = f"Expected a finite reference, got NaN or Inf for joint {abs(refused)}."
        self._sent = sent
        return sent[0], sent[2]

    def _check_arrival(self, state: State, dt: float) -> None:
        if np.isnan(_largest(state.q) + _largest(state.qd)):  # a lost measurement does not prove arrival
            return
        rests = self._is_over and self._is_near(state) and _largest(state.qd) < SLOW
        self._rested = self._rested + dt if rests else 0.0
        self.done: bool = self._rested >= SETTLING_TIME

    def _is_near(self, state: State) -> bool:
        return _largest(state.q - self._goal) < NEAR

    def _checked(self, g: ArrayLike) -> np.ndarray:
        goal = vector(g, "g", self._n)
        outside = (goal < self._bounds[0]) | (goal > self._bounds[1])
        if outside.any():
            i = int(np.argmax(outside))
            raise ShapeError(
                f"Expected a goal within the limits, got {goal[i]:g} for joint {i + 1} of {self._name}, whose range is "
                f"{self._bounds[0, i]:g} to {self._bounds[1, i]:g}."
            )
        return np.array(goal)


def robots_of(robot: Arms) -> tuple[Robot, ...]:
    """Return one or more arms as a tuple."""
    arms = (robot,) if isinstance(robot, Robot) else members(robot, "robot")
    for arm in arms:
        if not isinstance(arm, Robot):
            raise RobotError.no_robot(arm)
    return arms


def _largest(values: np.ndarray) -> float:
    return float(np.maximum.reduce(np.abs(values)))  # twice as fast as max() on small arrays; propagates NaN


def steps_in(dt: float) -> int:
    """Return the number of integration steps of at most 4 ms in dt [s]; ABB's cycle of 4.032 ms counts as one step."""
    return max(1, ceil(dt / MAX_STEP - _SLACK)) if dt < np.inf else 1


def own_steps(dt: float, pace: Pace) -> list[float]:
    """Return the integration steps [s] on the motion's own clock for a packet that arrives after dt [s]."""
    parts, way = steps_in(dt), 0.5 * (pace[0] + pace[1]) * dt
    return [way / parts] * parts if way > 0.0 else []


def at_pace(state: Sequence[np.ndarray], pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return q, qd and qdd of the reference, and the path, from the state (y, yd, ydd) of a motion at nominal speed."""
    (y, yd, ydd), (_, speed, change) = state, pace
    return y, speed * yd, speed**2 * ydd + change * yd, y


def check_joints(robot: Arms, n: int) -> None:
    """Raise an error unless the n coordinates of a motion match the total number of joints of all arms."""
    arms = robots_of(robot)
    joints, names = sum(arm.n for arm in arms), " and ".join(arm.name for arm in arms)
    if n != joints:
        raise ShapeError(f"Expected a motion with {joints} joints for {names}, got {n} coordinates.")
