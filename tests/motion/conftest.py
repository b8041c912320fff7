"""Movement primitives for the tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from armlab import Command, State, robots
from armlab.estimation import Fit
from armlab.lie import so3
from armlab.motion import Dmp, PoseDmp, fit_pose_dmp
from armlab.motion.control import Controller
from armlab.motion.primitive.equation import placed, time_constants

PERIOD = 0.004032
YUMI = robots.load("yumi_right")
REACH = 0.3 * np.array([1, 1, 1, 1, -1, 1, 1])


def primitive(schedule: str = "canonical", scaling: str = "goal", n: int = 3, **changes: Any) -> Dmp:
    rng = np.random.default_rng(0)
    alpha_x, tau_d = time_constants("lund", 2.0, 25.0)
    centres, widths = placed(schedule, "time", 20, alpha_x * 2.0 / tau_d, 0.8)
    parts: dict[str, Any] = {
        "weights": rng.normal(size=(20, n)) * 20,
        "centres": centres,
        "widths": widths,
        "tau_d": tau_d,
        "duration": 2.0,
        "y0": rng.normal(size=n),
        "v0": rng.normal(size=n),
        "g": rng.normal(size=n),
        "extent": np.ones(n),
        "peak_acceleration": np.full(n, 10.0),
        "monotone": np.ones(n, dtype=bool),
        "schedule": schedule,
        "scaling": scaling,
    }
    return Dmp(**parts | changes)


def poses(t: np.ndarray) -> np.ndarray:
    S = t**3 * (10 - 15 * t + 6 * t**2)
    T = np.zeros((len(t), 4, 4))
    T[:, 0, 3], T[:, 1, 3], T[:, 2, 3], T[:, 3, 3] = 0.4 + 0.2 * S, 0.1 * np.sin(2 * np.pi * S), 0.3 + 0.1 * S, 1.0
    T[:, :3, :3] = so3.exp(np.stack([0.8 * S, 0.5 * np.sin(np.pi * S), -0.6 * S], axis=1))
    return T


@pytest.fixture(scope="session")
def pose_demo() -> tuple[np.ndarray, np.ndarray]:
    """Times (251,) over one second and poses (251, 4, 4): 0.2 m and one radian, at rest at both ends."""
    t = np.linspace(0.0, 1.0, 251)
    return t, poses(t)


@pytest.fixture(scope="session")
def pose_fit(pose_demo: tuple[np.ndarray, np.ndarray]) -> Fit[PoseDmp]:
    """The primitive fitted to `pose_demo`."""
    return fit_pose_dmp(*pose_demo)


def plain(weights: Any, centres: Any, widths: Any, duration: float, y0: np.ndarray, g: np.ndarray, **more: Any) -> Dmp:
    """A Dmp of the convention "lund" from its weights."""
    n = len(y0)
    parts = {"v0": np.zeros(n), "extent": np.abs(g - y0) + 1e-9, "peak_acceleration": np.ones(n)}
    kernels = {"weights": weights, "centres": np.asarray(centres), "widths": widths}
    return primitive(n=n, tau_d=duration / 3, duration=duration, y0=y0, g=g, **parts, **kernels, **more)


def smooth(n: int = 2, seed: int = 0, force: float = 40.0, **more: Any) -> Dmp:
    """A primitive with random weights; by default, its coordinates are multiples of the first."""
    draw = np.random.default_rng(seed)
    centres = np.exp(-3 * np.linspace(0, 1, 20))
    shares = 0.5 ** np.arange(n)
    weights = (force * draw.normal(size=(20, 1)) - 156.25) * shares  # the constant lets the spring start softly
    return plain(weights, centres, 0.8 * np.abs(np.gradient(centres)), 2.0, np.zeros(n), shares, **more)


@pytest.fixture(scope="session")
def reach() -> Dmp:
    """A two-second primitive from the home posture, starting softly."""
    parts = {"y0": YUMI.q_home, "g": YUMI.q_home + REACH, "v0": np.zeros(7)}
    draw = np.random.default_rng(3)
    return primitive(n=7, weights=(10 * draw.normal(size=(20, 7)) - 156.25) * REACH, **parts)


@dataclass
class Ideal:
    """An arm at the position commanded one packet ago; a hand may hold it."""

    q: np.ndarray
    qd: np.ndarray
    t: float = 0.0
    held: bool = False

    def packet(self, controller: Controller, dt: float = PERIOD, **state: Any) -> Command:
        command = controller(State(self.t, dt, self.q, self.qd, self.q, **state))
        self.t += dt
        if command.ends:
            return command
        self.q, self.qd = (self.q, np.zeros(7)) if self.held else (command.q, command.qd)
        return command

    def run(self, controller: Controller, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities commanded, until the controller ends the run."""
        commands = [self.packet(controller) for _ in range(round(seconds / PERIOD))]
        found = [(c.q, c.qd) for c in commands if not c.ends]
        return np.array([q for q, _ in found]), np.array([qd for _, qd in found])


def arm(q: np.ndarray = YUMI.q_home) -> Ideal:
    """Make an arm at rest."""
    return Ideal(q.copy(), np.zeros(7))
