"""Time-parameterised trajectories from point to point and through points.

Every profile consists of polynomial segments with continuous position and velocity; `Profile` stores the segments and
samples. All joints start and end together. Positions are in rad or m, times in s.

=========================  ============================================  ============
profile                    inputs                                        continuous
=========================  ============================================  ============
`minimum_jerk`, `quintic`  duration                                      acceleration
`trapezoidal`              velocity and acceleration limits              velocity
`blend`, `connect`         duration, points with rest at each            velocity
`spline`                   points and their times                        acceleration
`time_optimal`             velocity, acceleration and jerk limits        acceleration
=========================  ============================================  ============
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only, number, numbers, positive
from armlab.errors import MissingExtra, ShapeError
from armlab.motion import arguments

__all__ = ["Profile", "blend", "connect", "minimum_jerk", "quintic", "spline", "time_optimal", "trapezoidal"]

PERIOD = 0.004  # period of the control loop [s]

DEGREE = 5
LINE = np.arange(DEGREE + 1.0)


def minimum_jerk(q0: ArrayLike, q1: ArrayLike, duration: float, dt: float = PERIOD) -> Profile:
    """Return the rest-to-rest motion with the smallest integral of squared jerk.

    ``q0 + (q1 - q0)(10 u^3 - 15 u^4 + 6 u^5)``.

    With ``u = t / duration``, the largest speed is 15/8 of the mean, and the largest acceleration is ``10/sqrt(3)``
    times ``|q1 - q0| / duration^2``. `Profile.slowed` finds the shortest duration within given limits.

    Parameters
    ----------
    q0, q1 : (n,) start and end.
    duration : duration of the motion [s].
    dt : sampling period [s].

    Raises
    ------
    ShapeError : points of different shapes, missing values, or a non-positive duration.

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
    """Return the fifth-degree polynomial with the given position, velocity and acceleration at both ends.

    Parameters
    ----------
    q0, q1 : (n,) start and end.
    duration : duration of the motion [s].
    qd0, qd1, qdd0, qdd1 : velocity and acceleration at the ends, a number or (n,).
    dt : sampling period [s].

    Raises
    ------
    ShapeError : points of different shapes, missing values, or a non-positive duration.
    """
    start = arguments.point(q0, "q0")
    end, n = arguments.second_point(q1, "q1", start), len(start)
    T = positive(duration, "duration [s]")
    v0, v1 = (T * arguments.velocity(v, what, n) for v, what in ((qd0, "qd0"), (qd1, "qd1")))
    a0, a1 = (T * T * arguments.velocity(a, what, n) for a, what in ((qdd0, "qdd0"), (qdd1, "qdd1")))
    c = pieces(1.0, (start, end), (v0, v1), (a0, a1))
    return Profile(*stretched(np.array([0.0, 1.0]), c[None], T), dt)


def trapezoidal(
    q0: ArrayLike, q1: ArrayLike, qd_max: ArrayLike, qdd_max: ArrayLike, duration: float | None = None,
    dt: float = PERIOD,
) -> Profile:  # fmt: skip
    """Return the fastest rest-to-rest motion on a straight line in joint space within velocity and acceleration limits.

    All joints share the phases of constant acceleration, velocity and deceleration; at least one joint reaches a
    limit and no joint exceeds its limits. Short motions do not reach the velocity limit and have two segments.

    Parameters
    ----------
    q0, q1 : (n,) start and end.
    qd_max, qdd_max : limits, a number or (n,).
    duration : duration of the motion, at least the shortest possible [s]; default: the shortest.
    dt : sampling period [s].

    Raises
    ------
    ShapeError : identical points, shapes that do not match, or a duration too short for the limits.
    """
    start = arguments.point(q0, "q0")
    d = arguments.second_point(q1, "q1", start) - start
    limits = [arguments.joint_limit(x, what, len(d)) for x, what in ((qd_max, "qd_max"), (qdd_max, "qdd_max"))]
    far = np.abs(d) > 0.0
    if not far.any():
        raise ShapeError("Expected q0 and q1 to differ, got identical points. Pass a different q1.")
    v, a = (float(np.min(limit[far] / np.abs(d[far]))) for limit in limits)
    if not a < np.inf:
        raise ShapeError("Expected a finite qdd_max for a moving joint, got inf. Pass the limit of the arm.")
    ramp = min(v / a, float(np.sqrt(1.0 / a)))
    shortest = 2.0 * ramp if v * v >= a else 1.0 / v + ramp
    found = Profile(*along(start, d, shortest, ramp), dt)
    if duration is None:
        return found
    k = positive(duration, "duration [s]") / shortest
    if k < 1.0 - 1e-12:
        raise ShapeError(
            f"Expected a duration of {shortest:.6g} s or more to stay within the limits, got {duration:g} s. Allow "
            "more time."
        )
    return Profile(*stretched(found.breaks, found.coefficients, max(k, 1.0)), dt)


