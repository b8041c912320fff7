"""Excitation: trajectories that make parameters identifiable, friction runs, and the precision to expect.

    q_i(t) = centre_i + sum_k a_ik / (2 pi f0 k) sin(2 pi f0 k t) - b_ik / (2 pi f0 k) cos(2 pi f0 k t)

(Swevers et al. 1997). The record starts and ends at rest: a quintic window blends the motion in and out. Among seeded
candidates, each scaled to the limits, the one with the largest log det of the information of the base regressor is kept
(D-optimal; the units of the parameters do not change the order). Candidates that collide or that the motors cannot
drive are left out; those that are slow too seldom, or turn round too seldom for friction, come last.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab._numbers import generator, number, numbers
from armlab.errors import NotConverged, RobotError, ShapeError, UnknownName
from armlab.estimation import Excitation
from armlab.identify.regression import BaseParameters, base_parameters
from armlab.log import Table
from armlab.models.friction import FRICTION_TERMS
from armlab.robots import Robot
from armlab.state import Command, State

LONGEST_STEP = 0.006  # s that a controller's clock moves at once: 1.5 periods, what the bridge lets a reference move
REST = 1e-3  # rad/s or m/s at an end of a saved motion


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A joint motion that can be sampled at any time.

    Attributes
    ----------
    seconds : length.
    sample : gives q, qd, qdd (..., n) at times (...,); constant outside [0, seconds].
    """

    seconds: float
    sample: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]

    @property
    def q_first(self) -> np.ndarray:
        """Position (n,) at the start."""
        return self.sample(np.array(0.0))[0]

    def table(self, rate: float = 250.0) -> Table:
        """Return the motion as a log with q, qd, qdd (N, n), for `log.write`.

        Parameters
        ----------
        rate : samples per second [Hz].

        Raises
        ------
        ShapeError : for a rate that is not above 0.
        """
        if not 0 < rate < np.inf:
            raise ShapeError(f"Expected a rate above 0 Hz, got {rate:g} Hz. Give the rate of the controller.")
        t = np.append(np.arange(0.0, self.seconds - 0.5 / rate, 1.0 / rate), self.seconds)
        q, qd, qdd = self.sample(t)
        return Table(t, {"q": q, "qd": qd, "qdd": qdd}, source=("Trajectory.table",))

    @classmethod
    def from_table(cls, table: Table) -> Trajectory:
        """Return the motion that a table holds, to be run again: cubic between rows, with the slopes qd.

        Parameters
        ----------
        table : q and qd (N, n), at rest in the first and the last row.

        Raises
        ------
        ShapeError : fewer than two rows, missing values, or ends in motion.
        """
        from scipy.interpolate import CubicHermiteSpline

        t, q, qd = table.t, table["q"], table["qd"]
        if len(t) < 2 or q.shape != qd.shape or not (np.isfinite(q).all() and np.isfinite(qd).all()):
            raise ShapeError(
                f"Expected q and qd of one shape (N, n) without missing values, got {q.shape} and {qd.shape}. "
                "Save the motion again with Trajectory.table."
            )
        if np.abs(qd[[0, -1]]).max() > REST:
            raise ShapeError(
                f"Expected a motion at rest at both ends, got {np.abs(qd[[0, -1]]).max():.3g} rad/s. "
                "Blend it in and out; a robot cannot jump to a speed."
            )
        spline = CubicHermiteSpline(t, q, qd)
        first, second, begin, end = spline.derivative(), spline.derivative(2), t[0], t[-1]

        def sample(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            inside = np.clip(np.asarray(at, dtype=float) + begin, begin, end)
            return spline(inside), first(inside), second(inside)

        return cls(float(end - begin), sample)

    def controller(self, approach: float = 4.0) -> Callable[[State], Command]:
        """Return a controller that walks from where the arm stands to the start, then runs the motion.

        Its clock follows the robot's, but never by more than 6 ms at once: after lost packets the motion goes on
        where it was, without a jump. It starts again in each session.

        Parameters
        ----------
        approach : seconds of the walk (quintic, at rest at both ends).
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
    """Join motions that start and end at rest, with a quintic walk of `walk` seconds between them.

    Parameters
    ----------
    parts : at least one motion. walk : seconds of each walk, above 0.

    Raises
    ------
    ShapeError : for no parts, parts that are no motions, or no time to walk.
    """
    walk = number(walk, "the walk [s]")
    if not isinstance(parts, list | tuple) or not all(isinstance(part, Trajectory) for part in parts):
        raise ShapeError(
            f"Expected a list of motions, got {type(parts).__name__}. identify.design_excitation gives one."
        )
    if not parts or not 0 < walk < np.inf:
        raise ShapeError(f"Expected at least one motion and a walk above 0 s, got {len(parts)} and {walk:g} s.")
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
WIDTH, WIDER, NARROWER = 0.5, 1.2, 0.97  # of the search: about one step in seven wins
SLOW, SLOW_SHARE = 0.1, 0.15  # of the speed limit, and the least share of samples below it
TURNS_PER_SECOND = 10.0 / 60.0
MARGIN = 0.05  # rad or m, kept from the position limits; a tenth of the range where that is less


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
    """Design an excitation motion.

    Every joint is slower than a tenth of its limit in at least 15 % of the samples, and turns round at least ten times
    a minute, wherever a candidate does. With torque limits and masses in the robot file the motion stays within them.

    Parameters
    ----------
    robot : limits and dynamics.
    seconds : length, at least 10.
    f0 : base frequency [Hz].
    harmonics : number of them.
    speed : peak speed as a share of the robot's limits, in (0, 1].
    acceleration : peak acceleration [rad/s^2].
    centre : (n,) centre of the motion, inside the limits; it is moved 0.1 rad away from them. When left out, the
        robot's home, moved from the limits until every joint has 70 degrees to both sides (or half its range, where
        that is less).
    seed : of the candidates.
    sigma : (n,) deviation of the torque noise [N m], that weighs the joints; all alike when left out.
    collides : whether a pose (n,) must be avoided; asked ten times a second along each candidate.
    rounds : of a search around the best candidate, 5 ms each; 300 make the expected deviations about a fifth smaller.
    progress : called with (done, total, what).

    Returns
    -------
    Trajectory that stays 0.05 rad (or a tenth of the range) inside the position limits and below the other limits.

    Raises
    ------
    ShapeError : for a share outside (0, 1], a record that is too short, no harmonics, a centre outside the limits,
        noise that is not above 0, a seed below 0, or something else than numbers.
    NotConverged : when every candidate collides or is beyond the torque limits.
    """
    seconds, f0 = number(seconds, "seconds"), number(f0, "f0 [Hz]")
    speed, acceleration = number(speed, "the share of the speed"), number(acceleration, "acceleration [rad/s^2]")
    waves, tries = number(harmonics, "harmonics"), number(rounds, "rounds")
    if not 0 < speed <= 1 or not 10 <= seconds < np.inf:
        raise ShapeError(
            f"Expected a speed share in (0, 1] and at least 10 seconds, got {speed:g} and {seconds:g} s. "
            "Shorter motions do not excite friction at all speeds."
        )
    counts = 1 <= waves < np.inf and 0 <= tries < np.inf and waves % 1 == tries % 1 == 0
    if not 0 < f0 < np.inf or not acceleration > 0 or not counts:
        raise ShapeError(
            f"Expected f0 and acceleration above 0, at least one harmonic and rounds from 0, got {f0:g} Hz, "
            f"{acceleration:g}, {waves:g} and {tries:g}. Leave them out for the defaults."
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
            f"Expected a motion without collision and within the torque limits of {robot.name!r}, got none among "
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
    """Return the best of some candidates and of steps around it (1 + 1 evolution strategy); None without a good one."""
    total, found = len(draws) + rounds, []
    for k, draw in enumerate(draws):
        tell(k, total, "choosing among candidates")
        if (result := judged(draw)) is not None:
            found.append((draw, *result))
    if not found:
        return None
    draw, best, value = max(found, key=lambda candidate: candidate[2])
    width = WIDTH
    for k in range(rounds):
        tell(len(draws) + k, total, "searching around the best")
        trial = draw + width * rng.standard_normal(draw.shape)
        result = judged(trial)
        if result is not None and result[1] > value:
            draw, (best, value), width = trial, result, WIDER * width
        else:
            width *= NARROWER
    tell(total, total, "done")
    return best


def dither(
    centre: np.ndarray, seconds: float, amplitude: float = np.deg2rad(2.0), frequency: float = 0.5
) -> Trajectory:
    """Sway every joint gently about a pose, so that static friction cannot hide a small force.

    Joints have different phases: they do not all reverse at once.

    Parameters
    ----------
    centre : (n,) [rad]. seconds : length, above 0. amplitude : [rad]. frequency : [Hz].

    Raises
    ------
    ShapeError : for a length that is not above 0, or a pose, amplitude or frequency that is none.
    """
    seconds, amplitude = number(seconds, "seconds"), number(amplitude, "the amplitude [rad]")
    frequency = number(frequency, "the frequency [Hz]")
    if not 0 < seconds < np.inf:
        raise ShapeError(f"Expected a length above 0 s, got {seconds:g} s. Give the seconds of the motion.")
    centre = np.array(numbers(centre, "the pose", ShapeError))
    if centre.ndim != 1 or not np.isfinite(centre).all() or not np.isfinite(amplitude) or not 0 < frequency < np.inf:
        raise ShapeError(
            f"Expected a finite pose (n,) and amplitude and a frequency above 0 Hz, got shape {centre.shape}, "
            f"{amplitude:g} rad and {frequency:g} Hz. Give one position per joint [rad]."
        )
    omega = 2 * np.pi * frequency
    phase = np.arange(len(centre)) * 2 * np.pi / len(centre)

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, seconds)
        w, wd, wdd = (v[..., None] for v in _window(t, seconds))
        angle = omega * t[..., None] + phase
        x, xd = amplitude * np.sin(angle), amplitude * omega * np.cos(angle)
        return centre + w * x, w * xd + wd * x, -w * omega**2 * x + 2 * wd * xd + wdd * x

    return Trajectory(seconds, sample)


def _inside(robot: Robot, centre: np.ndarray) -> np.ndarray:
    """Return a centre (n,) moved away from the limits by twice the margin; refuse one outside them."""
    given = np.array(numbers(centre, "the centre", ShapeError))
    if given.shape != (robot.n,) or not np.all((given >= robot.q_min) & (given <= robot.q_max)):
        raise ShapeError(
            f"Expected a centre of shape ({robot.n},) inside the limits of {robot.name!r}, got {given.tolist()}. "
            "Give one position per joint [rad]."
        )
    margin = _margin(robot)
    return np.clip(given, robot.q_min + 2 * margin, robot.q_max - 2 * margin)


def _margin(robot: Robot) -> np.ndarray:
    return np.minimum(MARGIN, 0.1 * (robot.q_max - robot.q_min))


def _scaled(
    robot: Robot, centre: np.ndarray, a: np.ndarray, b: np.ndarray, f0: float, seconds: float, speed: float, peak: float
) -> Trajectory:
    """Scale each joint of a candidate as far as speed, acceleration and position limits allow."""
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
    """Return the quintic window that is 0 at both ends and 1 between the ramps, with two derivatives."""
    ramp = min(RAMP, seconds / 2)
    rising = t < seconds / 2
    w, wd, wdd = quintic_step(np.where(rising, t, seconds - t) / ramp)
    return w, np.where(rising, 1.0, -1.0) * wd / ramp, wdd / ramp**2


def _information(robot: Robot, base: BaseParameters, trajectory: Trajectory, f0: float, weights: np.ndarray) -> float:
    """Return log det of the information of the base parameters over one period."""
    t = np.linspace(RAMP, min(RAMP + 1.0 / f0, trajectory.seconds - RAMP), 100)
    A = _regressor(robot, base, *trajectory.sample(t)) * weights[:, None]
    A = A.reshape(-1, A.shape[2])
    sign, logdet = np.linalg.slogdet(A.T @ A)
    return float(logdet) if sign > 0 else -np.inf


def _regressor(robot: Robot, base: BaseParameters, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return the columns (N, n, p) of the base parameters."""
    n = robot.n
    rotor = np.zeros((len(q), n, n))
    rotor[:, range(n), range(n)] = qdd
    return np.concatenate([robot.chain.rigid_regressor(q, qd, qdd, robot.gravity), rotor], axis=2)[:, :, base.kept]


