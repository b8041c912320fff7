"""Time-optimal motion: what ruckig finds, as pieces of third degree."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import MissingExtra, ShapeError

__all__ = ["pieces"]


def pieces(
    q0: np.ndarray,
    q1: np.ndarray,
    qd0: np.ndarray,
    qd1: np.ndarray,
    qd_max: np.ndarray,
    qdd_max: np.ndarray,
    qddd_max: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return breaks (M + 1,) and coefficients (M, 6, n)."""
    ruckig = _library()
    n = len(q0)
    wanted, found = ruckig.InputParameter(n), ruckig.Trajectory(n)
    wanted.current_position, wanted.target_position = q0.tolist(), q1.tolist()
    wanted.current_velocity, wanted.target_velocity = qd0.tolist(), qd1.tolist()
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = (
        limit.tolist() for limit in (qd_max, qdd_max, qddd_max)
    )
    try:
        outcome = ruckig.Ruckig(n).calculate(wanted, found)
    except (ruckig.RuckigError, ValueError) as error:  # ValueError: an answer that it has no name for
        said = " ".join(str(error).split())[:300].rstrip(".")
        raise ShapeError(f"Expected a motion that ruckig can plan, got: {said}.") from None
    if outcome not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise ShapeError(f"Expected a motion that ruckig can plan, got its answer {outcome}. Make the limits larger.")
    joints = [_states(joint, *state) for joint, state in zip(found.profiles[0], zip(q0, qd0))]
    breaks = np.unique(np.concatenate([[0.0, found.duration], *(times for times, _ in joints)]))
    breaks = breaks[breaks <= found.duration]
    c = np.zeros((len(breaks) - 1, 6, n))
    for i, (times, states) in enumerate(joints):
        k = np.searchsorted(times, breaks[:-1], side="right") - 1
        q, qd, qdd, jerk = states[k].T
        s = breaks[:-1] - times[k]
        c[:, 0, i] = q + s * (qd + s * (qdd / 2 + s * jerk / 6))
        c[:, 1, i] = qd + s * (qdd + s * jerk / 2)
        c[:, 2, i] = (qdd + s * jerk) / 2
        c[:, 3, i] = jerk / 6
    return breaks, c


def _states(joint: Any, q: float, qd: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (m,) at which the jerk of a joint changes, and q, qd, qdd, jerk (m, 4) from then on."""
    parts = [*zip(joint.brake.t, joint.brake.j), *zip(joint.t, joint.j)]
    times, states, clock, qdd = [0.0], [], 0.0, 0.0
    for h, jerk in parts:
        if h <= 0.0:
            continue
        states.append((q, qd, qdd, jerk))
        q, qd, qdd = q + h * (qd + h * (qdd / 2 + h * jerk / 6)), qd + h * (qdd + h * jerk / 2), qdd + h * jerk
        clock += h
        times.append(clock)
    return np.array(times), np.array([*states, (q, qd, 0.0, 0.0)])


def _library() -> Any:
    try:
        import ruckig  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtra(
            "Expected ruckig for time-optimal motion, got none. Install it: pip install 'armlab[motion]'."
        ) from None
    return ruckig
