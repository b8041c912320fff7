"""Excitation: periodic joint motion that tells the parameters apart.

    q_i(t) = centre_i + sum_k a_ik / (2 pi f0 k) sin(2 pi f0 k t) - b_ik / (2 pi f0 k) cos(2 pi f0 k t)

(Swevers et al. 1997). The record starts and ends at rest: a quintic window blends the motion in and out. Among seeded
candidates, each scaled to the limits, the one with the largest log det of the information of the base regressor is kept
(D-optimal; the units of the parameters do not change the order).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.errors import ShapeError
from armlab.identify.base_parameters import BaseParameters, base_parameters
from armlab.robots import Robot
from armlab.state import Command, State

__all__ = ["Trajectory", "dither", "excitation", "sequence"]

RAMP = 2.0  # s, blend at each end
LONGEST_STEP = 0.006  # s that a controller's clock moves at once: 1.5 periods, what the bridge lets a reference move
CANDIDATES = 60
MARGIN = 0.05  # rad or m, kept from the position limits; a tenth of the range where that is less


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
                s, ds, _ = _quintic(clock / approach)
                way = self.q_first - state.q_start
                return Command(q=state.q_start + s * way, qd=ds / approach * way)
            q, qd, _ = self.sample(np.array(clock - approach))
            return Command(q=q, qd=qd)

        return step


def _quintic(x: float) -> tuple[float, float, float]:
    """Return the smooth step of x in [0, 1] and its two derivatives."""
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x), 30 * x * x * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)


def excitation(
    robot: Robot,
    seconds: float = 60.0,
    f0: float = 0.1,
    harmonics: int = 8,
    speed: float = 0.6,
    acceleration: float = 15.0,
    centre: np.ndarray | None = None,
    seed: int = 0,
) -> Trajectory:
    """Design an excitation motion.

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

    Returns
    -------
    Trajectory that stays 0.05 rad (or a tenth of the range) inside the position limits and below the other limits.

    Raises
    ------
    ShapeError : for a share outside (0, 1], a record that is too short, no harmonics, a centre outside the limits.
    """
    if not 0 < speed <= 1 or not 10 <= seconds < np.inf:
        raise ShapeError(
            f"Expected a speed share in (0, 1] and at least 10 seconds, got {speed:g} and {seconds:g} s. "
            "Shorter motions do not excite friction at all speeds."
        )
    if not 0 < f0 < np.inf or harmonics < 1 or not acceleration > 0:
        raise ShapeError(
            f"Expected f0 and acceleration above 0 and at least one harmonic, got {f0:g} Hz, {acceleration:g} and "
            f"{harmonics}. Leave them out for the defaults."
        )
    rng = np.random.default_rng(seed)
    middle = _with_room(robot) if centre is None else _inside(robot, centre)
    base = base_parameters(robot)
    draws = rng.standard_normal((CANDIDATES, 2, harmonics, robot.n))
    candidates = [_scaled(robot, middle, a, b, f0, seconds, speed, acceleration) for a, b in draws]
    return max(candidates, key=lambda trajectory: _information(robot, base, trajectory, f0))


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
    ShapeError : for a length that is not above 0.
    """
    if not 0 < seconds < np.inf:
        raise ShapeError(f"Expected a length above 0 s, got {seconds:g} s. Give the seconds of the motion.")
    centre = np.array(centre, dtype=float)
    omega = 2 * np.pi * frequency
    phase = np.arange(len(centre)) * 2 * np.pi / len(centre)

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, seconds)
        w, wd, wdd = (v[..., None] for v in _window(t, seconds))
        angle = omega * t[..., None] + phase
        x, xd = amplitude * np.sin(angle), amplitude * omega * np.cos(angle)
        return centre + w * x, w * xd + wd * x, -w * omega**2 * x + 2 * wd * xd + wdd * x

    return Trajectory(seconds, sample)


def sequence(parts: Sequence[Trajectory], walk: float = 2.0) -> Trajectory:
    """Join motions that start and end at rest, with a quintic walk of `walk` seconds between them.

    Parameters
    ----------
    parts : at least one motion. walk : seconds of each walk, above 0.

    Raises
    ------
    ShapeError : for no parts or no time to walk.
    """
    if not parts or not walk > 0:
        raise ShapeError(f"Expected at least one motion and a walk above 0 s, got {len(parts)} and {walk:g} s.")
    starts = np.cumsum([0.0, *(part.seconds + walk for part in parts[:-1])])
    total = float(starts[-1] + parts[-1].seconds)

    def one(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        k = int(np.searchsorted(starts, t, side="right")) - 1
        local = t - starts[k]
        if local <= parts[k].seconds or k == len(parts) - 1:
            return parts[k].sample(np.array(local))
        here, there = parts[k].sample(np.array(parts[k].seconds))[0], parts[k + 1].q_first
        x = (local - parts[k].seconds) / walk
        s, ds, dds = _quintic(x)
        return here + s * (there - here), ds / walk * (there - here), dds / walk**2 * (there - here)

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, total)
        if t.ndim == 0:
            return one(float(t))
        rows = [one(float(x)) for x in t.ravel()]
        q, qd, qdd = (np.array([row[k] for row in rows]).reshape(*t.shape, -1) for k in range(3))
        return q, qd, qdd

    return Trajectory(total, sample)


def _with_room(robot: Robot) -> np.ndarray:
    """Return the home position (n,) moved away from the limits."""
    room = np.minimum(np.deg2rad(70.0), 0.5 * (robot.q_max - robot.q_min))
    return np.clip(robot.q_home, robot.q_min + room, robot.q_max - room)


def _inside(robot: Robot, centre: np.ndarray) -> np.ndarray:
    """Return a centre (n,) moved away from the limits by twice the margin; refuse one outside them."""
    given = np.array(centre, dtype=float)
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


def _information(robot: Robot, base: BaseParameters, trajectory: Trajectory, f0: float) -> float:
    """Return log det of the information of the base parameters over one period."""
    t = np.linspace(RAMP, min(RAMP + 1.0 / f0, trajectory.seconds - RAMP), 100)
    q, qd, qdd = trajectory.sample(t)
    n = robot.n
    rotor = np.zeros((len(t), n, n))
    rotor[:, range(n), range(n)] = qdd
    Y = np.concatenate([robot.chain.rigid_regressor(q, qd, qdd, robot.gravity), rotor], axis=2)
    A = Y[:, :, base.kept].reshape(-1, len(base.kept))
    sign, logdet = np.linalg.slogdet(A.T @ A)
    return float(logdet) if sign > 0 else -np.inf