def _possible(robot: Robot, motion: Trajectory, collides: Callable[[np.ndarray], bool] | None) -> bool:
    """Tell whether the motors can drive a motion and it meets nothing."""
    q, qd, qdd = motion.sample(np.arange(0.0, motion.seconds, 0.1))
    if collides is not None and any(collides(pose) for pose in q):
        return False
    if robot.inertias is None or np.isinf(robot.tau_max).all():
        return True
    return bool(np.all(np.abs(robot.chain.rnea(q, qd, qdd, robot.gravity, robot.inertias)) <= robot.tau_max))


def _varied(robot: Robot, motion: Trajectory) -> bool:
    """Tell whether every joint is slow, and turns round, as often as friction needs."""
    qd = motion.sample(np.arange(0.0, motion.seconds, 0.01))[1]
    slow = np.mean(np.abs(qd) < SLOW * robot.qd_max, axis=0)
    turns = np.sum(np.diff(np.sign(qd[1:-1]), axis=0) != 0, axis=0)
    return bool(np.all(slow >= SLOW_SHARE) and np.all(turns >= TURNS_PER_SECOND * motion.seconds))


def _deviation(robot: Robot, sigma: np.ndarray) -> np.ndarray:
    values = numbers(sigma, "sigma", ShapeError)
    if values.shape != (robot.n,) or not np.all((values > 0) & np.isfinite(values)):
        raise ShapeError(
            f"Expected sigma of shape ({robot.n},) above 0 N m, got {values.tolist()}. Give one per joint."
        )
    return values


