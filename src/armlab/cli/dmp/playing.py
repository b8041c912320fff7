"""Play movement primitives of all kinds on an arm, or write their motions to a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

import armlab
from armlab.cli.support.options import as_given
from armlab.cli.support.output import note, print_json, result
from armlab.errors import ConfigError, LinkError, ShapeError

if TYPE_CHECKING:
    from armlab.bridge import Limits
    from armlab.log import Table
    from armlab.motion import Controller, Dmp, PeriodicDmp, PoseDmp, ProMP, TwoDofDmp
    from armlab.motion.profiles import Profile
    from armlab.robots import Robot
    from armlab.state import Command, State

OPTIONS: dict[str, tuple[str, ...]] = {
    "dmp": ("duration", "start", "goal", "via"),
    "two_dof_dmp": ("duration", "start", "goal", "via"),
    "promp": ("duration", "start", "goal", "via"),
    "pose_dmp": ("duration", "start", "goal"),
    "periodic_dmp": ("duration", "goal", "amplitude", "turns"),
}
"""Playback options for each kind of primitive."""
DT = 0.004  # s
SOFT = 2.0  # rad/s^2 or m/s^2, acceleration of the motion to the start
SETTLES = 1.0  # s, settling time after the motion
TURNS = 4.0  # default number of periods of a periodic motion


@dataclass(frozen=True)
class PlannedMotion:
    """Controller that executes a motion, with its start configuration q_start (n,) and its duration [s]."""

    controller: Controller
    q_start: np.ndarray
    seconds: float


def numbers_in(text: str | None, option: str) -> np.ndarray | None:
    """Parse numbers such as ``0.1,0.2,-0.3``; None for None."""
    try:
        return None if text is None else np.array([float(word) for word in text.split(",")])
    except ValueError:
        raise ConfigError(
            f"Expected --{option} to be comma-separated numbers, such as 0.1,0.2, got {text!r}."
        ) from None


@as_given()
def resolved(primitive: Any, given: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the primitive with its via-points, and the remaining options for its run.

    A distribution over motions is replaced by a primitive for its mean, conditioned on start, goal and via-points.
    `given` contains the value of each option, or None; via-points are strings "TIME:Y,Y,...".
    """
    kind = getattr(primitive, "KIND", type(primitive).__name__)
    if kind not in OPTIONS:
        raise ConfigError(f"Expected a movement primitive, got a file of kind {kind!r}. Use armlab dmp fit.")
    run = {name: value for name, value in given.items() if value is not None}
    for name in run:
        if name not in OPTIONS[kind]:
            raise ConfigError(f"Expected --{', --'.join(OPTIONS[kind])} for a {kind}, got --{name}. Omit --{name}.")
    points = [_point(word) for word in run.pop("via", ())]
    if kind == "promp":
        return _mean(primitive, points, run, armlab.motion.fit_dmp), {}
    if points:
        t, y = [when for when, _ in points], np.array([value for _, value in points])
        if isinstance(primitive, armlab.motion.TwoDofDmp):
            return replace(primitive, dmp=armlab.motion.with_via_points(primitive.dmp, t, y)), run
        return armlab.motion.with_via_points(primitive, t, y), run
    return primitive, run


@as_given()
def rolled_out(primitive: Any, run: Mapping[str, Any]) -> Table:
    """Return the motion at 250 Hz: y, yd and ydd (N, n), or poses of the tool."""
    from armlab.log import Column, Table

    if isinstance(primitive, armlab.motion.PoseDmp):
        poses = primitive.rollout(DT, **run)
        return Table(poses.t, {"T_base_tool": poses.T})
    if isinstance(primitive, armlab.motion.PeriodicDmp):
        period = run.get("duration", primitive.period)
        t = np.arange(0.0, run.get("turns", TURNS) * period + 0.5 * DT, DT)
        found = primitive.rollout(t, period=period, g=run.get("goal"), r=run.get("amplitude", 1.0))
    else:
        dmp = primitive.dmp if isinstance(primitive, armlab.motion.TwoDofDmp) else primitive
        found = dmp.rollout(DT, duration=run.get("duration"), y0=run.get("start"), g=run.get("goal"))
    names = {"y": found.y, "yd": found.yd, "ydd": found.ydd}
    return Table(found.t, names, {name: Column(unit="1") for name in names})  # rad or m: primitives have no unit


