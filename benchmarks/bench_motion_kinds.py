"""Distributions, rhythmic motions, obstacles and moving goals, compared with movement_primitives where possible.

The peer's ProMP builds square matrices over all samples of all coordinates, so the demonstrations are short.
"""

from __future__ import annotations

import numpy as np
from blocks import Contender, Disagreement, Table, loop, once, table
from demonstrations import JOINTS, KERNELS, N, demonstration, rmse
from movement_primitives.dmp import DMP, CouplingTermObstacleAvoidance3D
from movement_primitives.promp import ProMP as TheirProMP

from armlab.motion import AvoidingDmp, Capsule, fit_dmp, fit_periodic_dmp, fit_promp

SHOWN, SAMPLES, WEIGHTS = 20, 100, 10  # demonstrations, samples and kernels of a distribution
AT = 0.4  # share of the duration at which the distribution is conditioned
RHYTHM, TURNS = 25, 3  # kernels; periods
BALL = np.array([0.5, 0.06, 0.02])
CLEARANCE = 0.05


def run(quick: bool) -> list[Table]:
    """Measure `fit_promp`, `ProMP.condition`, `marginal`, `fit_periodic_dmp`, its rollout, `avoid`, `change_goal`."""
    rounds = 3 if quick else 30
    return [*_distributions(rounds), *_rhythms(rounds), _obstacles(rounds), _goals(rounds)]


def _distributions(rounds: int) -> list[Table]:
    t, y, clean = _shown()
    ours, theirs = fit_promp(t, y, n_basis=WEIGHTS).value, TheirProMP(JOINTS, WEIGHTS)
    times = np.tile(t, (SHOWN, 1))
    theirs.imitate(times, y)
    errors = [rmse(path, clean) for path in (ours.marginal(t).y, theirs.mean_trajectory(t))]
    if not max(errors) < 0.02:
        raise Disagreement(f"Expected means within 0.02 of the mean of the demonstrations, got {errors}.")
    text = f"{SHOWN} demonstrations of {JOINTS} coordinates x {SAMPLES} samples, {WEIGHTS} kernels."
    accuracy = (
        f"RMSE of the mean relative to the clean mean: armlab {errors[0]:.1e}, movement_primitives {errors[1]:.1e}."
    )
    point = clean[int(AT * SAMPLES)] + 0.01
    peer = "movement_primitives"

    def fit() -> None:
        TheirProMP(JOINTS, WEIGHTS).imitate(times, y)

    fits = [
        Contender("armlab fit_promp", once(lambda: fit_promp(t, y, n_basis=WEIGHTS)), "armlab"),
        Contender(f"{peer} imitate", once(fit), bar=1 / 10, note="expectation maximisation"),
    ]
    conditions = [
        Contender("armlab ProMP.condition", once(lambda: ours.condition(AT, point, cov=1e-6)), "armlab"),
        Contender(
            f"{peer} condition_position", once(lambda: theirs.condition_position(point, 1e-6 * np.eye(JOINTS), AT))
        ),
    ]
    spreads = [
        Contender(
            "armlab ProMP.marginal",
            once(lambda: ours.marginal(t)),
            "armlab",
            note="including the covariance of velocity",
        ),
        Contender(f"{peer} mean_trajectory, var_trajectory", once(lambda: _spread(theirs, t)), bar=1 / 10),
    ]
    return [
        table("Distributions over motions: fit", f"{text} {accuracy}", "ms", fits, min(rounds, 10)),
        table("Distributions over motions: through a point", text, "ms", conditions, rounds),
        table("Distributions over motions: mean and variance", text, "ms", spreads, rounds),
    ]


def _shown() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t, y = demonstration()
    keep = np.linspace(0, N - 1, SAMPLES).round().astype(int)
    rng = np.random.default_rng(3)
    clean, bend = y[keep], np.sin(np.pi * t[keep])[:, None]
    own, noise = rng.normal(size=(SHOWN, 1, JOINTS)), rng.normal(size=(SHOWN, SAMPLES, JOINTS))
    draws = clean + 0.05 * (own - own.mean(axis=0)) * bend + 1e-3 * noise
    return t[keep], draws, clean


