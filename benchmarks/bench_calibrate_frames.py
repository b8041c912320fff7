"""Planes, lines, circles and spheres through points: error relative to the Cramér-Rao bound, calibration of the
uncertainty, time.

Case P1 of the specification: 20 points on a patch of 0.3 m by 0.2 m or on a rod of 0.3 m, at random poses, with
0.05 mm of noise. Circles: an arc of 240 degrees with radius 0.2 m. Spheres: a hemisphere with radius 0.2 m. The bounds
are evaluated at the true points, so each fit is compared with the best possible unbiased fit. Markers: four LEDs 0.1 m
apart, 20 frames, 20 % of the points hidden, 0.5 mm of noise.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product, repeat
from typing import Any

import numpy as np
from all_cores import on_all_cores
from blocks import Contender, Table, loop, table

from armlab import frames
from armlab.estimation import Contract, Experiment, Fit, check_estimator
from armlab.lie import quaternion, se3, so3

SEEDS = (5000, 5100)
POINTS, SIGMA, RADIUS = 20, 5e-5, 0.2  # m
LEDS, FRAMES, LED_NOISE = 0.1 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]]), 20, 5e-4  # m
BAR = 1.05
MARKERS = "poses of markers"
LAWS = ("order-free", "gauge-free", "refuses", "saves", "explains", "clean")


def run(quick: bool) -> list[Table]:
    """Evaluate all four fits in many runs, then time them and the decomposition alone."""
    runs = 200 if quick else 1000
    lines = [f"{runs} runs per seed, noise given; target {BAR} for each part, target 1 for NEES / dimension."]
    seeds, names = zip(*product(SEEDS, [*CASES, MARKERS]), strict=True)
    lines += on_all_cores(_line, seeds, names, repeat(runs))
    clouds = {name: [dict(_experiment(name, SEEDS[0], k, POINTS).data) for k in range(50)] for name in CASES}
    raw = [data["p"] - data["p"].mean(axis=0) for data in clouds["plane"]]
    contenders = [
        Contender(f"armlab {name}", loop(lambda data, fit=CASES[name][0]: fit(**data), clouds[name]), "armlab")
        for name in CASES
    ]
    robust = [{**data, "robust": True} for data in clouds["plane"]]
    contenders.append(Contender("armlab plane, robust", loop(lambda data: frames.fit_plane(**data), robust), "armlab"))
    contenders.append(Contender("the decomposition alone", loop(np.linalg.svd, raw), "limit"))
    return [table("Features of measured points", "\n\n".join(lines), "µs", contenders, 3 if quick else 20)]


def _line(seed: int, name: str, runs: int) -> str:
    if name == MARKERS:
        return f"Seed {seed}, {name}: {markers(seed, runs)}."
    contract = judged(name, seed, runs)
    found = "; ".join(contract[part].text for part in ("efficient", "honest", "consistent", "robust"))
    return f"Seed {seed}, {name}: {'passed' if contract.passed else 'FAILED'}; {found}."


def judged(name: str, seed: int, runs: int) -> Contract:
    """Return the statistical part of the contract for one kind of feature."""
    fit, error, blocks = CASES[name]
    return check_estimator(
        fit,
        lambda run, n: _experiment(name, seed, run, n),
        runs,
        n=POINTS,
        error=error,
        blocks=blocks,
        spoil=_spoil,
        skip=dict.fromkeys(LAWS, "invariant, tested in tests/frames"),
    )


def markers(seed: int, runs: int) -> str:
    """Return the errors of `marker_pose` relative to their bound (its covariance at the truth), and its NEES."""
    e2, bound, nees, exact = np.zeros(2), np.zeros(2), [], 0.0
    for run in range(runs):
        rng = np.random.default_rng([seed, run])
        q = rng.standard_normal((FRAMES, 4))
        T = se3.from_rp(
            quaternion.to_matrix(q / np.linalg.norm(q, axis=1, keepdims=True)), rng.standard_normal((FRAMES, 3))
        )
        p = np.einsum("nij,kj->nki", T[:, :3, :3], LEDS) + T[:, None, :3, 3]
        seen = rng.random(p.shape[:2]) > 0.2
        found = frames.marker_pose(p + LED_NOISE * rng.standard_normal(p.shape), LEDS, visible=seen, noise=LED_NOISE)
        true = frames.marker_pose(p, LEDS, visible=seen, noise=LED_NOISE)
        ok = found.valid
        turn = so3.log(np.swapaxes(T[ok, :3, :3], 1, 2) @ found.T[ok, :3, :3])
        e = np.hstack([found.T[ok, :3, 3] - T[ok, :3, 3], turn])
        nees.append(np.einsum("ni,ni->n", e, np.linalg.solve(found.cov[ok], e[..., None])[..., 0]) / 6)
        e2 += [np.sum(e[:, 3:] ** 2), np.sum(e[:, :3] ** 2)]
        spread = np.einsum("nii->ni", true.cov[ok])
        bound += [spread[:, 3:].sum(), spread[:, :3].sum()]
        exact = max(exact, float(np.abs(true.T[ok] - T[ok]).max()))
    rotation, position = np.sqrt(e2 / bound)
    count = sum(len(one) for one in nees)
    size = np.sqrt(bound / count)
    return (
        f"rotation {rotation:.3f} of {np.degrees(size[0]):.4f} deg, position {position:.3f} of {1e3 * size[1]:.4f} mm, "
        f"NEES {np.mean(np.concatenate(nees)):.3f} in {count} frames of {runs} runs; exact points to {exact:.1e}"
    )


def _experiment(name: str, seed: int, run: int, n: int) -> Experiment:
    """Return points of a feature according to the specification, with truth and bound."""
    rng = np.random.default_rng([seed, run])
    q = rng.standard_normal(4)
    R, c = quaternion.to_matrix(q / np.linalg.norm(q)), rng.standard_normal(3)
    hint: dict[str, Any] = {"along": R[:, 0]} if name == "line" else {} if name == "sphere" else {"normal": R[:, 2]}
    if name in ("plane", "line"):  # one generator for both: the line is drawn after the noise of the plane
        flat = rng.uniform(-1, 1, (n, 2)) * [0.15, 0.10]
        noise = rng.standard_normal((n, 3))
        if name == "line":
            flat = np.column_stack([rng.uniform(-0.15, 0.15, n), np.zeros(n)])
            noise = rng.standard_normal((n, 3))
        p, bound = c + flat @ R[:, :2].T, None
    else:
        turn, height = rng.uniform(0.0, 4.0, n), rng.uniform(0.0, 1.0, n) * (name == "sphere")
        local = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(n)]) * np.sqrt(1 - height**2)[:, None]
        local[:, 2] = height
        p, noise = c + RADIUS * local @ R.T, rng.standard_normal((n, 3))
    data = {"p": p + SIGMA * noise, "noise": SIGMA, **hint}
    bound = CASES[name][0](**{**data, "p": p}).cov  # noise-free points give the information at the truth
    return Experiment(data, (R, c), bound)


def _plane_error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    (R, c), value = truth, fit.value
    return np.array([*(value.axes @ np.cross(R[:, 2], value.n)), R[:, 2] @ (value.centroid - c)])


def _line_error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    (R, c), value = truth, fit.value
    return np.concatenate([value.axes @ np.cross(R[:, 0], value.v), value.axes @ (value.centroid - c)])


def _circle_error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    (R, c), value = truth, fit.value
    return np.array([*(value.centre - c), *(value.axes @ np.cross(R[:, 2], value.n)), value.radius - RADIUS])


def _sphere_error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.array([*(fit.value.centre - truth[1]), fit.value.radius - RADIUS])


def _spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
    """Move 5 % of the points 10 mm off the feature."""
    bad = np.zeros(len(data["p"]), dtype=bool)
    bad[rng.choice(len(bad), len(bad) // 20, replace=False)] = True
    if "along" in data:
        side = np.cross(data["along"], rng.standard_normal(3))
    else:
        side = np.asarray(data.get("normal", rng.standard_normal(3)))
    if "normal" not in data and "along" not in data:  # a sphere: move along the radius
        away = data["p"] - frames.fit_sphere(data["p"], noise=SIGMA).value.centre
    else:
        away = np.broadcast_to(side, data["p"].shape)
    step = 0.01 * away / np.linalg.norm(away, axis=1, keepdims=True)
    return {**data, "p": data["p"] + bad[:, None] * step, "robust": True}, bad


Case = tuple[Callable[..., Fit[Any]], Callable[[Fit[Any], Any], np.ndarray], dict[str, list[int]]]
CASES: dict[str, Case] = {
    "plane": (frames.fit_plane, _plane_error, {"tilt": [0, 1], "offset": [2]}),
    "line": (frames.fit_line, _line_error, {"tilt": [0, 1], "offset": [2, 3]}),
    "circle": (frames.fit_circle, _circle_error, {"centre": [0, 1, 2], "tilt": [3, 4], "radius": [5]}),
    "sphere": (frames.fit_sphere, _sphere_error, {"centre": [0, 1, 2], "radius": [3]}),
}