def blend(q0: ArrayLike, q1: ArrayLike, duration: float, cruise: float = 1.5, dt: float = PERIOD) -> Profile:
    """Return the straight-line rest-to-rest motion with quadratic blends (`trapezoidal` with a given duration).

    The velocity is ``V = cruise (q1 - q0) / duration`` between blends of ``duration (1 - 1 / cruise)`` seconds.

    Parameters
    ----------
    q0, q1 : (n,) start and end.
    duration : duration of the motion [s].
    cruise : ratio of cruise velocity to mean velocity, above 1 and at most 2.
    dt : sampling period [s].

    Raises
    ------
    ShapeError : points of different shapes, a non-positive duration, or `cruise` out of range.
    """
    start = arguments.point(q0, "q0")
    return connect([start, arguments.second_point(q1, "q1", start)], duration, cruise, dt)


def connect(points: ArrayLike, duration: ArrayLike, cruise: float = 1.5, dt: float = PERIOD) -> Profile:
    """Join points by straight lines with quadratic blends, coming to rest at each point.

    Parameters
    ----------
    points : (m, n) points in order.
    duration : duration of each segment [s], one number or (m - 1,).
    cruise, dt : as in `blend`.

    Raises
    ------
    ShapeError : fewer than two points, missing values, durations of the wrong shape, or `cruise` out of range.
    """
    path = arguments.points(points, "points")
    seconds = arguments.joint_limit(duration, "duration of the segments [s]", len(path) - 1)
    if not np.isfinite(seconds).all():
        raise ShapeError(f"Expected finite durations of the segments [s], got {seconds.tolist()}. Correct them.")
    if not 1.0 < number(cruise, "cruise") <= 2.0:
        raise ShapeError(f"Expected cruise above 1 and at most 2, got {cruise}. The default is 1.5.")
    breaks, pieces = [np.zeros(1)], []
    for start, d, T in zip(path, np.diff(path, axis=0), seconds):
        own, c = along(start, d, T, T * (1.0 - 1.0 / cruise))
        breaks.append(breaks[-1][-1] + own[1:])
        pieces.append(c)
    return Profile(np.concatenate(breaks), np.concatenate(pieces), dt)


