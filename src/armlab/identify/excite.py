"""Excitation trajectories, friction runs, and the predicted parameter uncertainty.

    q_i(t) = centre_i + sum_k a_ik / (2 pi f0 k) sin(2 pi f0 k t) - b_ik / (2 pi f0 k) cos(2 pi f0 k t)

(Swevers et al. 1997). A quintic window blends the motion in and out, so that the motion starts and ends at rest. Seeded
random candidates are scaled to the limits. The candidate whose base regressor has the largest log determinant of the
information matrix is selected (D-optimality, which is independent of the parameter units). Candidates that collide or
exceed the motor torques are discarded; candidates with too little slow motion or too few reversals to identify friction
are ranked last.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab._display import Shown
from armlab._numbers import generator, number, numbers
from armlab.dynamics import BaseParameters, base_parameters, base_regressor
from armlab.errors import NotConverged, RobotError, ShapeError, UnknownName
from armlab.estimation import Excitation
from armlab.log import Table
from armlab.models.friction import FRICTION_TERMS
from armlab.robots import Robot
from armlab.state import Command, State

LONGEST_STEP = 0.006  # largest step of a controller's clock [s]: 1.5 periods, as in the bridge
REST = 1e-3  # largest speed at an end of a saved motion, rad/s or m/s


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Shown):
    """Joint motion that can be sampled at any time.

    Attributes
    ----------
    seconds : duration [s].
    sample : function of times (...,) that returns q, qd, qdd (..., n); constant outside [0, seconds].
    """

    seconds: float
    sample: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]

    @property
    def q_first(self) -> np.ndarray:
        """Start position (n,)."""
        return self.sample(np.array(0.0))[0]

    def table(self, rate: float = 250.0) -> Table:
        """Return the motion as a log with q, qd, qdd (N, n), for `log.write`.

        Parameters
        ----------
        rate : samples per second [Hz].

        Raises
        ------
        ShapeError : the rate is not positive.
        """
        if not 0 < rate < np.inf:
            raise ShapeError(f"Expected a rate above 0 Hz, got {rate:g} Hz. Pass the rate of the controller.")
        t = np.append(np.arange(0.0, self.seconds - 0.5 / rate, 1.0 / rate), self.seconds)
        q, qd, qdd = self.sample(t)
        return Table(t, {"q": q, "qd": qd, "qdd": qdd}, source=("Trajectory.table",))

    @classmethod
    def from_table(cls, table: Table) -> Trajectory:
        """Return a saved motion, interpolated between rows by cubic Hermite splines with derivatives qd.

        Parameters
        ----------
        table : log with q and qd (N, n), at rest in the first and the last row.

        Raises
        ------
        ShapeError : fewer than two rows, missing values, or a motion that is not at rest at both ends.
        """
        from scipy.interpolate import CubicHermiteSpline

        t, q, qd = table.t, table["q"], table["qd"]
        if len(t) < 2 or q.shape != qd.shape or not (np.isfinite(q).all() and np.isfinite(qd).all()):
            raise ShapeError(
                f"Expected q and qd of equal shape (N, n) without missing values, got {q.shape} and {qd.shape}. "
                "Save the motion again with Trajectory.table."
            )
        if np.abs(qd[[0, -1]]).max() > REST:
            raise ShapeError(
                f"Expected a motion at rest at both ends, got {np.abs(qd[[0, -1]]).max():.3g} rad/s. "
                "Blend the motion in and out, because a robot cannot start at non-zero speed."
            )
        spline = CubicHermiteSpline(t, q, qd)
        first, second, begin, end = spline.derivative(), spline.derivative(2), t[0], t[-1]

        def sample(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            inside = np.clip(np.asarray(at, dtype=float) + begin, begin, end)
            return spline(inside), first(inside), second(inside)

        return cls(float(end - begin), sample)

    def controller(self, approach: float = 4.0) -> Callable[[State], Command]:
        """Return a controller that moves from the current posture to the start, then runs the motion.

        The controller's clock advances with the robot's clock, but by at most 6 ms per cycle, so the motion continues
        without a jump after lost packets. The controller restarts the motion in each session.

        Parameters
        ----------
        approach : duration of the motion to the start [s] (quintic, at rest at both ends).
        """
        clock, session = 0.0, 0

        def step(state: State) -> Command:
            nonlocal clock, session
            clock = clock + min(state.dt, LONGEST_STEP) if state.session == session else 0.0
            session = state.session
            if clock < approach:
                s, ds, _ = quintic_step(clock / approach)
                way = self.q_first - state.q_start
                return Command(q=state.q_start + s * way, qd=ds / approach * way)
            q, qd, _ = self.sample(np.array(clock - approach))
            return Command(q=q, qd=qd)

        return step


def quintic_step(x: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the smooth step ``x^3 (10 - 15 x + 6 x^2)`` of x in [0, 1] and its two derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x), 30 * x * x * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)


def sequence(parts: Sequence[Trajectory], walk: float = 2.0) -> Trajectory:
    """Join motions that start and end at rest, connected by quintic motions of `walk` seconds.

    Parameters
    ----------
    parts : at least one motion.
    walk : duration of each connecting motion [s], above 0.

    Raises
    ------
    ShapeError : no parts, parts that are not motions, or an invalid duration.
    """
    walk = number(walk, "the walk [s]")
    if not isinstance(parts, list | tuple) or not all(isinstance(part, Trajectory) for part in parts):
        raise ShapeError(f"Expected a list of motions, got {type(parts).__name__}. Use identify.design_excitation.")
    if not parts or not 0 < walk < np.inf:
        raise ShapeError(
            f"Expected at least one motion and a connecting duration above 0 s, got {len(parts)} motions and "
            f"{walk:g} s."
        )
    starts = np.cumsum([0.0, *(part.seconds + walk for part in parts[:-1])])
    total = float(starts[-1] + parts[-1].seconds)

    def one(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        k = int(np.searchsorted(starts, t, side="right")) - 1
        local = t - starts[k]
        if local <= parts[k].seconds or k == len(parts) - 1:
            return parts[k].sample(np.array(local))
        here, there = parts[k].sample(np.array(parts[k].seconds))[0], parts[k + 1].q_first
        s, ds, dds = quintic_step((local - parts[k].seconds) / walk)
        return here + s * (there - here), ds / walk * (there - here), dds / walk**2 * (there - here)

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, total)
        if t.ndim == 0:
            return one(float(t))
        rows = [one(float(x)) for x in t.ravel()]
        q, qd, qdd = (np.array([row[k] for row in rows]).reshape(*t.shape, -1) for k in range(3))
        return q, qd, qdd

    return Trajectory(total, sample)


RAMP = 2.0  # s, blend at each end
CANDIDATES = 60
WIDTH, WIDER, NARROWER = 0.5, 1.2, 0.97  # search widths: about one step in seven is accepted
SLOW, SLOW_SHARE = 0.1, 0.15  # share of the speed limit, and required share of samples below that speed
TURNS_PER_SECOND = 10.0 / 60.0
MARGIN = 0.05  # rad or m, distance to the position limits; a tenth of the range if that is less


def design_excitation(
    robot: Robot,
    seconds: float = 60.0,
    f0: float = 0.1,
    harmonics: int = 8,
    speed: float = 0.6,
    acceleration: float = 15.0,
    centre: np.ndarray | None = None,
    seed: int = 0,
    sigma: np.ndarray | None = None,
    collides: Callable[[np.ndarray], bool] | None = None,
    rounds: int = 0,
    *,
    progress: Callable[[int, int, str], None] | None = None,
) -> Trajectory:
    """Design an excitation trajectory.

    Every joint is slower than a tenth of its limit in at least 15 % of the samples, and reverses at least ten times per
    minute, if any candidate achieves this. If the robot file has torque limits and masses, the motion respects these
    limits.

    Parameters
    ----------
    robot : robot with limits and dynamics.
    seconds : duration [s], at least 10.
    f0 : base frequency [Hz].
    harmonics : number of harmonics.
    speed : peak speed as a fraction of the robot's limits, in (0, 1].
    acceleration : peak acceleration [rad/s^2].
    centre : (n,) centre of the motion, inside the limits; it is moved to at least 0.1 rad from the limits. Default: the
        robot's home, moved away from the limits until every joint has 70 degrees on both sides (or half its range, if
        that is smaller).
    seed : seed of the random candidates.
    sigma : (n,) standard deviation of the torque noise [N m], which weights the joints; default: equal.
    collides : collision check of a posture (n,), called ten times per second along each candidate.
    rounds : steps of a search around the best candidate, which take 5 ms each; 300 steps reduce the predicted standard
        deviations by about 20 %.
    progress : called with (done, total, what).

    Returns
    -------
    Trajectory that stays 0.05 rad (or a tenth of the range) inside the position limits and below the other limits; with
    coupled motors, inside the limits of both the joints and the controller's axes.

    Raises
    ------
    ShapeError : a fraction outside (0, 1], a duration that is too short, no harmonics, a centre outside the limits,
        non-positive noise, a negative seed, or non-numeric values.
    NotConverged : every candidate collides or exceeds the torque limits.
    """
    seconds, f0 = number(seconds, "seconds"), number(f0, "f0 [Hz]")
    speed, acceleration = number(speed, "the speed share"), number(acceleration, "acceleration [rad/s^2]")
    waves, tries = number(harmonics, "harmonics"), number(rounds, "rounds")
    if not 0 < speed <= 1 or not 10 <= seconds < np.inf:
        raise ShapeError(
            f"Expected a speed fraction in (0, 1] and at least 10 seconds, got {speed:g} and {seconds:g} s. "
            "Shorter motions do not excite friction at all speeds."
        )
    counts = 1 <= waves < np.inf and 0 <= tries < np.inf and waves % 1 == tries % 1 == 0
    if not 0 < f0 < np.inf or not acceleration > 0 or not counts:
        raise ShapeError(
            f"Expected f0 and acceleration above 0, at least one harmonic and rounds of at least 0, got {f0:g} Hz, "
            f"{acceleration:g}, {waves:g} and {tries:g}. Omit these arguments to use the defaults."
        )
    rng = generator(seed)
    base = base_parameters(robot)
    room = np.minimum(np.deg2rad(70.0), 0.5 * (robot.q_max - robot.q_min))
    home = np.clip(robot.q_home, robot.q_min + room, robot.q_max - room)
    middle = home if centre is None else _inside(robot, centre)
    draws = rng.standard_normal((CANDIDATES, 2, int(harmonics), robot.n))
    weights = 1.0 / _deviation(robot, np.ones(robot.n) if sigma is None else sigma)

    def judged(draw: np.ndarray) -> tuple[Trajectory, tuple[bool, float]] | None:
        sines, cosines = draw
        motion = _scaled(robot, middle, sines, cosines, f0, seconds, speed, acceleration)
        if not _possible(robot, motion, collides):
            return None
        return motion, (_varied(robot, motion), _information(robot, base, motion, f0, weights))

    best = _search(judged, draws, int(rounds), rng, progress or (lambda done, total, what: None))
    if best is None:
        raise NotConverged(
            f"Expected a collision-free motion within the torque limits of {robot.name!r}, got none among "
            f"{CANDIDATES} candidates. Move the centre, or lower speed and acceleration."
        )
    return best


def _search(
    judged: Callable[[np.ndarray], tuple[Trajectory, tuple[bool, float]] | None],
    draws: np.ndarray,
    rounds: int,
    rng: np.random.Generator,
    tell: Callable[[int, int, str], None],
) -> Trajectory | None:
    """Return the best candidate, improved by a (1 + 1) evolution strategy, or None if no candidate is valid."""
    total, found = len(draws) + rounds, []
    for k, draw in enumerate(draws):
        tell(k, total, "evaluating candidates")
        if (result := judged(draw)) is not None:
            found.append((draw, *result))
    if not found:
        return None
    draw, best, value = max(found, key=lambda candidate: candidate[2])
    width = WIDTH
    for k in range(rounds):
        tell(len(draws) + k, total, "refining the best candidate")
        trial = draw + width * rng.standard_normal(draw.shape)
        result = judged(trial)
        if result is not None and result[1] > value:
            draw, (best, value), width = trial, result, WIDER * width
        else:
            width *= NARROWER
    tell(total, total, "done")
    return best


SWAY = float(np.deg2rad(2.0))  # rad or m


def dither(
    centre: np.ndarray, seconds: float, amplitude: float | np.ndarray = SWAY, frequency: float = 0.5
) -> Trajectory:
    """Return a small oscillation of every joint about a posture, which prevents static friction from masking forces.

    Joints have different phases, so they do not reverse simultaneously.

    Parameters
    ----------
    centre : (n,) centre of the oscillation [rad or m].
    seconds : duration [s], above 0.
    amplitude : amplitude of all joints, or of each joint (n,) [rad or m].
    frequency : frequency [Hz].

    Raises
    ------
    ShapeError : a non-positive duration, or an invalid posture, amplitude or frequency.
    """
    seconds, width = number(seconds, "seconds"), numbers(amplitude, "the amplitude [rad]", ShapeError)
    frequency = number(frequency, "the frequency [Hz]")
    if not 0 < seconds < np.inf:
        raise ShapeError(f"Expected a duration above 0 s, got {seconds:g} s. Pass the duration of the motion.")
    centre = np.array(numbers(centre, "the pose", ShapeError))
    fits = centre.ndim == 1 and width.shape in ((), centre.shape)
    if not fits or not np.isfinite(centre).all() or not np.isfinite(width).all() or not 0 < frequency < np.inf:
        raise ShapeError(
            f"Expected finite joint positions (n,), a finite amplitude and a frequency above 0 Hz, got shape "
            f"{centre.shape}, {width} rad and {frequency:g} Hz. Pass one position per joint [rad]."
        )
    omega = 2 * np.pi * frequency
    phase = np.arange(len(centre)) * 2 * np.pi / len(centre)

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, seconds)
        w, wd, wdd = (v[..., None] for v in _window(t, seconds))
        angle = omega * t[..., None] + phase
        x, xd = width * np.sin(angle), width * omega * np.cos(angle)
        return centre + w * x, w * xd + wd * x, -w * omega**2 * x + 2 * wd * xd + wdd * x

    return Trajectory(seconds, sample)


def _inside(robot: Robot, centre: np.ndarray) -> np.ndarray:
    """Return a centre (n,) moved to at least two margins inside the limits; raise an error if the given centre is
    outside the limits."""
    given = np.array(numbers(centre, "the centre", ShapeError))
    if given.shape != (robot.n,) or not np.all((given >= robot.q_min) & (given <= robot.q_max)):
        raise ShapeError(
            f"Expected a centre of shape ({robot.n},) inside the limits of {robot.name!r}, got {given.tolist()}. "
            "Pass one position per joint [rad]."
        )
    margin = _margin(robot)
    return np.clip(given, robot.q_min + 2 * margin, robot.q_max - 2 * margin)


def _margin(robot: Robot) -> np.ndarray:
    return np.minimum(MARGIN, 0.1 * (robot.q_max - robot.q_min))


def _scaled(
    robot: Robot, centre: np.ndarray, a: np.ndarray, b: np.ndarray, f0: float, seconds: float, speed: float, peak: float
) -> Trajectory:
    """Scale each joint of a candidate as far as the speed, acceleration and position limits allow."""
    t = np.linspace(0, seconds, int(seconds * 100))
    q, qd, qdd = _fourier(centre, a, b, f0, seconds)(t)
    margin = _margin(robot)
    room_up, room_down = robot.q_max - margin - centre, centre - robot.q_min - margin
    shares = np.stack(
        [
            speed * robot.qd_max / np.abs(qd).max(axis=0),
            np.minimum(peak, robot.qdd_max) / np.abs(qdd).max(axis=0),
            room_up / np.maximum((q - centre).max(axis=0), 1e-9),
            room_down / np.maximum((centre - q).max(axis=0), 1e-9),
        ]
    )
    scale = shares.min(axis=0)
    coupled = robot.coupling / np.diag(robot.coupling)
    if np.any(coupled - np.eye(robot.n)):  # the controller's limits apply to its axes, on the joint side of the gears
        axes = np.linalg.inv(coupled)
        way, rate, middle = (q - centre) * scale @ axes.T, qd * scale @ axes.T, axes @ centre
        up, down = robot.q_max - margin - middle, middle - robot.q_min - margin
        shares = np.stack(
            [
                robot.qd_max / np.maximum(np.abs(rate).max(axis=0), 1e-9),
                up / np.maximum(way.max(axis=0), 1e-9),
                down / np.maximum(-way.min(axis=0), 1e-9),
            ]
        ).min(axis=0)
        for axis in np.flatnonzero(shares < 1.0):
            scale[axes[axis] != 0.0] *= max(shares[axis], 0.0)
    return Trajectory(seconds, _fourier(centre, a * scale, b * scale, f0, seconds))


def _fourier(
    centre: np.ndarray, a: np.ndarray, b: np.ndarray, f0: float, seconds: float
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the blended Fourier motion as a function of time; a, b (harmonics, n) are velocity amplitudes."""
    omega = 2 * np.pi * f0 * np.arange(1, len(a) + 1)

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, seconds)
        phase = t[..., None] * omega
        s, c = np.sin(phase), np.cos(phase)
        x = (s / omega) @ a - (c / omega) @ b
        xd = c @ a + s @ b
        xdd = -(s * omega) @ a + (c * omega) @ b
        w, wd, wdd = (v[..., None] for v in _window(t, seconds))
        return centre + w * x, w * xd + wd * x, w * xdd + 2 * wd * xd + wdd * x

    return sample


