"""Circles and spheres fitted to points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.frames import fit_circle, fit_sphere
from armlab.frames.circle_sphere import _circle_residuals, _circle_step
from armlab.frames.features import Circle, Sphere
from armlab.lie import se3, so3

SIGMA = 5e-5
MOVE = se3.from_rp(so3.exp([0.4, 1.0, -0.3]), [3.0, -1.0, 2.0])
Draw = Callable[[np.random.Generator], np.ndarray]


def ring(rng: np.random.Generator, n: int, arc: float = 2 * np.pi, sigma: float = SIGMA) -> np.ndarray:
    """Points of a circle of radius 0.2 about (0, 0, 1), normal z."""
    turn = rng.uniform(0.0, arc, n)
    p = np.column_stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), np.ones(n)])
    return p + sigma * rng.standard_normal((n, 3))


def ball(rng: np.random.Generator, n: int, cap: float = np.pi, sigma: float = SIGMA) -> np.ndarray:
    """Points of a sphere of radius 0.2 about (0, 0, 1), not further than `cap` from its top."""
    height, turn = rng.uniform(np.cos(cap), 1.0, n), rng.uniform(0.0, 2 * np.pi, n)
    flat = np.sqrt(1 - height**2)
    p = 0.2 * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height]) + [0, 0, 1]
    return p + sigma * rng.standard_normal((n, 3))


def test_exact_points() -> None:
    rng = np.random.default_rng(0)
    circle = fit_circle(ring(rng, 20, 1.0, 0.0)).value
    np.testing.assert_allclose(circle.centre, [0, 0, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(circle.n, [0, 0, 1], rtol=0, atol=1e-12)
    assert circle.radius == pytest.approx(0.2, abs=1e-12)
    sphere = fit_sphere(ball(rng, 20, 1.0, 0.0)).value
    np.testing.assert_allclose(sphere.centre, [0, 0, 1], rtol=0, atol=1e-12)
    assert sphere.radius == pytest.approx(0.2, abs=1e-12)


def test_the_normal_follows_the_rule_in_every_orientation(cube: list[np.ndarray]) -> None:
    p = ring(np.random.default_rng(1), 20)
    plain = fit_circle(p).value
    assert plain.n[2] > 0
    for R in cube:
        np.testing.assert_allclose(fit_circle(p @ R.T).value.n, R @ plain.n, atol=1e-9)
    assert fit_circle(p, toward=[0, 0, 0]).value.n[2] < 0
    with pytest.raises(NotExcited, match="toward="):
        fit_circle(p - [0, 0, 1.0])


@pytest.mark.parametrize("sigma", [0.0, SIGMA])
def test_what_does_not_tell_the_centre_is_refused(sigma: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        with pytest.raises(NotExcited) as caught:
            fit_circle(ring(rng, 20, 0.02 if sigma else 1e-9, sigma))
        assert "centre" in caught.value.directions[0]
        with pytest.raises(NotExcited) as caught:
            fit_sphere(ball(rng, 20, 0.03, sigma) if sigma else ring(rng, 20, 6.0, 0.0))
        assert "centre along" in caught.value.directions[0] or "centre and radius" in caught.value.directions[0]


def test_minimal_sets_find_outliers() -> None:
    p = ring(np.random.default_rng(2), 5)
    p[3] += [0.0, 0.0, 0.02]
    assert np.flatnonzero(fit_circle(p, robust=True).outliers).tolist() == [3]
    q = ball(np.random.default_rng(3), 6)
    q[1] *= [1.0, 1.0, 1.02]
    assert np.flatnonzero(fit_sphere(q, robust=True).outliers).tolist() == [1]
    many = ball(np.random.default_rng(4), 100)
    many[:30] = [0, 0, 1] + np.random.default_rng(5).uniform(1.02, 1.3, (30, 1)) * (many[:30] - [0, 0, 1])
    found = fit_sphere(many, robust=True, noise=SIGMA)
    assert found.outliers[:30].all()
    assert found.outliers[30:].sum() <= 1


@pytest.mark.parametrize(
    ("call", "error", "sentence"),
    [
        (lambda p: fit_circle(p[:3]), NotExcited, "at least 4 points"),
        (lambda p: fit_sphere(p[:4]), NotExcited, "at least 5 points"),
        (lambda p: fit_circle(p[:4], robust=True), NotExcited, "at least 5 points"),
        (lambda p: fit_circle(p[:, :2]), ShapeError, r"\(N, 3\)"),
        (lambda p: fit_sphere(np.vstack([p, [np.nan] * 3])), ShapeError, "rows 9"),
        (lambda p: fit_circle(np.outer(np.arange(9.0), [1, 2, 3])), NotExcited, "in a line"),
        (lambda p: fit_circle(np.ones((9, 3))), NotExcited, "in one place"),
    ],
)
def test_bad_input_is_refused(call, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        call(ring(np.random.default_rng(0), 9))


def circle_error(fit: Fit[Circle], truth: tuple) -> np.ndarray:
    centre, n, radius = truth
    value = fit.value
    return np.array([*(value.centre - centre), *(value.axes @ np.cross(n, value.n)), value.radius - radius])


def sphere_error(fit: Fit[Sphere], truth: tuple) -> np.ndarray:
    return np.array([*(fit.value.centre - truth[0]), fit.value.radius - truth[1]])


def spoil(data: dict, rng: np.random.Generator) -> tuple[dict, np.ndarray]:
    bad = np.zeros(len(data["p"]), dtype=bool)
    bad[rng.choice(len(bad), len(bad) // 20, replace=False)] = True
    middle = data["p"].mean(axis=0)
    return {**data, "p": np.where(bad[:, None], middle + 1.1 * (data["p"] - middle), data["p"]), "robust": True}, bad


def scaled(data: dict) -> dict:
    return {**data, "p": 1000.0 * data["p"], "noise": 1000.0 * data["noise"]}


def moved(data: dict) -> dict:
    more = {"normal": MOVE[:3, :3] @ data["normal"]} if "normal" in data else {}
    return {**data, "p": data["p"] @ MOVE[:3, :3].T + MOVE[:3, 3], **more}


def there(c: np.ndarray) -> np.ndarray:
    return MOVE[:3, :3] @ c + MOVE[:3, 3]


SKIP = {"efficient": "benchmarks/bench_calibrate_frames.py judges it on 1000 runs of two seeds"}


@pytest.mark.slow  # 4 s
def test_fit_circle_keeps_the_contract(uniform_rotation: Draw) -> None:
    def experiment(seed: int, n: int) -> Experiment:
        rng = np.random.default_rng([6000, seed])
        R, c = uniform_rotation(rng), rng.standard_normal(3)
        p = (ring(rng, n, 4.0, 0.0) - [0, 0, 1]) @ R.T + c + SIGMA * rng.standard_normal((n, 3))
        return Experiment({"p": p, "noise": SIGMA, "normal": R[:, 2]}, (c, R[:, 2], 0.2))

    short = ring(np.random.default_rng(0), 20, 0.02)
    contract = check_estimator(
        fit_circle,
        experiment,
        60,
        n=20,
        error=circle_error,
        gauges=[
            Gauge("frame", moved, lambda fit: (there(fit.value.centre), MOVE[:3, :3] @ fit.value.n, fit.value.radius)),
            Gauge("millimetres", scaled, lambda fit: (1e3 * fit.value.centre, fit.value.n, 1e3 * fit.value.radius)),
        ],
        refusals={"centre": {"p": short, "noise": SIGMA, "normal": [0, 0, 1]}},
        spoil=spoil,
        skip=SKIP,
    )
    assert contract.passed, contract.text()


@pytest.mark.slow  # 4 s
def test_fit_sphere_keeps_the_contract() -> None:
    def experiment(seed: int, n: int) -> Experiment:
        rng = np.random.default_rng([6001, seed])
        c = rng.standard_normal(3)
        p = ball(rng, n, 1.5) - [0, 0, 1] + c
        return Experiment({"p": p, "noise": SIGMA}, (c, 0.2))

    contract = check_estimator(
        fit_sphere,
        experiment,
        60,
        n=20,
        error=sphere_error,
        gauges=[
            Gauge("frame", moved, lambda fit: (there(fit.value.centre), fit.value.radius)),
            Gauge("millimetres", scaled, lambda fit: (1e3 * fit.value.centre, 1e3 * fit.value.radius)),
        ],
        refusals={"centre along": {"p": ball(np.random.default_rng(0), 20, 0.03), "noise": SIGMA}},
        spoil=spoil,
        skip=SKIP,
    )
    assert contract.passed, contract.text()


def test_points_of_their_own_covariance() -> None:
    """NEES/4 is 1, and the error smaller than with one deviation for all."""
    nees, weighted, plain = [], [], []
    for seed in range(40):
        rng = np.random.default_rng([9, seed])
        root = np.linalg.qr(rng.standard_normal((30, 3, 3)))[0] * np.array([2e-4, 5e-5, 2e-5])
        p = ball(rng, 30, 2.0, 0.0) + (root @ rng.standard_normal((30, 3, 1)))[..., 0]
        fit = fit_sphere(p, noise=root @ root.transpose(0, 2, 1))
        d = sphere_error(fit, (np.array([0, 0, 1]), 0.2))
        nees.append(d @ np.linalg.solve(fit.cov, d) / 4)
        weighted.append(d @ d)
        plain.append(np.sum(sphere_error(fit_sphere(p), (np.array([0, 0, 1]), 0.2)) ** 2))
    assert 0.7 < np.mean(nees) < 1.35
    assert np.sqrt(np.mean(weighted) / np.mean(plain)) < 0.9
    same = fit_circle(ring(np.random.default_rng(0), 20), noise=np.eye(3) * SIGMA**2)
    one = fit_circle(ring(np.random.default_rng(0), 20), noise=SIGMA)
    np.testing.assert_allclose(same.value.centre, one.value.centre, atol=1e-13)


def test_derivatives_of_a_circle() -> None:
    """Against differences, for points far above and below its plane."""
    rng = np.random.default_rng(4)
    value = fit_circle(ring(rng, 20)).value
    p = value.centre + 0.3 * rng.standard_normal((10, 3))
    _, J = _circle_residuals(value, p)
    steps = np.eye(6) * 1e-6
    found = [
        (_circle_residuals(_circle_step(value, x), p)[0] - _circle_residuals(_circle_step(value, -x), p)[0]) / 2e-6
        for x in steps
    ]
    np.testing.assert_allclose(J, np.stack(found, axis=2), atol=1e-8)