def spline(t: ArrayLike, q: ArrayLike, qd0: ArrayLike = 0.0, qd1: ArrayLike = 0.0, dt: float = PERIOD) -> Profile:
    """Return the cubic spline through points at given times; it minimises the integral of squared acceleration.

    Parameters
    ----------
    t : (m,) increasing times [s]; the first becomes time 0 of the profile.
    q : (m, n) points.
    qd0, qd1 : velocity at the first and the last point, a number or (n,); default: 0.
    dt : sampling period [s].

    Raises
    ------
    ShapeError : fewer than two points, missing values, non-increasing times, or shapes that do not match.
    """
    from scipy.interpolate import CubicSpline

    path = arguments.points(q, "q")
    times = arguments.point(t, "t [s]")
    if times.shape != (len(path),) or not (np.diff(times) > 0.0).all():
        raise ShapeError(
            f"Expected increasing t of shape ({len(path)},), one time per point, got {times.tolist()}. Sort the points."
        )
    bc: Any = tuple((1, arguments.velocity(v, what, path.shape[1])) for v, what in ((qd0, "qd0"), (qd1, "qd1")))
    own = times - times[0]
    c = np.zeros((len(path) - 1, 6, path.shape[1]))
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
    """Return the fastest motion within velocity, acceleration and jerk limits; all joints arrive together.

    The slowest joint moves in minimum time, and the other joints take the same time. The path is not a straight line in
    joint space.

    Parameters
    ----------
    q0, q1 : (n,) start and end.
    qd_max, qdd_max, qddd_max : finite limits, a number or (n,).
    qd0, qd1 : velocities at the ends, within the limits; a number or (n,).
    dt : sampling period [s].

    Raises
    ------
    MissingExtra : ruckig is not installed.
    ShapeError : identical points at rest; points, velocities or limits that do not match.

    References
    ----------
    Berscheid and Kroeger, Jerk-limited real-time trajectory generation with arbitrary target states, RSS 2021.
    """
    start = arguments.point(q0, "q0")
    end, n = arguments.second_point(q1, "q1", start), len(start)
    named = ((qd_max, "qd_max"), (qdd_max, "qdd_max"), (qddd_max, "qddd_max"))
    limits = [arguments.joint_limit(limit, what, n) for limit, what in named]
    if not np.isfinite(limits).all():
        raise ShapeError("Expected finite limits of velocity, acceleration and jerk, got inf. Pass finite limits.")
    rates = [arguments.velocity(v, what, n) for v, what in ((qd0, "qd0"), (qd1, "qd1"))]
    for rate, what in zip(rates, ("qd0", "qd1")):
        fast = np.flatnonzero(np.abs(rate) > limits[0])
        if len(fast):
            raise ShapeError(
                f"Expected {what} within qd_max, got {rate[fast[0]]:g} for joint {fast[0]} with a limit of "
                f"{limits[0][fast[0]]:g}. Reduce the velocity."
            )
    if np.array_equal(start, end) and not np.any(rates):
        raise ShapeError("Expected q0 and q1 to differ, got identical points at rest. Pass a different q1.")
    return Profile(*ruckig_pieces(start, end, *rates, *limits), dt)


