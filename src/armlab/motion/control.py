"""Motions as controllers of the bridge: no jump, within limits, at the pace of the robot."""

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

LONGEST_STEP = 0.004
"""Longest step of integration [s]."""
LONGEST_GAP = 0.05  # s between two packets
_SLACK = 0.02  # of a step
NEAR, SLOW = 0.01, 0.02  # rad or m, and per second: arrived, when it lasts
RESTS = 0.1  # s
LIMITS = ("q_min", "q_max", "qd_max", "qdd_max")
RAMP = 4.0  # 1/s, of the speed: from full speed to a stop in 0.25 s
Arms = Robot | Sequence[Robot]
"""An arm, or several that move together."""
Pace = tuple[float, float, float]
"""Speed at the last packet and now, as a share of the motion's own, and its change per second from now."""


class JointLimits(Protocol):
    """What a reference may do, per joint (n,): a `Robot` is one, and so is `bridge.Limits`."""

    @property
    def q_min(self) -> np.ndarray: ...
    @property
    def q_max(self) -> np.ndarray: ...
    @property
    def qd_max(self) -> np.ndarray: ...
    @property
    def qdd_max(self) -> np.ndarray: ...


class Controller(ABC):
    """A motion as a controller: a callable ``State -> Command``; made by the `controller` of what moves.

    It starts anew from the measured position, at rest, when a session of the robot begins. Time is what lies between
    packets. Position, velocity and acceleration limits act last; what they cut off is not caught up with later. At the
    goal it holds, for the goal may change. A gap of more than 50 ms between packets, and a state that is not finite,
    end the run; `reason` says why.

    Parameters
    ----------
    robot : the arm, or several whose joints are one after another, as in a State of several.
    limits : of the reference, one per arm; those of the robots when None. goal : (n,) first goal.

    Raises
    ------
    ShapeError : limits or goal of another number of joints, or a goal outside the limits.

    Attributes
    ----------
    done : the arm has been near the goal and slow for 0.1 s, and the motion is over. Measurements of NaN do not count.
    frozen : the path stands still because the arm is too far from it.
    clamped : (n,) limits that acted on this reference: bits 1 position, 2 velocity, 4 acceleration, 8 braking.
    reason : why it ended the run, "" before.
    """

    def __init__(self, robot: Arms, limits: JointLimits | Sequence[JointLimits] | None, goal: np.ndarray) -> None:
        arms = robots_of(robot)
        self._n, self._name = sum(arm.n for arm in arms), "+".join(arm.name for arm in arms)
        within = arms if limits is None else limits if isinstance(limits, Sequence) else (limits,)
        for name in LIMITS:
            if not all(hasattr(one, name) for one in within):
                raise ShapeError(f"Expected limits with {', '.join(LIMITS)}, got {within!r}. bridge.Limits has them.")
        if [np.shape(one.q_min) for one in within] != [(arm.n,) for arm in arms]:
            shapes = [np.shape(one.q_min) for one in within]
            raise ShapeError(f"Expected limits of the {self._n} joints of {self._name}, got shapes {shapes}.")
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
        """Where it goes (n,); may be set while it runs."""
        return self._goal

    @goal.setter
    def goal(self, g: ArrayLike) -> None:
        """Go for another goal (n,) from now on."""
        goal = self._checked(g)
        if self._session is not None:
            self._change_goal(goal)  # may refuse it
        self._goal = goal
        self._rested, self.done = 0.0, False

    @property
    def speed(self) -> float:
        """Speed as a share of the motion's own, from 0; may be set while it runs, and is reached at 4 per second.

        The path stays the same at every speed.
        """
        return self._wanted

    @speed.setter
    def speed(self, share: float) -> None:
        """Go on faster or slower."""
        self._wanted = at_least_zero(share, "speed")

    def stop(self) -> None:
        """Come to rest on the path within 0.25 s at full speed; setting `speed` goes on."""
        self._wanted = 0.0

    def columns(self) -> dict[str, Column]:
        """Return what it records, for ``link.run(extra=...)``."""
        from armlab.log import Column  # half the time of importing motions, which need no logs

        own = {"qdd_ref": Column((self._n,), unit="rad/s^2"), "path": Column((self._n,), unit="rad")}
        own["limited"] = Column((self._n,), unit="1", kind="count")
        return own | {name: Column((), unit="1", kind="flag") for name in ("done", "frozen")}

    def __call__(self, state: State) -> Command:
        """Return the reference for a packet."""
        begins = state.session != self._session
        dt = 0.0 if begins else state.dt
        if not self._is_usable(state, dt):
            return Command.stop()
        try:
            if begins:
                self._start(state)
            q, qd, qdd, path = self._next(state, dt, self._ramp(dt))
        except ArmlabError as error:  # such as a start from which no way leads to the goal
            self.reason = str(error)
            return Command.stop()
        if dt > 0.0:
            q, qd = self._limited(q, qd, dt)
        if self.reason:
            return Command.stop()
        self._judge(state, dt)
        record = {"qdd_ref": qdd, "path": path, "limited": self.clamped, "done": self.done, "frozen": self.frozen}
        return Command(q, qd, record=record | self._record())

    def _record(self) -> dict[str, Any]:
        """Return what this kind records besides."""
        return {}

    @abstractmethod
    def _begin(self, state: State) -> None:
        """Start the motion where the arm is."""

    @abstractmethod
    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return q, qd and qdd of the reference before limits, and the path (n,); dt is 0 at the first call."""

    @abstractmethod
    def _change_goal(self, g: np.ndarray) -> None:
        """Go for another goal."""

    @property
    @abstractmethod
    def _is_over(self) -> bool:
        """Whether the motion has run through."""

    def _start(self, state: State) -> None:
        self._session, self._rested, self._speed = state.session, 0.0, self._wanted
        self.done, self.frozen, self.clamped = False, False, self._none
        self._sent = np.stack((state.q, np.zeros_like(state.q), np.zeros_like(state.q)))
        self._begin(state)

    def _is_usable(self, state: State, dt: float) -> bool:
        if not 0.0 <= dt <= LONGEST_GAP:
            self.reason = f"Expected packets at most {1e3 * LONGEST_GAP:.0f} ms apart, got {1e3 * dt:.1f} ms."
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

    def _limited(self, q: np.ndarray, qd: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        sent, self.clamped, _, refused = kernels.limit_reference(self._sent, self._bounds, dt, q, self._sent[0], qd)
        if refused:
            self.reason = f"Expected a finite reference, got NaN or Inf for joint {abs(refused)}."
        self._sent = sent
        return sent[0], sent[2]

    def _judge(self, state: State, dt: float) -> None:
        if np.isnan(_largest(state.q) + _largest(state.qd)):  # a lost measurement: neither at rest nor moved
            return
        rests = self._is_over and self._is_near(state) and _largest(state.qd) < SLOW
        self._rested = self._rested + dt if rests else 0.0
        self.done = self._rested >= RESTS

    def _is_near(self, state: State) -> bool:
        return _largest(state.q - self._goal) < NEAR

    def _checked(self, g: ArrayLike) -> np.ndarray:
        goal = vector(g, "g", self._n)
        outside = (goal < self._bounds[0]) | (goal > self._bounds[1])
        if outside.any():
            i = int(np.argmax(outside))
            raise ShapeError(
                f"Expected a goal within the limits, got {goal[i]:g} for joint {i + 1} of {self._name}, which "
                f"goes from {self._bounds[0, i]:g} to {self._bounds[1, i]:g}."
            )
        return np.array(goal)


def robots_of(robot: Arms) -> tuple[Robot, ...]:
    """Return the arms as a tuple, also where there is only one."""
    arms = (robot,) if isinstance(robot, Robot) else members(robot, "robot")
    for arm in arms:
        if not isinstance(arm, Robot):
            raise RobotError.no_robot(arm)
    return arms


def _largest(values: np.ndarray) -> float:
    return float(np.maximum.reduce(np.abs(values)))  # half the time of max() for so few; NaN stays NaN


def steps_in(dt: float) -> int:
    """Return the number of integration steps of at most 4 ms in dt [s]; ABB's cycle of 4.032 ms is one."""
    return max(1, ceil(dt / LONGEST_STEP - _SLACK)) if dt < np.inf else 1


def own_steps(dt: float, pace: Pace) -> list[float]:
    """Return the steps [s] in the motion's own time that lead to a packet after dt [s]."""
    parts, way = steps_in(dt), 0.5 * (pace[0] + pace[1]) * dt
    return [way / parts] * parts if way > 0.0 else []


def at_pace(state: Sequence[np.ndarray], pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return q, qd and qdd of the reference, and the path, of a motion with position, velocity and acceleration."""
    (y, yd, ydd), (_, speed, change) = state, pace
    return y, speed * yd, speed**2 * ydd + change * yd, y


def check_joints(robot: Arms, n: int) -> None:
    """Refuse a motion whose n coordinates are not the joints of all arms together."""
    arms = robots_of(robot)
    joints, names = sum(arm.n for arm in arms), " and ".join(arm.name for arm in arms)
    if n != joints:
        raise ShapeError(f"Expected a motion of {joints} joints for {names}, got one of {n} coordinates.")