def _window(t: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the quintic window, which is 0 at both ends and 1 between the ramps, with its first two derivatives."""
    ramp = min(RAMP, seconds / 2)
    rising = t < seconds / 2
    w, wd, wdd = quintic_step(np.where(rising, t, seconds - t) / ramp)
    return w, np.where(rising, 1.0, -1.0) * wd / ramp, wdd / ramp**2


def _information(robot: Robot, base: BaseParameters, trajectory: Trajectory, f0: float, weights: np.ndarray) -> float:
    """Return the log determinant of the base-parameter information matrix over one period."""
    t = np.linspace(RAMP, min(RAMP + 1.0 / f0, trajectory.seconds - RAMP), 100)
    A = base_regressor(robot, *trajectory.sample(t), base) * weights[:, None]
    A = A.reshape(-1, A.shape[2])
    sign, logdet = np.linalg.slogdet(A.T @ A)
    return float(logdet) if sign > 0 else -np.inf


def _possible(robot: Robot, motion: Trajectory, collides: Callable[[np.ndarray], bool] | None) -> bool:
    """Return whether a motion respects the motor torque limits and is free of collisions."""
    q, qd, qdd = motion.sample(np.arange(0.0, motion.seconds, 0.1))
    if collides is not None and any(collides(pose) for pose in q):
        return False
    if robot.inertias is None or np.isinf(robot.tau_max).all():
        return True
    return bool(np.all(np.abs(robot.chain.rnea(q, qd, qdd, robot.gravity, robot.inertias)) <= robot.tau_max))


def _varied(robot: Robot, motion: Trajectory) -> bool:
    """Return whether every joint has enough slow motion and reversals to identify friction."""
    qd = motion.sample(np.arange(0.0, motion.seconds, 0.01))[1]
    slow = np.mean(np.abs(qd) < SLOW * robot.qd_max, axis=0)
    turns = np.sum(np.diff(np.sign(qd[1:-1]), axis=0) != 0, axis=0)
    return bool(np.all(slow >= SLOW_SHARE) and np.all(turns >= TURNS_PER_SECOND * motion.seconds))


def _deviation(robot: Robot, sigma: np.ndarray) -> np.ndarray:
    values = numbers(sigma, "sigma", ShapeError)
    if values.shape != (robot.n,) or not np.all((values > 0) & np.isfinite(values)):
        raise ShapeError(
            f"Expected sigma of shape ({robot.n},) above 0 N m, got {values.tolist()}. Pass one value per joint."
        )
    return values


SPEEDS = 10
SLOWEST, FASTEST = 0.005, 0.8  # rad/s or m/s, share of the limit
HOLD = 2.0  # s
PERIODS = 10  # minimum periods of torque ripple at each speed
STROKE, SLIDE = 0.3, 0.05  # rad, m; minimum, and default for unknown gears
STEEPEST = 1.875  # largest slope of the quintic step
SHORTEST = 0.1  # s, minimum duration of a speed change


def friction_run(robot: Robot, joint: int | str, at: np.ndarray | None = None) -> Trajectory:
    """Design a motion of one joint at ten constant speeds in both directions; the other joints hold their positions.

    Speeds are logarithmically spaced from 0.005 rad/s to 80 % of the limit. Each run has constant speed over ten ripple
    periods ``2 pi / (2 gear)`` and over at least 0.3 rad (50 mm). The joint rests for 2 s between runs. The fifth speed
    is repeated at the end: if the friction differs, the joint has warmed up.

    Parameters
    ----------
    robot : robot with limits and gears.
    joint : name of the joint, or its number from 0.
    at : (n,) posture of the other joints, inside the limits; default: the robot's home. The joint itself moves about
        the middle of its range.

    Returns
    -------
    Trajectory that starts and ends at rest; it can be sampled, run with its controller, or saved as a table.

    Raises
    ------
    UnknownName : the joint does not exist.
    ShapeError : a posture outside the limits, a joint without a speed limit, or a range that is too short.

    References
    ----------
    Bagge Carlson, Robertsson and Johansson, IROS 2015 (friction as a function of position and speed).
    """
    i = _number(robot, joint)
    pose = np.array(robot.q_home if at is None else at, dtype=float)
    if pose.shape != (robot.n,) or not np.all((pose >= robot.q_min) & (pose <= robot.q_max)):
        raise ShapeError(
            f"Expected a pose of shape ({robot.n},) inside the limits of {robot.name!r}, got {pose.tolist()}. "
            "Pass one position per joint [rad]."
        )
    speeds, stroke = _speeds(robot, i)
    bounds = np.array([robot.q_min[i], robot.q_max[i]])
    middle = bounds.mean() if np.all(np.isfinite(bounds)) else pose[i]
    times, rows = _phases([*speeds, speeds[SPEEDS // 2 - 1]], stroke, float(robot.qdd_max[i]))
    v0, v1, q0 = rows

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, times[-1])
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(q0) - 1)
        T = times[k + 1] - times[k]
        x = (t - times[k]) / T
        q, qd, qdd = (start + np.zeros((*t.shape, robot.n)) for start in (pose, 0.0, 0.0))
        change = v1[k] - v0[k]
        q[..., i] = middle + q0[k] + T * (v0[k] * x + change * x**4 * (2.5 - 3 * x + x * x))
        s, ds, _ = quintic_step(x)
        qd[..., i] = v0[k] + change * s
        qdd[..., i] = change / T * ds
        return q, qd, qdd

    return Trajectory(float(times[-1]), sample)


def _number(robot: Robot, joint: int | str) -> int:
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    names = robot.joint_names
    if isinstance(joint, str):
        if joint not in names:
            raise UnknownName.among("joint", joint, names)
        return names.index(joint)
    if not isinstance(joint, int | np.integer) or isinstance(joint, bool) or not 0 <= joint < robot.n:
        raise UnknownName(f"Expected a joint number from 0 to {robot.n - 1}, got {joint!r}. Number the joints from 0.")
    return int(joint)


def _speeds(robot: Robot, i: int) -> tuple[np.ndarray, float]:
    """Return the speeds (10,) and the distance at constant speed."""
    name, top = robot.joint_names[i], FASTEST * robot.qd_max[i]
    if not SLOWEST < top < np.inf or not 0 < robot.qdd_max[i] < np.inf:
        raise ShapeError(
            f"Expected speed and acceleration limits for {name}, got {robot.qd_max[i]:g} and {robot.qdd_max[i]:g}. "
            "Add these limits to the robot file."
        )
    gear = abs(1.0 / robot.coupling[i, i])
    least = SLIDE if robot.prismatic[i] else STROKE
    stroke = max(least, PERIODS * np.pi / gear) if gear > 1 else least
    room = 0.9 * float(robot.q_max[i] - robot.q_min[i])
    ways = top * max(SHORTEST, STEEPEST * top / robot.qdd_max[i])  # distance to accelerate and decelerate
    if stroke + ways > room:
        top = min(top, _largest(room - stroke, float(robot.qdd_max[i])))
    if top <= 2 * SLOWEST:
        raise ShapeError(
            f"Expected room for a run of {stroke:.3g} rad (m) at constant speed, got {name} with "
            f"{room:.3g} rad (m) inside its limits. Use identify.design_excitation for this joint."
        )
    return np.geomspace(SLOWEST, top, SPEEDS), stroke


def _largest(ways: float, acceleration: float) -> float:
    """Return the highest speed that a joint can reach and then stop from within the distance `ways`, or 0 if there is
    no room."""
    return max(0.0, min(ways / SHORTEST, np.sqrt(max(ways, 0.0) * acceleration / STEEPEST)))


def _phases(speeds: list[float], stroke: float, acceleration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the time boundaries (k + 1,) of the phases, and rows (3, k): start speed, end speed, and start position in
    a motion centred about 0."""
    parts: list[tuple[float, float, float]] = []
    for v in speeds:
        ramp = max(SHORTEST, STEEPEST * v / acceleration)
        for sign in (1.0, -1.0):
            w = sign * v
            parts += [(HOLD, 0.0, 0.0), (ramp, 0.0, w), (stroke / v, w, w), (ramp, w, 0.0)]
    parts.append((HOLD, 0.0, 0.0))
    length, v0, v1 = np.array(parts).T
    times = np.concatenate([[0.0], np.cumsum(length)])
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (v0 + v1) * length)])
    return times, np.stack([v0, v1, moved[:-1] - 0.5 * moved.max()])


