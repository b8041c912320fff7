"""Several arms as one: `merge_states` makes one State of theirs, `split_command` gives each its part of a Command."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from armlab.errors import CommandRefused
from armlab.robots import Robot
from armlab.state import Command, State

__all__ = ["merge_states", "split_command"]

_JOINTS = ("q", "qd", "tau", "q_start", "q_planned", "q_sent", "qd_sent")


def merge_states(states: Sequence[State], ages: Sequence[float], pace: int, t: float) -> State:
    """Return the state of all arms: joint arrays one arm after another, each arm's own State in `arms` with its age.

    Time, sequence and state numbers are those of the pacing arm. What a fused state cannot say (poses, wrenches) is
    NaN: look into `arms`.
    """
    first = states[pace]
    clamped = np.concatenate([state.clamped for state in states])
    clamped.flags.writeable = False
    return State(
        t=t,
        dt=first.dt,
        seq=first.seq,
        missed=first.missed,
        session=first.session,
        qd_source=first.qd_source,
        tau_source=first.tau_source,
        motors=first.motors,
        rapid=first.rapid,
        mci=first.mci,
        converged=first.converged,
        utilization=first.utilization,
        robotware=first.robotware,
        robot_ns=first.robot_ns,
        t_receive=first.t_receive,
        sources=first.sources,
        robot="+".join(state.robot for state in states),
        arms=tuple(_aged(state, age) for state, age in zip(states, ages, strict=True)),
        clamped=clamped,
        **_joints(states),
    )


def _joints(states: Sequence[State]) -> dict[str, Any]:
    """Return the joint arrays as views of one: putting each together alone would take five times as long."""
    parts = [[getattr(state, name) for state in states] for name in _JOINTS]
    whole = np.concatenate([part for one in parts for part in one])
    whole.flags.writeable = False
    joints, start = {}, 0
    for name, one in zip(_JOINTS, parts, strict=True):
        stop = start + sum(map(len, one))
        joints[name], start = whole[start:stop], stop
    return joints


def _aged(state: State, age: float) -> State:
    """Return the state with its age; `dataclasses.replace` would take four times as long."""
    if age <= 0.0:
        return state
    aged = object.__new__(State)
    for name in State.__slots__:
        object.__setattr__(aged, name, age if name == "age" else getattr(state, name))
    return aged


def split_command(asked: Any, robots: Sequence[Robot], pace: int = 0) -> Sequence[Command | None]:
    """Return the part of each arm in what a controller returned."""
    if len(robots) == 1:
        return (asked,)
    if asked is None:
        return (None,) * len(robots)
    if isinstance(asked, Sequence) and len(asked) == len(robots):
        return asked
    if not isinstance(asked, Command):
        names = " and ".join(robot.name for robot in robots)
        raise CommandRefused(
            f"Expected the controller to return one Command of all joints, one per arm ({names}) or None, got "
            f"{type(asked).__name__}{f' of {len(asked)}' if isinstance(asked, Sequence) else ''}. "
            "Write Command(q) with all joints, or a tuple of one Command per arm."
        )
    for name in ("q_ext", "rapid_data", "rapid_digital"):
        if getattr(asked, name) is not None:
            raise CommandRefused(
                f"Expected no {name} in a Command of all joints: it does not say for which arm. "
                "Return a tuple of one Command per arm."
            )
    parts = [_parts(name, getattr(asked, name), robots) for name in ("q", "qd", "tau")]
    records = [asked.record if index == pace else {} for index in range(len(robots))]
    return [Command(q, qd, tau, record, asked.ends) for q, qd, tau, record in zip(*parts, records, strict=True)]


def _parts(name: str, values: Any, robots: Sequence[Robot]) -> Sequence[np.ndarray | None]:
    if values is None:
        return (None,) * len(robots)
    array, total = np.asarray(values), sum(robot.n for robot in robots)
    if array.shape != (total,):
        joints = " and ".join(f"{robot.n} of {robot.name}" for robot in robots)
        raise CommandRefused(
            f"Expected Command.{name} of shape ({total},), {joints}, got {array.shape}. "
            "Write all joints one arm after another, or return a tuple of one Command per arm."
        )
    parts, start = [], 0
    for robot in robots:
        parts.append(array[start : start + robot.n])
        start += robot.n
    return parts
