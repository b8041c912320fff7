"""Motion from point to point, and through points, with times of its own.

Every profile is made of polynomials, joined with equal position and velocity; `Profile` holds them and their samples.
All joints start and end together. Positions in rad or m, times in s.

=========================  ============================================  ============
profile                    given                                         smooth in
=========================  ============================================  ============
`minimum_jerk`, `quintic`  duration                                      acceleration
`trapezoidal`              limits of velocity and acceleration           velocity
`blend`, `connect`         duration, through points with a rest at each  velocity
`spline`                   points and their times                        acceleration
`time_optimal`             limits of velocity, acceleration and jerk     acceleration
=========================  ============================================  ============
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number
from armlab.errors import ShapeError
from armlab.motion import _arguments, _piecewise, _ruckig
from armlab.motion.profile import PERIOD, Profile

__all__ = ["Profile", "blend", "connect", "minimum_jerk", "quintic", "spline", "time_optimal", "trapezoidal"]


def minimum_jerk(q0: ArrayLike, q1: ArrayLike, duration: float, dt: float = PERIOD) -> Profile:
    """Move from rest to rest with the least integral of squared jerk: ``q0 + (q1 - q0)(10 u^3 - 15 u^4 + 6 u^5)``.

    ``u = t / duration``; the largest speed is 15/8 of the mean, the largest acceleration ``10/sqrt(3)`` of
    ``|q1 - q0| / duration^2``. `Profile.slowed` gives the shortest within limits.

    Parameters
    ----------
    q0, q1 : (n,) start and end. duration : [s]. dt : between samples [s].

    Raises
    ------
    ShapeError : points that do not fit each other, missing values, a duration that is not above zero.

    References
    ----------
    Flash and Hogan, The coordination of arm movements, Journal of Neuroscience 5 (1985).
    """
    return quintic(q0, q1, duration, dt=dt)


def quintic(
    q0: ArrayLike,
    q1: ArrayLike,
    duration: float,
    qd0: ArrayLike = 0.0,
    qd1: ArrayLike = 0.0,
    qdd0: ArrayLike = 0.0,
    qdd1: ArrayLike = 0.0,
    dt: float = PERIOD,
) -> Profile:
    """Move along the polynomial of fifth degree with the given position, velocity and acceleration at both ends.

    Parameters
    ----------
    q0, q1 : (n,) start and end. duration : [s].
    qd0, qd1, qdd0, qdd1 : velocity and acceleration there, a number or (n,).
    dt : between samples [s].

    Raises
    ------
    ShapeError : points that do not fit each other, missing values, a duration that is not above zero.
    """
    start = _arguments.point(q0, "q0")
    end, n = _arguments.second_point(q1, "q1", start), len(start)
    T = _arguments.positive(duration, "duration [s]")
    v0, v1 = (T * _arguments.velocity(v, what, n) for v, what in ((qd0, "qd0"), (qd1, "qd1")))
    a0, a1 = (T * T * _arguments.velocity(a, what, n) for a, what in ((qdd0, "qdd0"), (qdd1, "qdd1")))
    d = end - start
    c = np.stack(
        [
            start,
            v0,
            a0 / 2,
            10 * d - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1,
            -15 * d + 8 * v0 + 7 * v1 + 1.5 * a0 - a1,
            6 * d - 3 * (v0 + v1) - 0.5 * (a0 - a1),
        ]
    )
    return Profile(*_piecewise.stretched(np.array([0.0, 1.0]), c[None], T), dt)


def trapezoidal(
    q0: ArrayLike, q1: ArrayLike, qd_max: ArrayLike, qdd_max: ArrayLike, duration: float | None = None,
    dt: float = PERIOD,
) -> Profile:  # fmt: skip
    """Move from rest to rest on a straight line of the joint space as fast as velocity and acceleration allow.

    Constant acceleration, constant velocity, constant deceleration, of all joints at the same times; a joint reaches
    its limit exactly and none exceeds it. Short motions never reach the velocity, and have two pieces.

    Parameters
    ----------
    q0, q1 : (n,) start and end. qd_max, qdd_max : limits, a number or (n,).
    duration : a longer time than necessary, for which the motion is stretched [s].
    dt : between samples [s].

    Raises
    ------
    ShapeError : the same point twice, points or limits that do not fit, a duration too short for the limits.
    """
    start = _arguments.point(q0, "q0")
    d = _arguments.second_point(q1, "q1", start) - start
    limits = [_arguments.joint_limit(x, what, len(d)) for x, what in ((qd_max, "qd_max"), (qdd_max, "qdd_max"))]
    far = np.abs(d) > 0.0
    if not far.any():
        raise ShapeError("Expected two points apart, got the same as q0 and q1. There is no motion to plan.")
    v, a = (float(np.min(limit[far] / np.abs(d[far]))) for limit in limits)
    if not a < np.inf:
        raise ShapeError("Expected a finite qdd_max of a joint that moves, got none. Give what the arm can do.")
    ramp = min(v / a, float(np.sqrt(1.0 / a)))
    shortest = 2.0 * ramp if v * v >= a else 1.0 / v + ramp
    found = Profile(*_along(start, d, *_piecewise.rising(shortest, ramp)), dt)
    if duration is None:
        return found
    k = _arguments.positive(duration, "duration [s]") / shortest
    if k < 1.0 - 1e-12:
        raise ShapeError(
            f"Expected a duration of {shortest:.6g} s or more within the limits, got {duration:g} s. Allow more time."
        )
    return Profile(*_piecewise.stretched(found.breaks, found.coefficients, max(k, 1.0)), dt)


def blend(q0: ArrayLike, q1: ArrayLike, duration: float, cruise: float = 1.5, dt: float = PERIOD) -> Profile:
    """Move from rest to rest on a straight line with quadratic blends: `trapezoidal` with a given duration.

    Velocity ``V = cruise (q1 - q0) / duration`` between blends of ``duration (1 - 1 / cruise)`` seconds.

    Parameters
    ----------
    q0, q1 : (n,) start and end. duration : [s].
    cruise : velocity between the blends over the mean velocity, above 1, at most 2.
    dt : between samples [s].

    Raises
    ------
    ShapeError : points that do not fit each other, a duration that is not above zero, another `cruise`.
    """
    start = _arguments.point(q0, "q0")
    return connect([start, _arguments.second_point(q1, "q1", start)], duration, cruise, dt)


def connect(points: ArrayLike, duration: ArrayLike, cruise: float = 1.5, dt: float = PERIOD) -> Profile:
    """Join points by straight lines with quadratic blends, with a rest at each point.

    Parameters
    ----------
    points : (m, n) one after the other. duration : of a segment [s], one number or (m - 1,).
    cruise, dt : as in `blend`.

    Raises
    ------
    ShapeError : fewer than two points, missing values, durations that do not fit, another `cruise`.
    """
    path = _arguments.points(points, "points")
    seconds = _arguments.joint_limit(duration, "duration of the segments [s]", len(path) - 1)
    if not np.isfinite(seconds).all():
        raise ShapeError("Expected finite durations of the segments [s], got another. Give one number or one for each.")
    if not 1.0 < number(cruise, "cruise") <= 2.0:
        raise ShapeError(f"Expected cruise above 1 and at most 2, got {cruise}. 1.5 blends in a third of the time.")
    breaks, pieces = [np.zeros(1)], []
    for start, d, T in zip(path, np.diff(path, axis=0), seconds):
        own, c = _along(start, d, *_piecewise.rising(T, T * (1.0 - 1.0 / cruise)))
        breaks.append(breaks[-1][-1] + own[1:])
        pieces.append(c)
    return Profile(np.concatenate(breaks), np.concatenate(pieces), dt)


def spline(t: ArrayLike, q: ArrayLike, qd0: ArrayLike = 0.0, qd1: ArrayLike = 0.0, dt: float = PERIOD) -> Profile:
    """Move through points at given times along the cubic spline, which has the least integral of squared acceleration.

    Parameters
    ----------
    t : (m,) rising [s]; the profile starts at 0 with the first. q : (m, n) points.
    qd0, qd1 : velocity at the first and the last point, a number or (n,); rest without them.
    dt : between samples [s].

    Raises
    ------
    ShapeError : fewer than two points, missing values, times that do not rise, shapes that do not fit.
    """
    from scipy.interpolate import CubicSpline

    path = _arguments.points(q, "q")
    times = _arguments.point(t, "t [s]")
    if times.shape != (len(path),) or not (np.diff(times) > 0.0).all():
        raise ShapeError(
            f"Expected t of shape ({len(path)},) that rises, one time per point, got "
            f"{'shape ' + str(times.shape) if times.shape != (len(path),) else 'times that do not'}. Sort the points."
        )
    ends: Any = [(1, _arguments.velocity(v, what, path.shape[1])) for v, what in ((qd0, "qd0"), (qd1, "qd1"))]
    own = times - times[0]
    c = np.zeros((len(path) - 1, 6, path.shape[1]))
    bc: Any = tuple(ends)
    c[:, :4] = CubicSpline(own, path, bc_type=bc).c[::-1].swapaxes(0, 1)
    return Profile(own, c, dt)


def time_optimal(
    q0: ArrayLike,
    q1: ArrayLike,
    qd_max: ArrayLike,
    qdd_max: ArrayLike,
    qddd_max: ArrayLike,
    qd0: ArrayLike = 0.0,
    qd1: ArrayLike = 0.0,
    dt: float = PERIOD,
) -> Profile:
    """Move in the least time under limits of velocity, acceleration and jerk; all joints arrive together.

    The joint that needs longest takes its least time; the others take as long. The path is no straight line.

    Parameters
    ----------
    q0, q1 : (n,) start and end. qd_max, qdd_max, qddd_max : finite limits, a number or (n,).
    qd0, qd1 : velocities there, within the limits; a number or (n,).
    dt : between samples [s].

    Raises
    ------
    MissingExtra : ruckig is not installed.
    ShapeError : the same point twice at rest, points, velocities or limits that do not fit.

    References
    ----------
    Berscheid and Kroeger, Jerk-limited real-time trajectory generation with arbitrary target states, RSS 2021.
    """
    start = _arguments.point(q0, "q0")
    end, n = _arguments.second_point(q1, "q1", start), len(start)
    named = ((qd_max, "qd_max"), (qdd_max, "qdd_max"), (qddd_max, "qddd_max"))
    limits = [_arguments.joint_limit(limit, what, n) for limit, what in named]
    if not np.isfinite(limits).all():
        raise ShapeError("Expected finite limits of velocity, acceleration and jerk, got another. Give large ones.")
    rates = [_arguments.velocity(v, what, n) for v, what in ((qd0, "qd0"), (qd1, "qd1"))]
    for rate, what in zip(rates, ("qd0", "qd1")):
        fast = np.flatnonzero(np.abs(rate) > limits[0])
        if len(fast):
            raise ShapeError(
                f"Expected {what} within qd_max, got {rate[fast[0]]:g} of {limits[0][fast[0]]:g} for joint {fast[0]}. "
                "Slow down first."
            )
    if np.array_equal(start, end) and not np.any(rates):
        raise ShapeError("Expected two points apart, got the same as q0 and q1. There is no motion to plan.")
    return Profile(*_ruckig.pieces(start, end, *rates, *limits), dt)


def _along(start: np.ndarray, d: np.ndarray, breaks: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return breaks and coefficients of ``start + d s(t)``, with the pieces (M, 6, 1) of s."""
    c = step * d
    c[:, 0] += start
    return breaks, c