# Predicted parameter uncertainty of an excitation trajectory.


RATE = 250.0  # Hz, rate of the predicted log
THINNED = 50.0  # Hz, rate at which the regressor is evaluated
GROUPS = {"first moments": "kg m", "inertias": "kg m^2", "viscous": "N m s/rad", "Coulomb": "N m", "offset": "N m"}


@dataclass(frozen=True, eq=False, repr=False)
class PredictedUncertainty(Shown):
    """Predicted parameter uncertainty of an excitation trajectory.

    Attributes
    ----------
    names : tuple of str, length d
        Parameters: base parameters, then viscous, coulomb+, coulomb- and offset of each joint.
    units : tuple of str, length d
        Unit of each parameter.
    groups : tuple of str, length d
        Group of each parameter: "first moments", "inertias", "viscous", "Coulomb" or "offset".
    sd : array, shape (d,), units of the parameters
        Expected standard deviations for white torque noise.
    excitation : Excitation
        Rank, singular values and weakest direction of the regressor.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: tuple[str, ...]
    sd: np.ndarray
    excitation: Excitation

    def rows(self) -> list[tuple[str, ...]]:
        """Return the header and a row per group: parameter count, median SD, largest SD and its parameter."""
        rows = [("group", "unit", "parameters", "median sd", "largest sd", "of")]
        for group, unit in GROUPS.items():
            places = [i for i, name in enumerate(self.groups) if name == group]
            if not places:
                continue
            worst = max(places, key=lambda i: self.sd[i])
            median, leader = np.median(self.sd[places]), re.split(r" [+-] ", self.names[worst])[0]
            rows.append((group, unit, str(len(places)), f"{median:.2g}", f"{self.sd[worst]:.2g}", leader))
        return rows


def predicted_uncertainty(trajectory: Trajectory, robot: Robot, noise: float = 0.1) -> PredictedUncertainty:
    """Predict the parameter uncertainty of a torque model identified from a motion.

    The covariance is ``s^2 (A^T A)^-1``, with A the regressor of base parameters and friction along the motion, sampled
    at 250 Hz. Real residuals are coloured, so expect standard deviations that are a few times larger but similarly
    ranked.

    Parameters
    ----------
    trajectory : Trajectory
        Motion of n joints, for example from `design_excitation`.
    robot : Robot
        Robot of n joints.
    noise : float, N m
        Standard deviation of each torque sample; the expected standard deviations are proportional to it.

    Returns
    -------
    PredictedUncertainty
        Expected standard deviations of the parameters and the excitation of the motion.

    Raises
    ------
    RobotError : `robot` is not a robot.
    ShapeError : `trajectory` is not a trajectory of n joints, or `noise` is not a finite number above 0 N m.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    if not isinstance(trajectory, Trajectory):
        raise ShapeError(
            f"Expected a Trajectory, got {type(trajectory).__name__}. "
            "Create a trajectory with identify.design_excitation."
        )
    n, noise = robot.n, number(noise, "the torque noise [N m]")
    if not 0 < noise < np.inf or trajectory.q_first.shape != (n,):
        raise ShapeError(
            f"Expected a torque noise above 0 N m and a motion of {n} joints, got {noise:g} and "
            f"{trajectory.q_first.shape}. Pass the standard deviation of the torque signal at rest."
        )
    q, qd, qdd = trajectory.sample(np.arange(0.0, trajectory.seconds, 1.0 / THINNED))
    base = base_parameters(robot)
    p, terms = len(base.names), [FRICTION_TERMS[name] for name in ("viscous", "coulomb+", "coulomb-", "offset")]
    A = np.zeros((len(q), n, p + len(terms) * n))
    A[:, :, :p] = base_regressor(robot, q, qd, qdd, base)
    for i in range(n):
        own = [term.column(qd[:, i], np.sign(qd[:, i])) for term in terms if term.column]
        A[:, i, p + len(terms) * i : p + len(terms) * (i + 1)] = np.stack(own, axis=1)
    own_joints = [(name, bool(slide)) for name, slide in zip(robot.joint_names, robot.prismatic)]
    joints = [(f"{term.name} {name}", term.units(slide)) for name, slide in own_joints for term in terms]
    names = (*base.names, *(name for name, _ in joints))
    units = (*base.units, *(unit for _, unit in joints))
    R = np.linalg.qr(A.reshape(-1, len(names)), mode="r") * np.sqrt(RATE / THINNED) / noise
    found = Excitation.of(R, names)
    inverse = (found.vectors / np.maximum(found.singular_values, 1e-12)) / found.scale[:, None]
    sd = np.sqrt(np.sum(inverse**2, axis=1))
    return PredictedUncertainty(names, units, tuple(_group(name, unit) for name, unit in zip(names, units)), sd, found)


def _group(name: str, unit: str) -> str:
    if name.startswith("coulomb"):
        return "Coulomb"
    if name.startswith(("viscous", "offset")):
        return name.split()[0]
    return "first moments" if unit == "kg m" else "inertias"