@as_given()
def motion_of(primitive: Any, run: Mapping[str, Any], robot: Robot, limits: Limits, firm: bool) -> PlannedMotion:
    """Return the motion of the arm, slowed down if needed to respect the velocity limits."""
    if isinstance(primitive, armlab.motion.PoseDmp):
        return _pose_motion(primitive, run, robot, limits)
    if isinstance(primitive, armlab.motion.PeriodicDmp):
        return _periodic_motion(primitive, run, robot, limits)
    return _joint_motion(primitive, run, robot, limits, firm)


def rehearsed(motion: PlannedMotion) -> armlab.log.Table:
    """Return the commands q and qd (N, n) of a motion at 250 Hz for an arm with perfect tracking."""
    from armlab.state import State

    q, qd, unknown = motion.q_start, np.zeros_like(motion.q_start), np.full_like(motion.q_start, np.nan)
    t = DT * np.arange(round((motion.seconds + SETTLES) / DT) + 1)
    rows = []
    for now in t:
        command = motion.controller(State(float(now), DT, q, qd, unknown))
        if command.q is None or command.qd is None:
            raise LinkError(f"Expected a complete motion, but it ended after {now:.2f} s: {motion.controller.reason}")
        q, qd = command.q, command.qd
        rows.append((q, qd))
    positions, velocities = np.array(rows).swapaxes(0, 1)
    return armlab.log.Table(t, {"q": positions, "qd": velocities})


def distance(robot: Robot, q: np.ndarray, goal: np.ndarray) -> dict[str, float]:
    """Return the distance of an arm at q (n,) from a goal, keyed by unit: m and rad for a pose (4, 4), rad for joints
    (n,)."""
    if goal.ndim == 1:
        return {"rad": float(np.abs(q - goal).max())}
    T_base_tool = armlab.kinematics.forward(robot, q)
    turned = armlab.lie.so3.angle(T_base_tool[:3, :3], goal[:3, :3])
    return {"m": float(np.linalg.norm(T_base_tool[:3, 3] - goal[:3, 3])), "rad": float(turned)}


def report_motion(robot: Robot, controller: Any, seconds: float, done: armlab.bridge.Run, json: bool) -> None:
    """Print why a motion ended, its final distance from the goal, and any problems during the run."""
    off = distance(robot, done.table["q"][-1], controller.goal)
    reason = "arrived" if controller.done else controller.reason or done.reason
    if json:
        print_json({"seconds": seconds, "goal_error": max(off.values()), "reason": reason, "log": str(done.path)})
    else:
        apart = " and ".join(f"{value:.2g} {unit}" for unit, value in off.items())
        result(f"{seconds:.2f} s of motion, ended {apart} from the goal: {reason}")
    for line in (*done.statistics["problems"], f"log: {done.path}"):
        note(line)


class Walk:
    """Controller that moves from the measured configuration to q (n,) with minimum jerk, and then ends the run."""

    def __init__(self, q: np.ndarray, qd_max: np.ndarray) -> None:
        self._q, self._qd_max, self._begin = q, qd_max, 0.0
        self._profile: Profile | None = None

    def __call__(self, state: State) -> Command:
        from armlab.state import Command

        if self._profile is None:
            whole = armlab.motion.profiles.minimum_jerk(state.q, self._q, 1e-2)
            self._profile, self._begin = whole.slowed(self._qd_max, SOFT), state.t
        clock = state.t - self._begin
        if clock > self._profile.duration + 0.5 * SETTLES:
            return Command.stop()
        q, qd, _ = self._profile.at(clock)
        return Command(q, qd)


