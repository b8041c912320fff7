"""A short arm of two joints whose logs are cheap: many of them judge the statistics of the fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.estimation import Experiment, Fit
from armlab.identify import base_parameters
from armlab.kernels import presliding
from armlab.log import Table

RATE = 100.0
NOISE = np.array([0.3, 0.2])
DELTA = np.full(2, 1e-3)
LINKS = np.array(
    [[3, 0.1, 0.02, 0.3, 0.5, 0.01, 0.4, 0.02, 0.01, 0.3], [1.5, 0.25, 0.05, 0.02, 0.05, 0.01, 0.2, 0, 0.01, 0.22]]
)
ROTOR = np.array([0.2, 0.1])


class ShortArm:
    """A vertical axis, then a horizontal one."""

    def __init__(self) -> None:
        turned, beside = np.eye(4), np.eye(4)
        turned[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        beside[0, 3] = 0.3
        self.robot = robots.from_links("short", [np.eye(4), turned, beside])

    def log(
        self, seed: int, n: int, *, rho: float = 0.0, slow: bool = False, bad: float = 0.0, stretch: int = 1
    ) -> Table:
        """A log of n samples with AR(1) noise of the torque; a share of stretches is ten deviations off."""
        t, draw = np.arange(n) / RATE, np.random.default_rng(99)
        f = np.array([0.11, 0.23, 0.37, 0.61, 0.83]) * (0.3 if slow else 1.0)
        a, phase = draw.uniform(0.015, 0.05, (2, 5, 1)) / f[:, None], draw.uniform(0, 6, (2, 5, 1))
        wave = 2 * np.pi * f[:, None] * t + phase
        w = 2 * np.pi * f[:, None]
        parts = a * np.sin(wave), a * w * np.cos(wave), -a * w**2 * np.sin(wave)
        q, qd, qdd = (part.sum(axis=1).T for part in parts)
        moves = 0.0 if slow else 1.0
        tau = self.robot.chain.rnea(q, moves * qd, moves * qdd, self.robot.gravity, LINKS) + moves * ROTOR * qdd
        tau = tau + np.array([1.0, 0.5]) * qd + np.array([2.0, 1.0]) * presliding(q, DELTA, np.zeros(2)) + [0.3, -0.2]
        rng = np.random.default_rng(seed)
        tau = tau + NOISE * _noise(rng, n, rho)
        count = -(-n // stretch), 2
        spoilt = np.where(rng.random(count) < bad, 10 * NOISE * rng.choice([-1, 1], count), 0.0)
        return Table(t, {"q": q, "qd": qd, "tau": tau + np.repeat(spoilt, stretch, axis=0)[:n]})

    def experiment(
        self, rho: float = 0.0, slow: bool = False, gain_sd: float = 0.0
    ) -> Callable[[int, int], Experiment]:
        """Return what `check_estimator` draws from: logs, with gains of the torque, and the true base parameters."""
        truth = base_parameters(self.robot, quasi_static=slow).B @ np.concatenate([LINKS.ravel(), ROTOR])

        def draw(seed: int, n: int) -> Experiment:
            table = self.log(seed, n, rho=rho, slow=slow)
            gains = 1.0 + gain_sd * np.random.default_rng([seed, 5]).standard_normal(2)
            table = table.with_column("tau", gains * table["tau"])
            return Experiment({"table": table, "robot": self.robot}, truth)

        return draw

    def of_base(self, fit: Fit) -> Fit:
        """Return the fit of the base parameters alone: terms of friction may come and go from log to log."""
        p = len(fit.value.base_names)
        cov = fit.cov[:p, :p]
        return replace(fit, names=fit.names[:p], units=fit.units[:p], parameters=fit.parameters[:p], cov=cov)


def _noise(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    from scipy.signal import lfilter

    white = rng.standard_normal((n + 200, 2)) * np.sqrt(1 - rho**2)
    return np.asarray(lfilter([1.0], [1.0, -rho], white, axis=0))[200:]


@pytest.fixture(scope="session")
def short_arm() -> ShortArm:
    return ShortArm()
