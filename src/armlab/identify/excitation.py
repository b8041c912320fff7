"""Excitation: periodic joint motion that tells the parameters apart.

    q_i(t) = centre_i + sum_k a_ik / (2 pi f0 k) sin(2 pi f0 k t) - b_ik / (2 pi f0 k) cos(2 pi f0 k t)

(Swevers et al. 1997). The record starts and ends at rest: a quintic window blends the motion in and out. Among seeded
candidates, each scaled to the limits, the one with the largest log det of the information of the base regressor is kept
(D-optimal; the units of the parameters do not change the order). Candidates that collide or that the motors cannot
drive are left out; those that are slow too seldom, or turn round too seldom for friction, come last.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armlab._numbers import generator, number, numbers
from armlab.errors import NotConverged, ShapeError
from armlab.identify.base_parameters import BaseParameters, base_parameters
from armlab.identify.trajectory import Trajectory
from armlab.robots import Robot

__all__ = ["dither", "excitation"]

RAMP = 2.0  # s, blend at each end
CANDIDATES = 60
WIDTH, WIDER, NARROWER = 0.5, 1.2, 0.97  # of the search: about one step in seven wins
SLOW, SLOW_SHARE = 0.1, 0.15  # of the speed limit, and the least share of samples below it
TURNS_PER_SECOND = 10.0 / 60.0
MARGIN = 0.05  # rad or m, kept from the position limits; a tenth of the range where that is less


def excitation(
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
    collides : tells whether a pose (n,) must be avoided; asked ten times a second along each candidate.
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
    middle = _with_room(robot) if centre is None else _inside(robot, centre)
    draws = rng.standard_normal((CANDIDATES, 2, int(harmonics), robot.n))
    weights = 1.0 / _deviation(robot, np.ones(robot.n) if sigma is None else sigma)

    def judged(draw: np.ndarray) -> tuple[Trajectory, tuple[bool, float]] | None:
        sines, cosines = draw
        motion = _scaled(robot, middle, sines, cosines, f0, seconds, speed, acceleration)
        if not _possible(robot, motion, collides):
            return None
        return motion, (_varied(robot, motion), _information(robot, base, motion, f0, weights))

    tell, total = progress or (lambda done, total, what: None), CANDIDATES + int(rounds)
    found = []
    for k, draw in enumerate(draws):
        tell(k, total, "choosing among candidates")
        if (result := judged(draw)) is not None:
            found.append((draw, *result))
    if not found:
        raise NotConverged(
            f"Expected a motion without collision and within the torque limits of {robot.name!r}, got none among "
            f"{CANDIDATES} candidates. Move the centre, or lower speed and acceleration."
        )
    draw, best, value = max(found, key=lambda candidate: candidate[2])
    width = WIDTH
    for k in range(int(rounds)):
        tell(CANDIDATES + k, total, "searching around the best")
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


def _with_room(robot: Robot) -> np.ndarray:
    """Return the home position (n,) moved away from the limits."""
    room = np.minimum(np.deg2rad(70.0), 0.5 * (robot.q_max - robot.q_min))
    return np.clip(robot.q_home, robot.q_min + room, robot.q_max - room)


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
    x = np.clip(np.where(rising, t, seconds - t) / ramp, 0.0, 1.0)
    sign = np.where(rising, 1.0, -1.0)
    w = x**3 * (10 - 15 * x + 6 * x * x)
    wd = 30 * x * x * (1 - x) ** 2 / ramp * sign
    wdd = 60 * x * (1 - x) * (1 - 2 * x) / ramp**2
    return w, wd, wdd


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
