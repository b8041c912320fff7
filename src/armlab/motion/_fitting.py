"""The methods of learning: what they share, and what each returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from armlab.motion._demos import Demo
from armlab.motion._newton import descend
from armlab.motion._regression import Forced, fit_regression
from armlab.motion._solving import progress
from armlab.motion._trajectory import Ends, fit_trajectory
from armlab.motion.dmp import Dmp

__all__ = ["Learned", "learn"]


@dataclass(frozen=True)
class Learned:
    """Weights (m, n); y0, v0, g of each demonstration (M, 3, n); covariances (n, d, d) of weights, and of the ends
    where they were fitted too, for noise of unit variance; noise (n,); residuals (N, n), of position or of the forcing,
    or what makes them; triangle of the unknowns and their numbers; scales (M, n)."""

    weights: np.ndarray
    ends: np.ndarray
    unit: np.ndarray
    sigma: np.ndarray
    residuals: np.ndarray | Callable[[], np.ndarray]
    triangle: np.ndarray
    unknowns: tuple[int, ...]
    of_position: bool
    scales: np.ndarray

    def path(self, dmp: Dmp, demo: Demo, k: int) -> np.ndarray:
        """Return the motion (N, n) of demonstration k."""
        y0, v0, g = self.ends[k]
        tau = dmp.tau_d * demo.duration / dmp.duration
        return dmp.primitive.rollout(demo.t, tau, y0, v0, g, np.ascontiguousarray(self.scales[k]))[0]


def learn(
    method: str,
    blank: Dmp,
    demos: list[Demo],
    scales: np.ndarray,
    starts: np.ndarray,
    goals: np.ndarray,
    ends: Ends,
    hold: float,
    ridge: float,
    bandwidth: float | None,
    raw: bool,
) -> Learned:
    """Learn weights that demonstrations share.

    Parameters
    ----------
    method : "trajectory", "acceleration" or "lwr". blank : the primitive without weights. demos : M of them.
    scales, starts, goals : (M, n). ends : what is known of them. hold, ridge, bandwidth, raw : as in `fit_dmp`.
    """
    m = blank.n_basis
    if method == "trajectory" and blank.schedule != "position":
        taus = [blank.tau_d * demo.duration / blank.duration for demo in demos]
        found = fit_trajectory(blank.primitive, demos, taus, scales, ends, hold, ridge)
        unknowns = (*range(m), *(m + 3 * k + e for k in range(len(demos)) for e in found.free))
        parts = found.weights, found.ends, found.unit, found.sigma, found.residuals, found.triangle
        return Learned(*parts, unknowns, True, scales)
    velocities = [_velocity(demo, bandwidth) for demo in demos]
    speeds = [ends.known.get("v0", v[0]) for v, _ in velocities]
    all_ends = np.stack([starts, np.array(speeds), goals], axis=1)
    forced = [
        _forced(blank, demo, *velocity, scale, start, goal)
        for demo, velocity, scale, start, goal in zip(demos, velocities, scales, starts, goals)
    ]
    bells = (blank.centres, blank.widths if raw else np.zeros(0)) if method == "lwr" else None
    first = fit_regression(forced, blank.primitive, m, blank.schedule != "time", ridge, bells)
    parts = first.unit, first.sigma, first.residuals, first.triangle
    learned = Learned(first.weights, all_ends, *parts, tuple(range(m)), False, scales)
    return learned if method != "trajectory" else _descended(blank, demos, learned)


def _velocity(demo: Demo, bandwidth: float | None) -> tuple[np.ndarray, np.ndarray]:
    if bandwidth is None:
        return demo.velocity, demo.acceleration
    from armlab.signals import smooth_diff

    velocity = smooth_diff(demo.y, demo.t, bandwidth)
    return velocity, smooth_diff(velocity, demo.t, bandwidth)


def _forced(
    blank: Dmp,
    demo: Demo,
    velocity: np.ndarray,
    acceleration: np.ndarray,
    scale: np.ndarray,
    start: np.ndarray,
    goal: np.ndarray,
) -> Forced:
    """Return the forcing that the spring leaves: ``tau^2 ydd - alpha_z (beta_z (g - y) - tau yd)``, and its phase."""
    tau = blank.tau_d * demo.duration / blank.duration
    f = tau**2 * acceleration - blank.alpha_z * (blank.beta_z * (goal - demo.y) - tau * velocity)
    x = progress(demo.y, start, goal) if blank.schedule == "position" else blank.phase(demo.t, tau)
    return Forced(x, f, scale, demo.weights)


def _descended(blank: Dmp, demos: list[Demo], learned: Learned) -> Learned:
    """Return weights of a position phase, from the regression on."""
    roots = np.sqrt(np.concatenate([demo.weights for demo in demos]))
    y = np.concatenate([demo.y for demo in demos])

    def run(weights: np.ndarray) -> np.ndarray:
        K, paths = len(weights), []
        for k, demo in enumerate(demos):
            tau = blank.tau_d * demo.duration / blank.duration
            ends = (np.broadcast_to(a, (K, blank.n)) for a in (*learned.ends[k], learned.scales[k]))
            paths.append(blank.primitive.rollout(demo.t, tau, *ends, weights)[0])
        return np.concatenate(paths)

    w, inverses, residuals = descend(run, y, roots, learned.weights)
    dof = max(len(y) - len(w), 1)
    sigma = np.sqrt(roots**2 @ residuals**2 / dof)
    return replace(
        learned,
        weights=w,
        unit=inverses,
        sigma=sigma,
        residuals=residuals,
        triangle=np.linalg.cholesky(np.linalg.inv(inverses[0])).T,
        of_position=True,
    )