def _point(word: str) -> tuple[float, np.ndarray]:
    time, _, values = word.partition(":")
    try:
        return float(time), np.array([float(value) for value in values.split(",")])
    except ValueError:
        raise ConfigError(f"Expected --via as TIME:Y,Y,..., such as 0.8:0.1,0.2, got {word!r}.") from None


def _mean(promp: ProMP, points: Sequence[tuple[float, np.ndarray]], run: Mapping[str, Any], fit: Any) -> Dmp:
    """Return a primitive for the mean motion through start, goal and via-points, with the given duration."""
    ends = [(when, run[name]) for name, when in (("start", 0.0), ("goal", promp.duration)) if name in run]
    for when, y in (*points, *ends):
        promp = promp.condition(when, y)
    mean = promp.marginal(DT, duration=run.get("duration"))
    return fit(mean.t, mean.y, scaling="none").value


def _joint_motion(
    law: Dmp | TwoDofDmp, run: Mapping[str, Any], robot: Robot, limits: Limits, firm: bool
) -> PlannedMotion:
    from armlab.motion import Dmp, TwoDofDmp, shortest_duration

    dmp = law if isinstance(law, Dmp) else law.dmp
    follows = dmp if firm else law if isinstance(law, TwoDofDmp) else TwoDofDmp(dmp)
    start, goal, wanted = run.get("start", dmp.y0), run.get("goal"), run.get("duration", dmp.duration)
    follows.controller(robot, limits=limits, g=goal, duration=wanted)  # raises an error for invalid options
    pace = wanted / dmp.duration
    seconds = pace * shortest_duration(dmp, limits.qd_max * pace, y0=start, g=goal)  # as requested, or slower
    return PlannedMotion(follows.controller(robot, limits=limits, g=goal, duration=seconds), np.array(start), seconds)


def _pose_motion(dmp: PoseDmp, run: Mapping[str, Any], robot: Robot, limits: Limits) -> PlannedMotion:
    """Return the joint motion along the poses by inverse kinematics, from the configuration nearest to home."""
    dmp.controller(robot, limits=limits, goal=run.get("goal"))
    seconds = float(run.get("duration", dmp.duration))
    T = dmp.rollout(DT, duration=seconds, start=run.get("start"), twist0=np.zeros(6), goal=run.get("goal")).T
    q = [armlab.kinematics.inverse(robot, T[0], robot.q_home).q]
    for k, pose in enumerate(T):
        found = armlab.kinematics.inverse(robot, pose, q[-1], starts=1)
        if not found.success:
            raise ShapeError(
                f"Expected a path within the reach of {robot.name}, got a pose outside it after {k * DT:.2f} s."
            )
        q.append(found.q)
    speed = np.abs(np.diff(q, axis=0)).max(axis=0) / DT
    seconds *= max(1.0, float(np.max(speed / limits.qd_max)))
    return PlannedMotion(dmp.controller(robot, limits=limits, goal=run.get("goal"), duration=seconds), q[0], seconds)


def _periodic_motion(dmp: PeriodicDmp, run: Mapping[str, Any], robot: Robot, limits: Limits) -> PlannedMotion:
    base, r, turns = run.get("goal", dmp.g), run.get("amplitude", 1.0), float(run.get("turns", TURNS))
    period = float(run.get("duration", dmp.period))
    dmp.controller(robot, limits=limits, g=base, r=r, turns=turns)
    speed = np.abs(dmp.rollout(1e-3 * period, period=period, r=r).yd).max(axis=0)
    period *= max(1.0, float(np.max(speed / limits.qd_max)))
    controller = dmp.controller(robot, limits=limits, period=period, g=base, r=r, turns=turns)
    return PlannedMotion(controller, np.array(base), turns * period)