def _spread(promp: TheirProMP, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return promp.mean_trajectory(t), promp.var_trajectory(t)


def _rhythms(rounds: int) -> list[Table]:
    t = np.linspace(0.0, float(TURNS), N)
    phase = 2 * np.pi * t[:, None] + np.arange(JOINTS)
    y = np.sin(phase) + 0.4 * np.sin(3 * phase + 0.5)
    ours = fit_periodic_dmp(t, y, period=1.0, n_basis=RHYTHM).value
    text = f"{JOINTS} coordinates x {N} samples of {TURNS} periods, {RHYTHM} kernels. No peer supports this. RMSE: "
    text += f"{rmse(ours.rollout(t).y, y):.1e} for an amplitude of 1."
    fit = once(lambda: fit_periodic_dmp(t, y, period=1.0, n_basis=RHYTHM))
    rows = [
        Contender("armlab fit_periodic_dmp", fit, "armlab"),
        Contender("armlab PeriodicDmp.rollout", once(lambda: ours.rollout(t)), "armlab"),
    ]
    return [table("Movement primitives: rhythms", text, "ms", rows, rounds)]


def _obstacles(rounds: int) -> Table:
    t, jerk = _straight()
    y = jerk[:, None] * np.array([1.0, 0.1, 0.05])
    ours, theirs = fit_dmp(t, y, n_basis=KERNELS).value, DMP(3, t[-1], dt=t[1], n_weights_per_dim=KERNELS)
    theirs.imitate(t, y)
    ball, turn = [Capsule.sphere(BALL)], CouplingTermObstacleAvoidance3D(BALL)

    def peer() -> np.ndarray:
        return theirs.open_loop(coupling_term=turn)[1]

    def own() -> np.ndarray:
        return AvoidingDmp(ours, ball, CLEARANCE, 4 * CLEARANCE).rollout(t).y

    nearest = [np.linalg.norm(path - BALL, axis=1).min() for path in (own(), peer())]
    text = (
        f"Three coordinates x {N} samples, {KERNELS} kernels, one point obstacle next to the path. Smallest distance: "
        f"{nearest[0]:.3f} m (armlab, requested {CLEARANCE} m) and {nearest[1]:.3f} m (movement_primitives, which has "
        "no clearance setting)."
    )
    rows = [
        Contender("armlab AvoidingDmp.rollout", once(own), "armlab"),
        Contender("movement_primitives open_loop(coupling_term=...)", once(peer), bar=1 / 10),
    ]
    return table("Movement primitives: an obstacle", text, "ms", rows, rounds)


def _straight() -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0.0, 1.0, N)
    return t, t**3 * (10 - 15 * t + 6 * t**2)


def _goals(rounds: int) -> Table:
    t, y = demonstration()
    stepper = fit_dmp(t, y).value.stepper(goal_rate=12.5)
    theirs = DMP(JOINTS, t[-1], dt=t[1], n_weights_per_dim=KERNELS, smooth_scaling=False)
    theirs.imitate(t, y)
    theirs.reset()
    goals = list(y[-1] + 0.1 * np.sin(np.arange(200.0))[:, None])
    state = [y[0].copy(), np.zeros(JOINTS)]

    def own(g: np.ndarray) -> None:
        stepper.change_goal(g)
        stepper.step(t[1])

    def peer(g: np.ndarray) -> None:
        theirs.configure(goal_y=g)
        state[:] = theirs.step(*state)

    text = f"{JOINTS} coordinates, {KERNELS} kernels; a goal change followed by a step."
    rows = [
        Contender("armlab Stepper.change_goal, step", loop(own, goals), "armlab"),
        Contender("movement_primitives configure, step", loop(peer, goals), note="goal not filtered"),
    ]
    return table("Movement primitives: a goal that moves", text, "µs", rows, rounds)