SPEEDS = 10
SLOWEST, FASTEST = 0.005, 0.8  # rad/s or m/s, share of the limit
HOLD = 2.0  # s
PERIODS = 10  # of torque ripple at least, at each speed
STROKE, SLIDE = 0.3, 0.05  # rad, m at least, and where the gears are not known
STEEPEST = 1.875  # largest slope of the quintic step
SHORTEST = 0.1  # s, of a change of speed


def friction_run(robot: Robot, joint: int | str, at: np.ndarray | None = None) -> Trajectory:
    """Design a motion of one joint at ten constant speeds, both ways; the others stay.

    Speeds are spaced evenly in logarithm from 0.005 rad/s to 80 % of the limit. At each the joint runs at constant
    speed over ten ripple periods, ``2 pi / (2 gear)``, and at least 0.3 rad (50 mm); it stands for 2 s between runs.
    The fifth speed comes again at the end: if friction differs there, it has warmed up.

    Parameters
    ----------
    robot : limits and gears.
    joint : its name, or its number from 0.
    at : (n,) pose of the other joints, inside the limits; the robot's home when left out. The joint itself sways about
        the middle of its range.

    Returns
    -------
    Trajectory that starts and ends at rest; sample it, run it with its controller, or save its table.

    Raises
    ------
    UnknownName : no such joint. ShapeError : a pose outside the limits, a joint without speed limit, or a range too
        short for the run.

    References
    ----------
    Bagge Carlson, Robertsson and Johansson, IROS 2015, for friction over position and speed.
    """
    i = _number(robot, joint)
    pose = np.array(robot.q_home if at is None else at, dtype=float)
    if pose.shape != (robot.n,) or not np.all((pose >= robot.q_min) & (pose <= robot.q_max)):
        raise ShapeError(
            f"Expected a pose of shape ({robot.n},) inside the limits of {robot.name!r}, got {pose.tolist()}. "
            "Give one position per joint [rad]."
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
        raise UnknownName(f"Expected the number of a joint from 0 to {robot.n - 1}, got {joint!r}. Count from 0.")
    return int(joint)


def _speeds(robot: Robot, i: int) -> tuple[np.ndarray, float]:
    """Return the speeds (10,) and the way at constant speed."""
    name, top = robot.joint_names[i], FASTEST * robot.qd_max[i]
    if not SLOWEST < top < np.inf or not 0 < robot.qdd_max[i] < np.inf:
        raise ShapeError(
            f"Expected limits of speed and acceleration of {name}, got {robot.qd_max[i]:g} and {robot.qdd_max[i]:g}. "
            "Put them into the robot file."
        )
    gear = abs(1.0 / robot.coupling[i, i])
    least = SLIDE if robot.prismatic[i] else STROKE
    stroke = max(least, PERIODS * np.pi / gear) if gear > 1 else least
    room = 0.9 * float(robot.q_max[i] - robot.q_min[i])
    ways = top * max(SHORTEST, STEEPEST * top / robot.qdd_max[i])  # to reach the speed and to lose it
    if stroke + ways > room:
        top = min(top, _largest(room - stroke, float(robot.qdd_max[i])))
    if top <= 2 * SLOWEST:
        raise ShapeError(
            f"Expected room for a run of {stroke:.3g} rad (m) at constant speed, got {name} with "
            f"{room:.3g} rad (m) inside its limits. Use identify.design_excitation for such a joint."
        )
    return np.geomspace(SLOWEST, top, SPEEDS), stroke


def _largest(ways: float, acceleration: float) -> float:
    """Return the speed that is reached and lost within `ways`; 0 where there is no room."""
    return max(0.0, min(ways / SHORTEST, np.sqrt(max(ways, 0.0) * acceleration / STEEPEST)))


def _phases(speeds: list[float], stroke: float, acceleration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the borders in time (k + 1,) and rows (3, k): speeds at start and end, position at start, about 0."""
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


# How well a motion will tell the parameters, before the robot has moved.


RATE = 250.0  # Hz, of the log that will be
THINNED = 50.0  # Hz, at which the regressor is evaluated
GROUPS = {"first moments": "kg m", "inertias": "kg m^2", "viscous": "N m s/rad", "Coulomb": "N m", "offset": "N m"}


@dataclass(frozen=True, eq=False)
class PredictedUncertainty:
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
        Rank, singular values and the weakest direction of the regressor.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: tuple[str, ...]
    sd: np.ndarray
    excitation: Excitation

    def rows(self) -> list[tuple[str, ...]]:
        """Return per group: parameters, median and largest expected deviation, the worst by name; the head first."""
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
    """Predict the uncertainty of the torque model's parameters from a motion.

    The covariance is ``s^2 (A^T A)^-1`` with the regressor A of base parameters and friction along the motion,
    logged at 250 Hz. Real residuals are coloured: expect standard deviations a few times larger, in the same order.

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
            f"Expected a Trajectory, got {type(trajectory).__name__}. identify.design_excitation gives one."
        )
    n, noise = robot.n, number(noise, "the torque noise [N m]")
    if not 0 < noise < np.inf or trajectory.q_first.shape != (n,):
        raise ShapeError(
            f"Expected a torque noise above 0 N m and a motion of {n} joints, got {noise:g} and "
            f"{trajectory.q_first.shape}. Give the deviation of the torque signal at rest."
        )
    q, qd, qdd = trajectory.sample(np.arange(0.0, trajectory.seconds, 1.0 / THINNED))
    base = base_parameters(robot)
    p, terms = len(base.names), [FRICTION_TERMS[name] for name in ("viscous", "coulomb+", "coulomb-", "offset")]
    A = np.zeros((len(q), n, p + len(terms) * n))
    A[:, :, :p] = _regressor(robot, base, q, qd, qdd)
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