@dataclass(frozen=True, eq=False, repr=False)
class Profile(Shown):
    """Piecewise polynomial motion of n joints, ``q(t) = sum_k c_k (t - breaks_i)^k``, with its samples.

    Attributes
    ----------
    breaks : (M + 1,) segment boundaries, from 0 [s].
    coefficients : (M, 6, n) polynomial coefficients [rad/s^k or m/s^k].
    dt : sampling period [s]; the last sample is at the end, so the last step may be shorter.
    t : (N,) sample times from 0 to the end [s].
    q, qd, qdd : (N, n) samples of position, velocity and acceleration.

    Raises
    ------
    ShapeError : non-increasing breaks, coefficients of the wrong shape, or a non-positive period.
    """

    breaks: np.ndarray
    coefficients: np.ndarray
    dt: float = PERIOD
    t: np.ndarray = field(init=False)
    q: np.ndarray = field(init=False)
    qd: np.ndarray = field(init=False)
    qdd: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        breaks, c = (
            np.array(numbers(part, what, ShapeError))
            for part, what in ((self.breaks, "breaks"), (self.coefficients, "coefficients"))
        )
        dt = positive(self.dt, "dt [s]")
        steps = np.diff(np.atleast_1d(breaks))
        if c.ndim != 3 or c.shape[1] != 6 or breaks.shape != (len(c) + 1,) or not (steps > 0.0).all() or breaks[0] != 0:
            raise ShapeError(
                f"Expected breaks (M + 1,) that increase from 0 and coefficients (M, 6, n), got {breaks.shape} and "
                f"{c.shape}. Use the functions of armlab.motion.profiles."
            )
        if not np.isfinite(c).all():
            raise ShapeError("Expected finite coefficients, got NaN or Inf. Use longer durations or lower rates.")
        if not breaks[-1] < dt * arguments.MAX_SAMPLES:
            raise ShapeError(
                f"Expected fewer than {arguments.MAX_SAMPLES} samples, got a duration of {breaks[-1]:g} s at dt = "
                f"{dt:g} s. Use a longer dt."
            )
        t = np.append(np.arange(0.0, breaks[-1] - 1e-9 * dt, dt), breaks[-1])
        names = ("breaks", "coefficients", "t", "q", "qd", "qdd")
        for name, values in zip(names, (breaks, c, t, *evaluate(breaks, c, t))):
            object.__setattr__(self, name, values)
        make_read_only(self, *names)

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.breaks[-1])

    @property
    def qd_peak(self) -> np.ndarray:
        """Largest speed of each joint (n,), including between samples."""
        return peaks(self.breaks, self.coefficients)[0]

    @property
    def qdd_peak(self) -> np.ndarray:
        """Largest acceleration of each joint (n,), including between samples."""
        return peaks(self.breaks, self.coefficients)[1]

    def at(self, t: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, qd, qdd (..., n) at arbitrary times; the arm rests before the start and after the end.

        Parameters
        ----------
        t : (...,) times since the start [s].
        """
        t = numbers(t, "t", ShapeError)
        q, qd, qdd = evaluate(self.breaks, self.coefficients, np.clip(t, 0.0, self.duration))
        moving = ((t >= 0.0) & (t <= self.duration))[..., None]
        return q, np.where(moving, qd, 0.0), np.where(moving, qdd, 0.0)

    def slowed(self, qd_max: ArrayLike = np.inf, qdd_max: ArrayLike = np.inf) -> Profile:
        """Return the same path, slowed down to satisfy the limits; unchanged if it already satisfies them.

        ``k = max(1, max |qd| / qd_max, sqrt(max |qdd| / qdd_max))``.

        Parameters
        ----------
        qd_max, qdd_max : limits, a number or (n,).

        Raises
        ------
        ShapeError : limits of the wrong shape, or non-positive limits.
        """
        n = self.q.shape[1]
        speed, acceleration = peaks(self.breaks, self.coefficients)
        k = max(
            1.0,
            float(np.max(speed / arguments.joint_limit(qd_max, "qd_max", n))),
            float(np.sqrt(np.max(acceleration / arguments.joint_limit(qdd_max, "qdd_max", n)))),
        )
        return Profile(*stretched(self.breaks, self.coefficients, k), self.dt)


Ends = tuple[np.ndarray, np.ndarray]


def pieces(h: np.ndarray | float, q: Ends, qd: Ends | None = None, qdd: Ends | None = None) -> np.ndarray:
    """Return the coefficients (6, ..., n) of the lowest-order polynomials of duration h [s] that satisfy the boundary
    conditions at both ends."""
    d, zero = q[1] - q[0], np.zeros_like(q[0])
    if qd is None:
        return np.stack([q[0], d / h, zero, zero, zero, zero])
    v0, v1 = h * qd[0], h * qd[1]
    if qdd is None:
        return np.stack([q[0], qd[0], (3 * d - 2 * v0 - v1) / h**2, (v0 + v1 - 2 * d) / h**3, zero, zero])
    a0, a1 = h * h * qdd[0], h * h * qdd[1]
    third = (10 * d - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1) / h**3
    fourth = (-15 * d + 8 * v0 + 7 * v1 + 1.5 * a0 - a1) / h**4
    fifth = (6 * d - 3 * (v0 + v1) - 0.5 * (a0 - a1)) / h**5
    return np.stack([q[0], qd[0], qdd[0] / 2, third, fourth, fifth])


def evaluate(breaks: np.ndarray, c: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, qd, qdd (..., n) of ``q = sum_k c_k (t - breaks_i)^k``, c (M, 6, n), at times (...,)."""
    piece = np.clip(np.searchsorted(breaks, t, side="right") - 1, 0, len(c) - 1)
    s, found = (t - breaks[piece])[..., None], c[piece]
    first = LINE[1:, None] * found[..., 1:, :]
    return _at(found, s), _at(first, s), _at(LINE[1:-1, None] * first[..., 1:, :], s)


def peaks(breaks: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest ``|qd|`` and ``|qdd|`` (n,), at segment ends or where the next derivative is zero."""
    first = LINE[1:, None] * c[:, 1:]
    second = LINE[1:-1, None] * first[:, 1:]
    third = LINE[1:-2, None] * second[:, 1:]
    lengths = np.diff(breaks)
    return _largest(first, second, lengths), _largest(second, third, lengths)


def _largest(p: np.ndarray, derivative: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    found = np.maximum(np.abs(p[:, 0]), np.abs(_at(p, lengths[:, None]))).max(axis=0)
    if np.any(derivative[:, 2:]):  # degree above 1: only a few segments
        for piece, joint in np.ndindex(p.shape[0], p.shape[2]):
            roots = np.roots(derivative[piece, ::-1, joint])
            real = roots.real[(np.abs(roots.imag) <= 1e-7 * (1.0 + np.abs(roots))) & (roots.real > 0.0)]
            inside = np.minimum(real, lengths[piece])
            if len(inside):
                values = np.abs(np.polyval(p[piece, ::-1, joint], inside))
                found[joint] = max(found[joint], values.max())
        return found
    slope = np.where(derivative[:, 1] == 0.0, 1.0, derivative[:, 1])
    where = np.where(derivative[:, 1] == 0.0, 0.0, -derivative[:, 0] / slope)
    return np.maximum(found, np.abs(_at(p, np.clip(where, 0.0, lengths[:, None]))).max(axis=0))


def _at(p: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return the values (..., n) of polynomials p (..., k, n) at s, by Horner's method."""
    value = p[..., -1, :]
    for k in range(p.shape[-2] - 2, -1, -1):
        value = value * s + p[..., k, :]
    return value


def stretched(breaks: np.ndarray, c: np.ndarray, k: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the breaks and coefficients of the same path, slowed down by a factor of k."""
    return breaks * k, c / k ** LINE[:, None]


def along(start: np.ndarray, d: np.ndarray, duration: float, ramp: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the breaks and coefficients (M, 6, n) of a move from `start` by d with quadratic blends of `ramp` seconds.

    ``V = 1 / (duration - ramp)``, ``a = V / ramp``; no linear segment if ``ramp = duration / 2``.
    """
    V = 1.0 / (duration - ramp)
    half = 0.5 * V / ramp
    at = 0.5 * V * ramp  # position after the first blend
    c = np.zeros((3, DEGREE + 1, 1))
    c[0, 2] = half
    c[1, :2, 0] = at, V
    c[2, :3, 0] = 1.0 - at, V, -half
    breaks = np.array([0.0, ramp, duration - ramp, duration])
    c = c * d
    c[:, 0] += start
    line = breaks[2] > breaks[1]
    return (breaks, c) if line else (breaks[[0, 1, 3]], c[[0, 2]])


def ruckig_pieces(
    q0: np.ndarray, q1: np.ndarray, qd0: np.ndarray, qd1: np.ndarray, *limits: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the breaks (M + 1,) and coefficients (M, 6, n) of the motion planned by ruckig."""
    try:
        import ruckig  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtra(
            "Expected the package ruckig for time-optimal motion, but it is not installed. Install it: pip install "
            "'armlab[motion]'."
        ) from None
    n = len(q0)
    wanted, found = ruckig.InputParameter(n), ruckig.Trajectory(n)
    wanted.current_position, wanted.target_position = q0.tolist(), q1.tolist()
    wanted.current_velocity, wanted.target_velocity = qd0.tolist(), qd1.tolist()
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = (limit.tolist() for limit in limits)
    try:
        outcome = ruckig.Ruckig(n).calculate(wanted, found)
    except (ruckig.RuckigError, ValueError) as error:  # ValueError: an unknown result code
        said = " ".join(str(error).split())[:300].rstrip(".")
        raise ShapeError(f"Expected a motion that ruckig can plan, got: {said}.") from None
    if outcome not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise ShapeError(f"Expected a motion that ruckig can plan, got result {outcome}. Increase the limits.")
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
    """Return the times (m,) at which the jerk of a joint changes, and q, qd, qdd, jerk (m, 4) just after them."""
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
